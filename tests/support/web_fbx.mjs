// Writes the FBX file of the page that samples in the browser.
// node web_fbx.mjs FOLDER OUT.fbx: the folder has the page's scripts, figure.json, template.fbx and motion.json
import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, out] = process.argv.slice(2);
const { fbx } = await import(pathToFileURL(`${folder}/fbx.js`));
const [figure, { fps, text, frames, ...numbers }] = ["figure", "motion"].map((name) => JSON.parse(readFileSync(`${folder}/${name}.json`)));
const motion = { frames, ...Object.fromEntries(Object.entries(numbers).map(([name, values]) => [name, Float32Array.from(values)])) };
const template = readFileSync(`${folder}/template.fbx`);
const content = template.buffer.slice(template.byteOffset, template.byteOffset + template.length);
const file = await fbx(figure, content, motion, fps, text);
writeFileSync(out, new Uint8Array(await file.arrayBuffer()));
console.log("null");
