// The page with a stream, which is sampled on the visitor's device.
import { Live } from "./live.js";
import { languageFiles, openLanguage } from "./language.js";

const WALK = "a person walks forward"; // what the person does on the way to a waypoint

const worker = new Worker("live_worker.js", { type: "module" }), waiting = new Map();
worker.addEventListener("message", ({ data: { id, result, error } }) => {
  const { done, fail } = waiting.get(id);
  waiting.delete(id);
  if (error === undefined) done(result);
  else fail(new Error(error));
});
worker.addEventListener("error", ({ message }) => {
  for (const { fail } of waiting.values()) fail(new Error(message || "the worker cannot start"));
});

let count = 0;
function call(name, values) {
  return new Promise((done, fail) => {
    waiting.set(++count, { done, fail });
    worker.postMessage({ id: count, call: name, ...values });
  });
}

const frames = []; // joints of each frame, for `joints()`
const source = {
  async block(request) {
    const block = await call("block", request), one = block.joints.length / block.frames;
    frames.length = block.from;
    for (let k = 0; k < block.frames; k++) frames.push(Array.from(block.joints.subarray(k * one, (k + 1) * one)));
    if (frames.length > 3000) frames.fill(null, 0, frames.length - 3000);
    return block;
  },
  cancel: () => worker.postMessage({ call: "cancel" }),
  file: (ending) => call("file", { ending }),
};

/** Returns the model's caption for walking; null if there is none, or if the model's path cannot bend. */
function walking(read, content) {
  try {
    return content.root ? read(WALK) : null;
  } catch {
    return null;
  }
}

async function open() {
  const status = document.getElementById("status");
  try {
    const seed = new URLSearchParams(location.hash.slice(1)).get("seed") ?? "0";
    if (!/^-?\d{1,18}$/.test(seed)) throw new Error(`seed=${seed}: give a whole number`);
    const answers = [call("open", { seed }), languageFiles(), fetch("player.html").then((answer) => answer.text())];
    const [{ content }, files, player] = await Promise.all(answers);
    const { reader } = openLanguage(content, files);
    const read = (text) => {
      const { captions } = reader.read(text);
      return captions.length === 1 ? captions[0] : text;
    };
    const text = content.captions.find((caption) => /\bstands still\b/.test(caption)) ?? "a person stands";
    const page = { read, text, walk: walking(read, content), fps: content.fps, player: (motion) => player.replace("__DATA__", () => JSON.stringify([motion]).replaceAll("<", "\\u003c")) };
    window.live = new Live(document.getElementById("live"), source, page);
    await window.live.start();
    status.hidden = true;
    document.body.dataset.ready = "true";
  } catch (error) {
    status.className = "error";
    status.textContent = `The stream cannot be opened: ${error.message.split("\n")[0]}. Reload the page, or build it again`;
  }
}

window.joints = () => frames;
open();
