// Bends of the page, waypoints.js in a folder, for the cases in its cases.json.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const folder = process.argv[2];
const { bends } = await import(pathToFileURL(join(folder, "waypoints.js")));
const cases = JSON.parse(readFileSync(join(folder, "cases.json"), "utf-8"));
console.log(JSON.stringify(cases.map((values) => bends(...values))));
