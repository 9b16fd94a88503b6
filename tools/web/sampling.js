// Samples motions with onnxruntime-web: a port of flame_mdm/checkpoints/runner.py. The same text, length and seed yield
// the same motion.
import * as ort from "./ort/ort.wasm.min.mjs";
import { check, frameCount } from "./check.js";
import { bends, reached } from "./waypoints.js";

ort.env.wasm.wasmPaths = new URL("./ort/", import.meta.url).href;
ort.env.wasm.numThreads = 1; // threads need headers that a static server does not send
ort.env.logLevel = "error";

const MIN_WORDS = 3, fround = Math.fround, TURN = fround(2 * Math.PI), SCALE = 2 ** -24;

export const words = (text) => text.toLowerCase().match(/[\p{L}\p{N}]+/gu) ?? [];
const digest = async (bytes) => new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
const integers = (numbers, shape) => new ort.Tensor("int64", BigInt64Array.from(numbers, BigInt), shape);

const NUMBERS = "zero one two three four five six seven eight nine ten eleven twelve".split(" ");

export function knownForm(word, seen) { // see flame_mdm.conditions.vocabulary.known_form
  if (NUMBERS.includes(word) && !seen.has(word)) return undefined; // "four" is no form of "fours"
  const stems = ["ing", "ed", "es", "s", "d", ""].filter((end) => word.endsWith(end)).map((end) => word.slice(0, word.length - end.length));
  stems.push(...stems.filter((stem) => stem.length > 3 && ["e", stem.at(-2)].includes(stem.at(-1))).map((stem) => stem.slice(0, -1)));
  const forms = stems.filter((stem) => stem.length > 2).flatMap((stem) => ["", "e", "s", "es", "ing", "ed"].map((end) => stem + end));
  return [word, ...forms].find((form) => seen.has(form));
}

function hashed(word, buckets) { // CRC-32 of a word -> two rows of the word table
  let crc = -1;
  for (const byte of new TextEncoder().encode(word)) {
    crc ^= byte;
    for (let k = 0; k < 8; k++) crc = (crc >>> 1) ^ (crc & 1 ? 0xedb88320 : 0);
  }
  crc = ~crc >>> 0;
  return [crc % buckets, Math.floor(crc / buckets) % buckets];
}

// ---- noise: splitmix64 on two 32-bit halves, and Box-Muller in single precision ----
let high = 0, low = 0;
function add(h, l) {
  const sum = low + l;
  high = (high + h + (sum > 0xffffffff)) >>> 0;
  low = sum >>> 0;
}
function multiply(h, l) {
  const a = low & 0xffff, b = low >>> 16, c = l & 0xffff, d = l >>> 16, middle = a * d + b * c + Math.floor(a * c / 65536);
  high = (b * d + Math.floor(middle / 65536) + Math.imul(high, l) + Math.imul(low, h)) >>> 0;
  low = ((middle & 0xffff) << 16 | (a * c) & 0xffff) >>> 0;
}
function fold(bits) {
  low = (low ^ (high << (32 - bits) | low >>> bits)) >>> 0;
  high = (high ^ high >>> bits) >>> 0;
}
function mix() {
  add(0x9e3779b9, 0x7f4a7c15); fold(30);
  multiply(0xbf58476d, 0x1ce4e5b9); fold(27);
  multiply(0x94d049bb, 0x133111eb); fold(31);
}

export function normal(key, draw, frames, features) { // key: 64 bits; standard normal noise (frames * features)
  const number = BigInt.asUintN(64, key + BigInt(draw)), noise = new Float32Array(frames * features);
  [high, low] = [Number(number >> 32n), Number(number & 0xffffffffn)];
  mix(); mix();
  let [h, l] = [high, low];
  for (let frame = 0; frame < frames; frame++) for (let k = 0; k < features; k += 2) {
    [high, low] = [h, l];
    mix();
    const u = fround(fround((low & 0xffffff) + 0.5) * SCALE), angle = fround(TURN * fround(fround((high >>> 8) + 0.5) * SCALE));
    const radius = fround(Math.sqrt(-2 * fround(Math.log(u))));
    noise[frame * features + k] = radius * fround(Math.cos(angle));
    if (k + 1 < features) noise[frame * features + k + 1] = radius * fround(Math.sin(angle));
    [high, low] = [h, l];
    add(0x9e3779b9, 0x7f4a7c15);
    [h, l] = [high, low];
  }
  return noise;
}

async function noiseKey(seed, name) { // 63 bits
  const bytes = await digest(new TextEncoder().encode(["noise", seed, 0, name].join("\x1f")));
  return bytes.slice(0, 8).reduce((sum, byte) => sum << 8n | BigInt(byte), 0n) >> 1n;
}

// ---- the model ----
export async function download(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name}: ${answer.status} ${answer.statusText}`);
  return answer.arrayBuffer();
}

export async function json(name) {
  const text = new TextDecoder().decode(await download(name));
  try { return JSON.parse(text); } catch { throw new Error(`${name} is damaged: not JSON`); }
}

export class Sampler {
  // Opens the model in a folder. The graph of rotations is opened when it is first used.
  static async open(folder = "") {
    if (!globalThis.crypto?.subtle) throw new Error("this page needs https, or http://localhost");
    const sampler = new Sampler();
    sampler.folder = folder;
    sampler.content = await json(`${folder}model.json`);
    check(sampler.content);
    [sampler.denoiser, sampler.joints] = await Promise.all(["denoiser.onnx", "joints.onnx"].map((name) => sampler.graph(name)));
    return sampler;
  }

  async graph(name) {
    const bytes = await download(this.folder + name), hash = Array.from(await digest(bytes), (b) => b.toString(16).padStart(2, "0")).join("");
    if (hash !== this.content.sha256[name]) throw new Error(`${name} has changed since it was exported`);
    try { return await ort.InferenceSession.create(bytes); } catch { throw new Error(`${name} is damaged`); }
  }

  // Returns normalized features (frames * D). The model reads the text, and the noise depends on the name.
  async generate(text, seconds, seed, progress = () => {}, name = text) {
    const frames = frameCount(seconds, this.content), { features, start, padded_frames: least } = this.content;
    if (start) {
      const stream = new Stream(this, seed, `${name}#0`), blocks = Math.ceil(frames / stream.size);
      const x = new Float32Array(blocks * stream.size * features);
      for (let k = 0; k < blocks; k++) {
        x.set(await stream.features(text, (share) => progress((k + share) / blocks)), k * stream.size * features);
      }
      return x.slice(0, frames * features);
    }
    const x = await this.sample(text, Math.max(frames, least), frames, await noiseKey(seed, `${name}#0`), {}, progress);
    return x.slice(0, frames * features);
  }

  // Returns normalized features (padded * D) of frames that are sampled together, from the noise for a key. `guide` changes
  // the clean estimates.
  async sample(text, padded, frames, key, more = {}, progress = () => {}, guide = () => {}) {
    const { features, steps, clip_x0: clip, buckets, max_words: most } = this.content;
    const seen = new Set(this.content.vocabulary);
    const read = seen.size ? words(text).map((word) => knownForm(word, seen)).filter(Boolean) : words(text);
    const rows = ["<start>", ...read.slice(0, most)].map((word) => hashed(word, buckets)), count = rows.length;
    while (rows.length < MIN_WORDS) rows.push([0, 0]);
    const fixed = { lengths: integers([frames], [1]), counts: integers([count], [1]), condition: integers(rows.flat(), [1, rows.length, 2]), ...more };
    const shape = [1, padded, features];
    let x = normal(key, 0, padded, features), draw = 1;
    let before = new Float32Array(x.length);
    for (const [number, [t, p, q, a, b, c, d]] of steps.entries()) {
      const inputs = { x_t: new ort.Tensor("float32", x, shape), t: new ort.Tensor("float32", [t], [1]), ...fixed };
      const y = (await this.denoiser.run(inputs)).output.data, noise = d ? normal(key, draw++, padded, features) : null;
      const x0 = x.map((value, i) => {
        const clean = p * value + q * y[i];
        return clip ? Math.min(1, Math.max(-1, clean)) : clean;
      });
      guide(x0);
      x = x.map((value, i) => a * value + b * x0[i] + c * before[i] + (noise ? d * noise[i] : 0));
      before = x0;
      await progress((number + 1) / steps.length);
    }
    if (!x.every(Number.isFinite)) throw new Error("the model returned non-finite numbers");
    return x;
  }

  async decode(x) { // joints (frames * J * 3) in meters, y up
    const { features } = this.content;
    return (await this.joints.run({ x: new ort.Tensor("float32", x, [1, x.length / features, features]) })).joints.data;
  }

  async openPoses() { // the graph of rotations
    this.poses ??= await this.graph("poses.onnx");
  }

  async rotations(joints) { // offsets (22 * 3) of the rest pose and local quaternions (frames * 22 * 4), w first
    await this.openPoses();
    const { offsets, quaternions } = await this.poses.run({ joints: new ort.Tensor("float32", joints, [joints.length / 66, 22, 3]) });
    return { offsets: offsets.data, quaternions: quaternions.data };
  }
}

const HELD = 4; // blocks that can be replaced

// An endless motion: a port of flame_mdm/sampling/streams.py. Frames that have not been shown yet can be replaced.
export class Stream {
  constructor(sampler, seed, name) {
    const { start, max_frames: longest, features } = sampler.content;
    const prefix = Float32Array.from(start.flat());
    Object.assign(this, { sampler, seed, name, context: start.length, size: longest - start.length, width: features });
    Object.assign(this, { prefix, number: 0, frames: 0, world: null, blocks: [] });
  }

  // Returns the normalized features of the next block.
  async features(text, progress, guide) {
    const { sampler, size, context, width } = this;
    this.name ??= `${text}#0`;
    const key = await noiseKey(this.seed, `${this.name}\x1f${this.number}`);
    const prefix = { prefix: new ort.Tensor("float32", this.prefix, [1, context, width]) };
    const sampled = await sampler.sample(text, size, size, key, prefix, progress, guide);
    const x = joined(this.prefix.subarray(-2 * width), sampled, width, sampler.content.fade);
    this.blocks = [...this.blocks.slice(1 - HELD), { begin: this.frames, number: this.number, prefix: this.prefix, x, world: this.world }];
    this.#continueAfter(size);
    return x;
  }

  // Returns the world joints of the next block, which leads to waypoints, and the numbers of the frames that reach them.
  async block(text, points = [], progress = undefined) {
    const { width, world: before, frames } = this, last = this.prefix.slice(-width);
    const guide = points.length ? await this.#guide(points) : undefined;
    const x = await this.features(text, progress, guide);
    const joints = await this.sampler.decode(Float32Array.of(...last, ...x)), one = joints.length / (this.size + 1);
    let placed = before ? inPlace(joints, one, before) : (await this.sampler.decode(x)).slice();
    if (before) placed = placed.subarray(one);
    this.blocks.at(-1).joints = placed;
    this.world = placed.slice(-one);
    return { joints: placed, reached: reached(points, placed, one, frames) };
  }

  // Returns a function that bends the path in clean estimates.
  async #guide(points) {
    const { width, size, sampler } = this, { root, fps } = sampler.content, { heading, place } = await this.#start();
    const [turn, side, ahead] = root, units = ([mean, std], value) => mean + std * value;
    return (x0) => {
      const rows = Array.from({ length: size }, (_, k) => x0.subarray(k * width, k * width + 3));
      const steps = rows.map((row) => [units(side, row[1]), units(ahead, row[2])]);
      const added = bends(rows.map((row) => units(turn, row[0])), steps, heading, place, points, fps);
      rows.forEach((row, k) => { row[0] += added[k] / turn[1]; });
    };
  }

  // Returns the heading and position of the root in the first frame of the next block, one step after the last frame.
  async #start() {
    const { width, world, sampler } = this, last = this.prefix.slice(-width), [[mean, std]] = sampler.content.root;
    if (!world) return { heading: 0, place: [0, 0] };
    const joints = await sampler.decode(Float32Array.of(...last, ...last)), one = joints.length / 2;
    const next = inPlace(joints, one, world).subarray(one);
    return { heading: turnTo(joints.subarray(0, one), world).turn + mean + std * last[0], place: [next[0], next[2]] };
  }

  // Drops a frame and all later frames, so that the next block continues the frames before it.
  goBack(frame) {
    if (frame === this.frames) return;
    while (this.blocks.length && this.blocks.at(-1).begin >= frame) this.blocks.pop();
    const block = this.blocks.at(-1);
    if (!block || frame > this.frames) throw new Error(`frame ${frame} is not one of the last ${HELD} blocks`);
    const kept = frame - block.begin, one = block.joints.length / this.size;
    Object.assign(this, { prefix: block.prefix, number: block.number, frames: block.begin });
    this.#continueAfter(kept);
    this.world = block.joints.slice((kept - 1) * one, kept * one);
  }

  #continueAfter(kept) {
    const { width, context } = this, all = Float32Array.of(...this.prefix, ...this.blocks.at(-1).x);
    this.prefix = all.slice(kept * width, (kept + context) * width);
    this.number += 1;
    this.frames += kept;
  }
}

// Returns a block (frames * width) whose first frames are moved to continue the previous frames (2 * width): a port of
// `joined` in flame_mdm/generator.py.
function joined(before, x, width, fade) {
  if (!fade) return x;
  const moved = x.slice(), frames = Math.min(fade.frames, x.length / width);
  for (let k = fade.begin; k < fade.end; k++) {
    const jump = before[width + k] + (before[width + k] - before[k] + x[width + k] - x[k]) / 2 - x[k];
    for (let frame = 0; frame < frames; frame++) {
      const share = frame / fade.frames;
      moved[frame * width + k] += (1 - share) ** 2 * (1 + 2 * share) * jump;
    }
  }
  return moved;
}

// Returns the turn about the vertical axis that moves a pose to a pose in the world, and the centers of both.
function turnTo(pose, world) {
  const mean = (joints, k) => joints.reduce((sum, value, i) => (i % 3 === k ? sum + value : sum), 0) / (joints.length / 3);
  const [ax, az, bx, bz] = [mean(pose, 0), mean(pose, 2), mean(world, 0), mean(world, 2)];
  let sine = 0, cosine = 0;
  for (let i = 0; i < pose.length; i += 3) {
    const [x, z, u, v] = [pose[i] - ax, pose[i + 2] - az, world[i] - bx, world[i + 2] - bz];
    sine += z * u - x * v;
    cosine += x * u + z * v;
  }
  return { turn: Math.atan2(sine, cosine), from: [ax, az], to: [bx, bz] };
}

// Returns the joints of frames after a turn about the vertical axis and a shift over the floor that move the first frame
// to a pose in the world.
function inPlace(joints, one, world) {
  const { turn, from: [ax, az], to: [bx, bz] } = turnTo(joints.subarray(0, one), world), [s, c] = [Math.sin(turn), Math.cos(turn)];
  const placed = new Float32Array(joints);
  for (let i = 0; i < joints.length; i += 3) {
    const [x, z] = [joints[i] - ax, joints[i + 2] - az];
    placed[i] = c * x + s * z + bx;
    placed[i + 2] = c * z - s * x + bz;
  }
  return placed;
}
