// Loads a VRM animation with three-vrm-animation and prints the tracks of its humanoid.
// node three_vrma.mjs FOLDER_OF_NODE_MODULES FILE
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, file] = process.argv.slice(2);
globalThis.self = globalThis;
const { GLTFLoader } = await import(pathToFileURL(`${folder}/node_modules/three/examples/jsm/loaders/GLTFLoader.js`));
const { VRMAnimationLoaderPlugin } = await import(
  pathToFileURL(`${folder}/node_modules/@pixiv/three-vrm-animation/lib/three-vrm-animation.module.js`));

const loader = new GLTFLoader();
loader.register((parser) => new VRMAnimationLoaderPlugin(parser));
const content = readFileSync(file);
const buffer = content.buffer.slice(content.byteOffset, content.byteOffset + content.length);
loader.parse(buffer, "", (gltf) => {
  const animation = gltf.userData.vrmAnimations[0];
  const tracks = { rotation: {}, translation: {} };
  for (const kind of ["rotation", "translation"]) {
    for (const [name, track] of animation.humanoidTracks[kind]) tracks[kind][name] = Array.from(track.values);
  }
  console.log(JSON.stringify({ ...tracks, hips: animation.restHipsPosition.toArray() }));
}, (error) => { console.error(error); process.exit(1); });
