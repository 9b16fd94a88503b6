// Plays clips of a set with three.js: stands, starts to walk, walks, runs, stops, stands. The clips in place are blended;
// the character moves by the paths of the roots, blended with the same weights.
// node three_set.mjs FOLDER_OF_NODE_MODULES FOLDER_OF_SET
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, set] = process.argv.slice(2);
globalThis.window = globalThis;
const THREE = await import(pathToFileURL(`${folder}/node_modules/three/build/three.module.js`));
const { FBXLoader } = await import(pathToFileURL(`${folder}/node_modules/three/examples/jsm/loaders/FBXLoader.js`));
const STEP = 1 / 60;

// Walk and run are blended while the left foot passes the root in both.
const described = Object.fromEntries(JSON.parse(readFileSync(`${set}/set.json`)).clips.map((clip) => [clip.name, clip]));
const walk = described.Walk_Fwd_Loop, run = described.Run_Fwd_Loop, FADE = 0.12;
const leave = 1 + (walk.passing.left - FADE / 2) / walk.seconds, enter = run.passing.left - FADE / 2;

// Name of a clip, seconds of the fade from the clip before, where it begins, and cycles from its beginning to the next clip.
const TIMELINE = [
  ["Idle", 0, 0, 0.2],
  ["Walk_Fwd_Start", 0.1, 0, 1],
  ["Walk_Fwd_Loop", 0, 0, leave],
  ["Run_Fwd_Loop", FADE, enter, 2 - enter / run.seconds],
  ["Run_Fwd_Stop", 0, 0, 1],
  ["Idle", 0.2, 0, 0.5],
];

function read(name) {
  const content = readFileSync(`${set}/${name}.fbx`);
  return new FBXLoader().parse(content.buffer.slice(content.byteOffset, content.byteOffset + content.length), "");
}

const scene = read("Idle_InPlace");
const mixer = new THREE.AnimationMixer(scene);
const bone = (root, name) => root.getObjectByName(name);
const clips = {};
for (const [name] of TIMELINE) {
  if (clips[name]) continue;
  const moving = read(name), player = new THREE.AnimationMixer(moving), action = player.clipAction(moving.animations[0]);
  action.setLoop(THREE.LoopOnce);
  action.clampWhenFinished = true;
  action.play();
  const duration = moving.animations[0].duration;
  const at = (time) => {
    player.setTime(Math.min(Math.max(time, 0), duration - 1e-6));
    return bone(moving, "root").position.clone().divideScalar(100);
  };
  const slope = (time) => {
    const before = Math.max(time - 0.01, 0), after = Math.min(time + 0.01, duration);
    return at(after).sub(at(before)).divideScalar(after - before);
  };
  const loops = /Loop|Idle/.test(name);
  const velocity = (time) => (time < 0 || (time >= duration && !loops) ? new THREE.Vector3() :
    slope(loops ? time % duration : time));
  const still = mixer.clipAction(read(`${name}_InPlace`).animations[0], scene);
  clips[name] = { still, duration, velocity, loops };
}

const playing = []; // clip, its time, and its fade
const place = new THREE.Vector3(), frames = [];
let next = 0, left = 0;
for (;;) {
  if (left <= 1e-6) {
    if (next === TIMELINE.length) break;
    const [name, fade, begin, cycles] = TIMELINE[next++];
    playing.push({ name, time: begin - left, fade, age: -left });
    left += clips[name].duration * cycles;
  }
  // the newest clip fades in over those before it
  let rest = 1;
  const weights = {};
  for (const item of [...playing].reverse()) {
    const share = item === playing[0] || item.fade === 0 ? 1 : Math.min(1, item.age / item.fade);
    item.weight = rest * share;
    rest -= item.weight;
  }
  while (playing.length > 1 && playing[0].weight < 1e-6) playing.shift();
  for (const { still } of Object.values(clips)) still.stop();
  for (const item of playing) {
    const { still, duration, loops } = clips[item.name];
    item.shown = loops ? item.time % duration : Math.min(item.time, duration - 1e-6);
    still.play();
    still.time = item.shown;
    still.setEffectiveWeight(item.weight);
  }
  mixer.update(0);
  scene.updateMatrixWorld(true);
  const toes = ["ball_l", "ball_r"].map((name) => bone(scene, name).getWorldPosition(new THREE.Vector3()).divideScalar(100).add(place).toArray());
  frames.push({ toes, playing: playing.map(({ name, shown, weight }) => ({ name, time: shown, weight })) });
  for (const item of playing) {
    const { velocity, loops } = clips[item.name];
    place.addScaledVector(velocity((loops ? item.shown : item.time) + STEP / 2), item.weight * STEP);
    item.time += STEP;
    item.age += STEP;
  }
  left -= STEP;
}
console.log(JSON.stringify({ frames, place: place.toArray() }));
