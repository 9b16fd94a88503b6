// The page: form, player, downloads, and a link that contains the request.
import { Sampler, json, words } from "./sampling.js";
import { longestOf } from "./check.js";
import { STREAM } from "./models.js";
import { NotUnderstood, usualSeconds } from "./language_reading.js";
import { chips, languageFiles, openLanguage } from "./language.js";
import { bvh, glb, shown } from "./figure.js";
import { fbx } from "./fbx.js";

const element = (id) => document.getElementById(id), fields = ["text", "seconds", "seed"].map(element);
let sampler, figure, player, motion, language;

function say(text, kind = "") {
  element("notes").textContent = text;
  element("notes").className = kind;
}

/** Returns a button that puts a text into the form and samples it. */
function suggestion(text) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = text;
  button.addEventListener("click", () => ask(text));
  const picture = language.picture(text);
  if (picture) button.prepend(Object.assign(document.createElement("img"), { src: picture, alt: "" }));
  return button;
}

function ask(text) {
  element("text").value = text;
  generate();
}

/** Returns what the model reads for a text, and shows it as chips and lines; throws `NotUnderstood`. */
function understood(text) {
  element("understood").replaceChildren();
  say("");
  const reading = language.reader.read(text);
  element("understood").replaceChildren(...chips(language.reader.abilities, reading, ask));
  const lines = [...reading.changes];
  if (reading.captions.length > 1) {
    lines.push(`This page samples one action at a time, here the first: ${reading.captions[0]}. The demo samples all actions.`);
  }
  const paragraphs = lines.map((line) => Object.assign(document.createElement("p"), { textContent: line }));
  element("notes").replaceChildren(...paragraphs);
  return reading;
}

/** Shows why a text is rejected, and the actions with the nearest meanings. */
function refuse(error) {
  const { message, nearest } = error;
  say(nearest.length ? `${message}. Nearest in meaning:` : message, "error");
  if (!nearest.length) return;
  const buttons = Object.assign(document.createElement("div"), { className: "nearest" });
  buttons.append(...nearest.map(suggestion));
  element("notes").append(buttons);
}

async function generate() {
  const [text, seconds, seed] = [element("text").value.trim(), element("seconds").valueAsNumber, element("seed").value.trim()];
  if (!/^-?\d{1,18}$/.test(seed)) return say(`seed=${seed}: give a whole number`, "error");
  element("generate").disabled = true;
  element("understood").inert = true;
  try {
    const reading = understood(text);
    // A single action uses the noise that `flame_mdm.generate` draws for the text as typed.
    const shownText = reading.captions.length === 1 ? text : reading.texts[0];
    const [read] = reading.captions;
    const begin = performance.now();
    const length = Number.isNaN(seconds) ? usualSeconds(reading, sampler.content) : seconds;
    const x = await sampler.generate(read, length, BigInt(seed).toString(), (share) => { element("progress").value = share; }, shownText);
    const joints = await sampler.decode(x), frames = x.length / sampler.content.features;
    const milliseconds = performance.now() - begin;
    motion = { text: shownText, seed, frames, joints, milliseconds, ...(await sampler.rotations(joints)) };
    const data = JSON.stringify([shown(figure, motion)]).replaceAll("<", "\\u003c");
    element("player").srcdoc = player.replace("__DATA__", () => data);
    const query = new URLSearchParams({ text, ...(Number.isNaN(seconds) ? {} : { seconds }), seed });
    history.replaceState(null, "", `#${query}`);
    Object.assign(element("link"), { href: `#${query}`, hidden: false });
    for (const kind of ["bvh", "glb", "fbx"]) element(kind).disabled = false;
    document.body.dataset.made = JSON.stringify({ text, seed, milliseconds });
  } catch (error) {
    if (error instanceof NotUnderstood) refuse(error);
    else say(error.message.split("\n")[0], "error");
  } finally {
    element("generate").disabled = false;
    element("understood").inert = false;
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
    let page, files;
    [sampler, figure, page, files] = await Promise.all([Sampler.open(), json("figure.json"), fetch("player.html"), languageFiles()]);
    player = await page.text();
    language = openLanguage(sampler.content, files);
    element("stream").hidden = STREAM === null;
    const { fps, captions } = sampler.content, longest = longestOf(sampler.content), request = new URLSearchParams(location.hash.slice(1));
    Object.assign(element("seconds"), { min: 2 / fps, max: longest / fps });
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
