// Loads FBX files with three.js and prints the positions of all bones at given times, in the unit of the file.
// node three_fbx.mjs FOLDER_OF_NODE_MODULES FILE TIME...
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, file, ...times] = process.argv.slice(2);
globalThis.window = globalThis;
const THREE = await import(pathToFileURL(`${folder}/node_modules/three/build/three.module.js`));
const { FBXLoader } = await import(pathToFileURL(`${folder}/node_modules/three/examples/jsm/loaders/FBXLoader.js`));

const content = readFileSync(file);
const scene = new FBXLoader().parse(content.buffer.slice(content.byteOffset, content.byteOffset + content.length), "");
const mixer = new THREE.AnimationMixer(scene);
mixer.clipAction(scene.animations[0]).play();
const frames = times.map(Number).map((time) => {
  mixer.setTime(time);
  scene.updateMatrixWorld(true);
  const positions = {};
  scene.traverse((node) => {
    if (node.isBone) positions[node.userData.originalName ?? node.name] = node.getWorldPosition(new THREE.Vector3()).toArray();
  });
  return positions;
});
let meshes = 0;
scene.traverse((node) => { meshes += node.isSkinnedMesh ? 1 : 0; });
console.log(JSON.stringify({ frames, meshes, animations: scene.animations.map((clip) => clip.name) }));
