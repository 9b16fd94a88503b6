// Converts rotations to the player's body, BVH and GLB; fbx.js writes FBX. Quaternions are [w, x, y, z]. tools/web.py
// writes figure.json.
const clamp = (x, least, most) => Math.min(most, Math.max(least, x));
const base64 = (array) => btoa(Array.from(new Uint8Array(array.buffer), (byte) => String.fromCharCode(byte)).join(""));
const inverse = ([w, x, y, z]) => [w, -x, -y, -z];
const about = (axis, angle) => [Math.cos(angle / 2), ...axis.map((c) => c * Math.sin(angle / 2))];
function times([a, b, c, d], [w, x, y, z]) {
  return [a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y, a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w];
}

// Returns the world rotations of the mannequin's 22 joints in a frame. Soles are flat, the head is level, and toes bend on
// the floor.
function posed(figure, { joints, quaternions }, frame) {
  const world = [], { toes: [near, far, most], parents } = figure;
  for (const [j, parent] of parents.entries()) {
    const at = 4 * (22 * frame + j), local = Array.from(quaternions.subarray(at, at + 4));
    world.push(j ? times(world[parent], local) : local);
  }
  const fitted = world.map((q, j) => times(q, figure.neutral[j]));
  for (const toe of figure.feet) {
    const [w, x, y, z] = fitted[toe], down = clamp(Math.asin(clamp(2 * (w * x - y * z), -1, 1)), 0, most);
    const height = joints[3 * (22 * frame + toe) + 1];
    fitted[toe] = times(fitted[toe], about([1, 0, 0], -down * clamp((far - height) / (far - near), 0, 1)));
  }
  return fitted;
}

// Returns the rotations of the mannequin's joints relative to their parents, by frame and joint.
export function localRotations(figure, motion) {
  return Array.from({ length: motion.frames }, (_, frame) => {
    const world = posed(figure, motion, frame).map((q, j) => times(q, inverse(figure.neutral[j])));
    return world.map((q, j) => (j ? times(inverse(world[figure.parents[j]]), q) : q));
  });
}

// Returns angles about z, y and x in radians. Of the two triples that describe a rotation, up to full turns, the triple
// nearest to `before` is returned.
export function angles([w, x, y, z], before) {
  const first = [
    Math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)),
    Math.asin(clamp(2 * (w * y - x * z), -1, 1)),
    Math.atan2(2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
  ];
  const second = [first[0] + Math.PI, Math.PI - first[1], first[2] + Math.PI];
  const near = (angle, k) => angle + 2 * Math.PI * Math.round((before[k] - angle) / 2 / Math.PI);
  const choices = [first.map(near), second.map(near)];
  const [distance, other] = choices.map((choice) => choice.reduce((sum, angle, k) => sum + Math.abs(angle - before[k]), 0));
  return choices[other < distance ? 1 : 0];
}

export function shown(figure, motion) { // the motion as data for the player
  const { joints, frames } = motion, ends = [0, 1, 2].map((k) => joints.filter((_, i) => i % 3 === k)).map((c) => [c.reduce((a, b) => Math.min(a, b)), c.reduce((a, b) => Math.max(a, b))]);
  const center = ends.map(([least, most]) => (least + most) / 2), step = Math.max(0.001, ...ends.map(([least, most]) => (most - least) / 65534));
  const turns = new Uint32Array(frames * figure.stored.length);
  for (let frame = 0; frame < frames; frame++) {
    const bones = posed(figure, motion, frame);
    for (const { joint, above, below, share, axis } of figure.helpers) {
      const [w, ...xyz] = times(inverse(bones[above]), bones[below]);
      const twist = 2 * Math.atan2(xyz[0] * axis[0] + xyz[1] * axis[1] + xyz[2] * axis[2], w), wrapped = twist - 2 * Math.PI * Math.round(twist / 2 / Math.PI);
      bones.push(times(bones[joint], about(axis, share * wrapped)));
    }
    for (const [b, bone] of bones.entries()) { // 32 bits: which of x, y, z, w is largest, and the others
      const [w, x, y, z] = times(bone, figure.stored[b]), q = [x, y, z, w], largest = q.reduce((best, c, k) => (Math.abs(c) > Math.abs(q[best]) ? k : best), 0);
      const bits = q.filter((_, k) => k !== largest).map((c) => Math.round(clamp(c * Math.sign(q[largest]) / Math.SQRT2 + 0.5, 0, 1) * 1023));
      turns[frame * figure.stored.length + b] = largest << 30 | bits[0] << 20 | bits[1] << 10 | bits[2];
    }
  }
  const packed = Int16Array.from(joints, (x, i) => Math.round((x - center[i % 3]) / step));
  return { ...figure.motion, id: `seed ${motion.seed}`, caption: motion.text, frames, center, step, joints: base64(packed), body: { ...figure.motion.body, turns: base64(turns) } };
}

export function bvh(figure, { joints, quaternions, offsets, frames }, fps) { // centimeters, y up
  const hierarchy = (j, indent) => {
    const at = j ? [0, 1, 2].map((k) => (100 * offsets[3 * j + k]).toFixed(5)) : [0, 0, 0], inner = `${indent}  `;
    const below = figure.parents.flatMap((parent, child) => (parent === j ? [hierarchy(child, inner)] : []));
    if (!below.length) below.push(`${inner}End Site\n${inner}{\n${inner}  OFFSET ${figure.ends[j].map((c) => (100 * c).toFixed(5)).join(" ")}\n${inner}}\n`);
    return `${indent}${j ? "JOINT" : "ROOT"} ${figure.names[j]}\n${indent}{\n${inner}OFFSET ${at.join(" ")}\n${inner}CHANNELS ${j ? 3 : "6 Xposition Yposition Zposition"} Zrotation Yrotation Xrotation\n${below.join("")}${indent}}\n`;
  };
  const order = [];
  const visit = (j) => { order.push(j); figure.parents.forEach((parent, child) => parent === j && visit(child)); };
  visit(0);
  const last = [];
  const lines = Array.from({ length: frames }, (_, f) => order.flatMap((j) => {
    const at = 22 * f + j;
    last[j] = angles(quaternions.subarray(4 * at, 4 * at + 4), last[j] ?? [0, 0, 0]);
    const root = j ? [] : [0, 1, 2].map((k) => (100 * joints[3 * at + k]).toFixed(5));
    return [...root, ...last[j].map((angle) => (angle * 180 / Math.PI).toFixed(6))];
  }).join(" "));
  return `HIERARCHY\n${hierarchy(0, "")}MOTION\nFrames: ${frames}\nFrame Time: ${(1 / fps).toFixed(8)}\n${lines.join("\n")}\n`;
}

export function glb(figure, template, motion, fps, text) { // the mannequin in template.glb with another animation
  const view = new DataView(template), size = view.getUint32(12, true), begin = 20 + size + 8;
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(template, 20, size))), parts = [new Uint8Array(template, begin, document.buffers[0].byteLength)];
  let end = parts[0].length;
  const store = (numbers, type, bounds) => {
    document.bufferViews.push({ buffer: 0, byteOffset: end, byteLength: numbers.byteLength });
    document.accessors.push({ bufferView: document.bufferViews.length - 1, componentType: 5126, type, count: motion.frames, ...bounds });
    parts.push(new Uint8Array(numbers.buffer));
    end += numbers.byteLength;
    return document.accessors.length - 1;
  };
  while (end % 4) { parts.push(new Uint8Array(1)); end++; }
  const seconds = Float32Array.from({ length: motion.frames }, (_, f) => f / fps), input = store(seconds, "SCALAR", { min: [0], max: [seconds.at(-1)] });
  const local = localRotations(figure, motion);
  const curves = figure.parents.map((_, j) => [j, "rotation", store(Float32Array.from(local.flatMap((f) => { const [w, ...xyz] = f[j]; return [...xyz, w]; })), "VEC4")]);
  const root = Float32Array.from({ length: 3 * motion.frames }, (_, i) => motion.joints[66 * Math.floor(i / 3) + i % 3]);
  curves.push([0, "translation", store(root, "VEC3")]);
  document.animations = [{ name: text, samplers: curves.map(([, , output]) => ({ input, output })), channels: curves.map(([node, path], sampler) => ({ sampler, target: { node, path } })) }];
  document.asset.extras = { ...document.asset.extras, fps, text };
  for (let j = 1; j < 22; j++) document.nodes[j].translation = Array.from(motion.offsets.subarray(3 * j, 3 * j + 3));
  document.buffers[0].byteLength = end;
  let head = new TextEncoder().encode(JSON.stringify(document));
  head = new Uint8Array([...head, ...Array((4 - head.length % 4) % 4).fill(32)]);
  const chunk = (length, kind) => new Uint8Array(Uint32Array.of(length, kind).buffer), total = 28 + head.length + end;
  return new Blob([chunk(0x46546c67, 2), new Uint8Array(Uint32Array.of(total).buffer), chunk(head.length, 0x4e4f534a), head, chunk(end, 0x004e4942), ...parts], { type: "model/gltf-binary" });
}
