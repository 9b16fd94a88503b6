// Writes FBX files: the person in template.fbx with a different animation. The template (binary FBX 7.4 in centimeters)
// was written by flame_mdm/formats/fbx_writer.py, which explains what each program requires. Everything else in the
// template is copied unchanged.
// A record is { name, properties, children }. Properties are encoded values; children are null if there is no list.
import { angles, localRotations } from "./figure.js";

const TICKS = 46186158000; // per second
const PER_METER = 100;
const FIRST_RECORD = 27; // after the signature and the version
const FOOTER_ID = 16, FOOTER_END = 140; // bytes of the two constant parts of the footer
const TERMINATOR = 13; // zeros that end a list of records
const SCALARS = { C: 1, Y: 2, I: 4, F: 4, D: 8, L: 8 }; // bytes by type
const AXES = ["d|X", "d|Y", "d|Z"];

export async function fbx(figure, template, motion, fps, text) {
  const { records, end } = parse(template);
  const take = first(first(records, "Takes"), "Take"), objects = first(records, "Objects").children;
  const duration = int64(Math.round((motion.frames - 1) / fps * TICKS));

  first(first(records, "Takes"), "Current").properties = [string(text)];
  take.properties = [string(text)];
  for (const name of ["LocalTime", "ReferenceTime"]) first(take, name).properties[1] = duration;
  setProperty(first(records, "GlobalSettings"), "TimeSpanStop", duration);
  const stack = objects.find(({ name }) => name === "AnimationStack");
  stack.properties[1] = string(`${text}\x00\x01AnimStack`);
  for (const name of ["LocalStop", "ReferenceStop"]) setProperty(stack, name, duration);

  const scene = linked(figure, objects, first(records, "Connections").children);
  await resize(figure, motion, scene);
  animate(figure, motion, fps, scene);
  return new Blob(written(template, records, end), { type: "application/octet-stream" });
}

// Returns the objects by id, the joint of each bone and of each cluster of its vertices, and the property that each curve
// changes: a curve belongs to an axis of a node, and the node to a property of a bone.
function linked(figure, objects, connections) {
  const byId = new Map(objects.map((record) => [readId(record.properties[0]), record]));
  const joints = new Map(), targets = new Map();
  for (const [id, { name, properties }] of byId) {
    const joint = figure.names.indexOf(readString(properties[1]).split("\x00")[0]);
    if (joint >= 0 && (name === "Model" || readString(properties[2]) === "Cluster")) joints.set(id, joint);
  }
  for (const { properties: [kind, child, parent, target] } of connections) {
    if (readString(kind) === "OP") targets.set(readId(child), [readId(parent), readString(target)]);
  }
  return { byId, joints, targets };
}

// Gives the skeleton and the skin the bone lengths of the motion. This includes the bind pose of the skin, because Blender
// connects bones in this pose, and connected bones cannot move.
async function resize(figure, motion, { byId, joints }) {
  const records = [...byId.values()];
  const { matrices, shifts } = await boundPose(figure, motion, records.find(({ name }) => name === "Pose"), joints);
  const geometry = records.find(({ name }) => name === "Geometry");
  const vertices = await arrayOf(geometry, "Vertices");
  for (const [id, joint] of joints) {
    const record = byId.get(id);
    if (record.name === "Model") {
      if (joint) setProperty(record, "Lcl Translation", ...offset(motion, joint).map(float64));
      continue;
    }
    const inverse = await arrayOf(record, "Transform");
    inverse.set(AXES.map((_, k) => -dot(matrices[joint].subarray(4 * k), matrices[joint].subarray(12))), 12);
    first(record, "Transform").properties = [doubles(inverse)];
    first(record, "TransformLink").properties = [doubles(matrices[joint])];
    const indices = await arrayOf(record, "Indexes"), weights = await arrayOf(record, "Weights");
    for (const [number, vertex] of indices.entries()) {
      for (const k of [0, 1, 2]) vertices[3 * vertex + k] += weights[number] * shifts[joint][k];
    }
  }
  first(geometry, "Vertices").properties = [doubles(vertices)];
}

// Changes the pose. Returns the world matrices by joint, and how far the joints move. The last four of the 16 numbers in a
// matrix are its translation.
async function boundPose(figure, motion, pose, joints) {
  const matrices = [], shifts = [];
  for (const node of pose.children.filter(({ name }) => name === "PoseNode")) {
    const joint = joints.get(readId(first(node, "Node").properties[0]));
    if (joint === undefined) continue; // the mesh
    const matrix = await arrayOf(node, "Matrix"), before = matrix.slice(12, 15);
    if (joint) { // parents precede their children
      const above = matrices[figure.parents[joint]], bone = offset(motion, joint);
      matrix.set(AXES.map((_, k) => dot([above[k], above[4 + k], above[8 + k]], bone) + above[12 + k]), 12);
    }
    matrices[joint] = matrix;
    shifts[joint] = before.map((value, k) => matrix[12 + k] - value);
    first(node, "Matrix").properties = [doubles(matrix)];
  }
  return { matrices, shifts };
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const offset = ({ offsets }, joint) => Array.from(offsets.subarray(3 * joint, 3 * joint + 3), (meters) => PER_METER * meters);

function animate(figure, motion, fps, { byId, joints, targets }) {
  const times = int64s(Array.from({ length: motion.frames }, (_, frame) => Math.round(frame / fps * TICKS)));
  const degrees = rotations(figure, motion);
  for (const [id, record] of byId) {
    if (record.name !== "AnimationCurve") continue;
    const [node, axisName] = targets.get(id), [bone, property] = targets.get(node);
    const joint = joints.get(bone), axis = AXES.indexOf(axisName);
    const turns = property === "Lcl Rotation";
    const values = turns ? degrees.map((frame) => frame[joint][axis]) : rootPath(figure, motion, axis);
    setProperty(byId.get(node), axisName, float64(values[0]));
    first(record, "Default").properties = [float64(values[0])];
    first(record, "KeyTime").properties = [times];
    first(record, "KeyValueFloat").properties = [floats(values)];
    first(record, "KeyAttrRefCount").properties = [int32s([motion.frames])];
  }
}

function rotations(figure, motion) { // degrees about x, y and z by frame and joint
  let before = figure.names.map(() => [0, 0, 0]);
  return localRotations(figure, motion).map((quaternions) => {
    before = quaternions.map((quaternion, joint) => angles(quaternion, before[joint]));
    return before.map(([z, y, x]) => [x, y, z].map((angle) => angle * 180 / Math.PI));
  });
}

function rootPath({ names, lift }, { joints, frames }, axis) { // of the pelvis, with the soles on the floor
  const up = axis === 1 ? lift : 0;
  return Array.from({ length: frames }, (_, frame) => PER_METER * (joints[3 * names.length * frame + axis] + up));
}

// Records

const first = (record, name) => (record.children ?? record).find((child) => child.name === name);

function setProperty(record, name, ...values) { // the values follow name, type, label and flags
  const property = first(record, "Properties70").children.find(({ properties }) => readString(properties[0]) === name);
  property.properties.splice(4, values.length, ...values);
}

function parse(template) { // the records, and where their list ends
  const view = new DataView(template), decoder = new TextDecoder();

  const property = (start) => {
    const code = String.fromCharCode(view.getUint8(start)), first = start + 1;
    if (code in SCALARS) return first + SCALARS[code];
    if (code === "S" || code === "R") return first + 4 + view.getUint32(first, true);
    return first + 12 + view.getUint32(first + 8, true); // an array: number of items, encoding, bytes
  };
  const list = (position, limit) => {
    const records = [];
    while (position < limit) {
      const end = view.getUint32(position, true);
      if (!end) return { records, end: position + TERMINATOR };
      const count = view.getUint32(position + 4, true), length = view.getUint8(position + 12), properties = [];
      const name = decoder.decode(new Uint8Array(template, position + TERMINATOR, length));
      position += TERMINATOR + length;
      for (let number = 0; number < count; number++) {
        const next = property(position);
        properties.push(new Uint8Array(template, position, next - position));
        position = next;
      }
      records.push({ name, properties, children: position < end ? list(position, end).records : null });
      position = end;
    }
    return { records, end: position };
  };
  return list(FIRST_RECORD, template.byteLength);
}

function written(template, records, end) { // parts of the file, in their order
  const parts = [new Uint8Array(template, 0, FIRST_RECORD)];
  let size = FIRST_RECORD;
  const append = (bytes) => { parts.push(bytes); size += bytes.length; };
  const list = (records) => {
    for (const { name, properties, children } of records) {
      const label = new TextEncoder().encode(name), head = new Uint8Array(TERMINATOR + label.length);
      head[12] = label.length;
      head.set(label, TERMINATOR);
      append(head);
      const before = size;
      properties.forEach(append);
      const bytes = size - before;
      if (children) list(children);
      [size, properties.length, bytes].forEach((value, k) => new DataView(head.buffer).setUint32(4 * k, value, true));
    }
    append(new Uint8Array(TERMINATOR));
  };

  list(records);
  append(new Uint8Array(template, end, FOOTER_ID));
  append(new Uint8Array(4));
  append(new Uint8Array(16 - size % 16));
  append(new Uint8Array(template, template.byteLength - FOOTER_END));
  return parts;
}

// Values of properties: a letter for the type, then the value

function scalar(code, set, value) {
  const bytes = new Uint8Array(1 + SCALARS[code]);
  bytes[0] = code.charCodeAt(0);
  new DataView(bytes.buffer)[set](1, value, true);
  return bytes;
}

const int64 = (value) => scalar("L", "setBigInt64", BigInt(value));
const float64 = (value) => scalar("D", "setFloat64", value);

function string(text) {
  const content = new TextEncoder().encode(text), bytes = new Uint8Array(5 + content.length);
  bytes[0] = "S".charCodeAt(0);
  new DataView(bytes.buffer).setUint32(1, content.length, true);
  bytes.set(content, 5);
  return bytes;
}

function array(code, numbers) { // uncompressed
  const content = new Uint8Array(numbers.buffer), bytes = new Uint8Array(13 + content.length);
  const view = new DataView(bytes.buffer);
  bytes[0] = code.charCodeAt(0);
  [numbers.length, 0, content.length].forEach((value, k) => view.setUint32(1 + 4 * k, value, true));
  bytes.set(content, 13);
  return bytes;
}

async function arrayOf(record, name) { // number of items, encoding and size precede the items
  const [property] = first(record, name).properties, packed = property.slice(13);
  const Numbers = { d: Float64Array, i: Int32Array }[String.fromCharCode(property[0])];
  if (!property[5]) return new Numbers(packed.buffer);
  const unpacked = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Numbers(await new Response(unpacked).arrayBuffer());
}

const doubles = (values) => array("d", Float64Array.from(values));
const floats = (values) => array("f", Float32Array.from(values));
const int32s = (values) => array("i", Int32Array.from(values));
const int64s = (values) => array("l", BigInt64Array.from(values, BigInt));
const readId = (property) => new DataView(property.buffer, property.byteOffset).getBigInt64(1, true);
const readString = (property) => new TextDecoder().decode(property.subarray(5));
