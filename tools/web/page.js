// The page: form, player, downloads, and a link that holds the request.
import { Sampler, json, knownForm, words } from "./sampling.js";
import { bvh, glb, shown } from "./figure.js";
import { fbx } from "./fbx.js";

const element = (id) => document.getElementById(id), fields = ["text", "seconds", "seed"].map(element);
let sampler, figure, player, motion;

function say(text, kind = "") {
  element("notes").textContent = text;
  element("notes").className = kind;
}

function advise(text) { // unknown words and the nearest captions; returns whether the model knows a word that says what happens
  const { vocabulary, captions, function_words: skipped } = sampler.content, prompt = new Set(words(text)), seen = new Set(vocabulary);
  const content = [...prompt].filter((word) => !skipped.includes(word)), unknown = content.filter((word) => !knownForm(word, seen));
  const refused = unknown.length === content.length;
  say(refused ? "The model knows no word that says what happens. Try:" : unknown.length ? `Never seen in training: ${unknown.join(", ")}. Did you mean:` : "", refused ? "error" : "");
  if (!refused && !unknown.length) return true;
  const likeness = (caption) => {
    const others = new Set(words(caption)), shared = (list) => list.filter((word) => others.has(word)).length, all = shared([...prompt]);
    return shared(content) && shared(content) + all / (prompt.size + others.size - all);
  };
  const ranked = captions.map((caption) => [likeness(caption), caption]).sort((a, b) => b[0] - a[0]);
  for (const [, caption] of ranked.filter(([like]) => like || refused).slice(0, 3)) {
    const button = Object.assign(document.createElement("button"), { textContent: caption, type: "button" });
    button.addEventListener("click", () => { element("text").value = caption; generate(); });
    element("notes").append(button);
  }
  return !refused;
}

async function generate() {
  const [text, seconds, seed] = [element("text").value.trim(), element("seconds").valueAsNumber, element("seed").value.trim()];
  if (!/^-?\d{1,18}$/.test(seed)) return say(`seed=${seed}: give a whole number`, "error");
  element("generate").disabled = true;
  try {
    if (!advise(text)) return;
    const begin = performance.now();
    const x = await sampler.generate(text, seconds, BigInt(seed).toString(), (share) => { element("progress").value = share; });
    const joints = await sampler.decode(x), frames = x.length / sampler.content.features;
    const milliseconds = performance.now() - begin;
    motion = { text, seed, frames, joints, milliseconds, ...(await sampler.rotations(joints)) };
    const data = JSON.stringify([shown(figure, motion)]).replaceAll("<", "\\u003c");
    element("player").srcdoc = player.replace("__DATA__", () => data);
    const query = new URLSearchParams({ text, seconds, seed });
    history.replaceState(null, "", `#${query}`);
    Object.assign(element("link"), { href: `#${query}`, hidden: false });
    for (const kind of ["bvh", "glb", "fbx"]) element(kind).disabled = false;
    document.body.dataset.made = JSON.stringify({ text, seed, milliseconds });
  } catch (error) {
    say(error.message.split("\n")[0], "error");
  } finally {
    element("generate").disabled = false;
    element("progress").value = 0;
  }
}

function save(blob, ending) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob) });
  link.download = `${words(motion.text).slice(0, 8).join("-") || "motion"}.${ending}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

async function open() {
  try {
    let page;
    [sampler, figure, page] = await Promise.all([Sampler.open(), json("figure.json"), fetch("player.html")]);
    player = await page.text();
    const { fps, max_frames: longest, captions } = sampler.content, request = new URLSearchParams(location.hash.slice(1));
    Object.assign(element("seconds"), { min: 2 / fps, max: longest / fps, value: Math.min(3, longest / fps) });
    element("text").value = captions.find((caption) => caption.startsWith("a person")) ?? captions[0] ?? "";
    for (const field of fields) if (request.get(field.id)) field.value = request.get(field.id);
    element("generate").disabled = false;
    say("");
    document.body.dataset.ready = performance.now();
    await generate();
  } catch (error) {
    say(`The model cannot be opened: ${error.message.split("\n")[0]}. Reload the page, or build it again`, "error");
  }
}

element("form").addEventListener("submit", (event) => { event.preventDefault(); generate(); });
element("bvh").addEventListener("click", () => save(new Blob([bvh(figure, motion, sampler.content.fps)], { type: "text/plain" }), "bvh"));
for (const [ending, dress] of Object.entries({ glb, fbx })) {
  element(ending).addEventListener("click", async () => {
    const template = await (await fetch(`template.${ending}`)).arrayBuffer();
    save(await dress(figure, template, motion, sampler.content.fps, motion.text), ending);
  });
}
window.joints = () => Array.from(motion.joints);
open();
