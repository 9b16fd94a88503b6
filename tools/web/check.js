// Checks model.json and requests: a port of the checks in flame_mdm/checkpoints/runner.py.
import { SCHEMA } from "./schema.js"; // written by tools/web.py

const TYPES = {
  object: (value) => typeof value === "object" && value !== null && !Array.isArray(value),
  array: Array.isArray,
  string: (value) => typeof value === "string",
  boolean: (value) => typeof value === "boolean",
  integer: Number.isInteger,
  number: Number.isFinite,
};

export function faults(value, schema, name = "") { // dotted names of values that a JSON schema rejects
  const { type, minimum, maximum, pattern, minItems = 0, maxItems, items, properties = {}, required } = schema;
  if (!TYPES[type](value)) return [name];
  if (minimum !== undefined && !(minimum <= value && value <= maximum)) return [name];
  if (pattern !== undefined && !new RegExp(`^(?:${pattern})$`, "u").test(value)) return [name];
  if (type === "array") {
    const fits = minItems <= value.length && value.length <= maxItems;
    return fits && (!items || value.every((item) => !faults(item, items).length)) ? [] : [name];
  }
  return Object.entries(properties).flatMap(([key, part]) => {
    const full = name ? `${name}.${key}` : key;
    if (Object.hasOwn(value, key)) return faults(value[key], part, full);
    return required.includes(key) ? [full] : [];
  });
}

export function check(content) { // throws an error if the page cannot sample with a model
  const wrong = faults(content, SCHEMA);
  if (!wrong.length) {
    wrong.push(...["buckets", "max_words"].filter((name) => !(name in content)));
    if (![0, content.max_frames].includes(content.padded_frames)) wrong.push("padded_frames");
    const { start = [], features } = content;
    if (start.length > content.max_frames - 2 || start.some((row) => row.length !== features)) wrong.push("start");
    if (content.reads !== "text") wrong.push("reads");
    if (!content.sha256["poses.onnx"]) wrong.push("sha256.poses.onnx");
  }
  if (wrong.length) throw new Error(`model.json is damaged: ${wrong.join(", ")}`);
}

const LONGEST = 600; // maximum length in seconds for a model that continues frames

export function longestOf({ fps, max_frames: longest, start }) { // frames
  return start ? Math.round(LONGEST * fps) : longest;
}

export function frameCount(seconds, content) {
  const { fps } = content, longest = longestOf(content);
  const frames = Math.round(seconds * fps);
  if (!(frames >= 2 && frames <= longest)) throw new Error(`seconds=${seconds}: give ${2 / fps} to ${longest / fps} seconds`);
  return frames;
}
