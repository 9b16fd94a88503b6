// Samples a stream in a worker, so that the page never waits, and keeps the last minute for files.
import { Sampler, Stream, download, json } from "./sampling.js";
import { bvh, glb, shown } from "./figure.js";
import { STREAM } from "./models.js";

const MINUTE = 60; // seconds that are kept
const BEFORE = 10; // frames before a block that its rotations fit
let sampler, figure, stream, joints, begin = 0, captions = "", isCanceled = false;

async function open(seed) {
  [sampler, figure] = await Promise.all([Sampler.open(STREAM), json("figure.json")]);
  stream = new Stream(sampler, seed);
  joints = new Float32Array(0);
  await sampler.openPoses();
  return { content: sampler.content };
}

const channel = new MessageChannel();

// Lets messages to the worker arrive between two steps. If the block is canceled, it ends, and nothing has changed.
async function afterStep() {
  await new Promise((done) => {
    channel.port1.onmessage = done;
    channel.port2.postMessage(null);
  });
  if (isCanceled) throw new Error("canceled");
}

async function block({ text, from, path }) {
  isCanceled = false;
  stream.goBack(from);
  const { joints: placed, reached } = await stream.block(text, path, afterStep), one = placed.length / stream.size;
  const least = Math.max(begin, stream.frames - MINUTE * sampler.content.fps);
  const kept = joints.subarray((least - begin) * one, (from - begin) * one);
  joints = new Float32Array(kept.length + placed.length);
  joints.set(kept);
  joints.set(placed, kept.length);
  begin = least;
  captions = text;
  const before = Math.min(BEFORE, from - begin);
  const { quaternions } = await sampler.rotations(joints.slice((from - begin - before) * one));
  const motion = { text, seed: 0, frames: stream.size, joints: placed, quaternions: quaternions.slice(4 * 22 * before) };
  return { from, frames: stream.size, reached, motion: shown(figure, motion), joints: placed };
}

async function file({ ending }) {
  const { fps } = sampler.content, motion = { frames: joints.length / 66, joints, ...(await sampler.rotations(joints)) };
  if (ending === "bvh") return new Blob([bvh(figure, motion, fps)], { type: "text/plain" });
  return glb(figure, await download("template.glb"), motion, fps, captions);
}

const calls = { open: ({ seed }) => open(seed), block, file };
let last = Promise.resolve(); // one call after another
addEventListener("message", ({ data: { id, call, ...values } }) => {
  if (call === "cancel") {
    isCanceled = true;
    return;
  }
  last = last.then(async () => {
    try {
      postMessage({ id, result: await calls[call](values) });
    } catch (error) {
      postMessage({ id, error: error.message });
    }
  });
});
