// Loads FBX files with three.js and prints the positions of all bones at given times, in the unit of the file.
// node three_fbx.mjs FOLDER_OF_NODE_MODULES TIME,TIME,... FILE...
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, times, ...files] = process.argv.slice(2);
globalThis.window = globalThis;
const THREE = await import(pathToFileURL(`${folder}/node_modules/three/build/three.module.js`));
const { FBXLoader } = await import(pathToFileURL(`${folder}/node_modules/three/examples/jsm/loaders/FBXLoader.js`));

function read(file) {
  const content = readFileSync(file);
  const scene = new FBXLoader().parse(content.buffer.slice(content.byteOffset, content.byteOffset + content.length), "");
  const mixer = new THREE.AnimationMixer(scene);
  mixer.clipAction(scene.animations[0]).play();
  const frames = times.split(",").map(Number).map((time) => {
    mixer.setTime(time);
    scene.updateMatrixWorld(true);
    const positions = {};
    scene.traverse((node) => {
      if (node.isBone) positions[node.userData.originalName ?? node.name] = node.getWorldPosition(new THREE.Vector3()).toArray();
    });
    return positions;
  });
  let meshes = 0;
  const materials = new Set();
  scene.traverse((node) => {
    if (!node.isSkinnedMesh) return;
    meshes += 1;
    for (const material of [node.material].flat()) materials.add(material.name);
  });
  return { frames, meshes, materials: [...materials], animations: scene.animations.map((clip) => clip.name) };
}

console.log(JSON.stringify(files.map(read)));
