// Understands texts with the scripts of the page that samples in the browser.
// node web_language.mjs FOLDER: the folder has the scripts, language.json, language.bin and requests.json
import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(`${folder}/${name}`));
const read = (name) => JSON.parse(readFileSync(`${folder}/${name}`));
const { useTables } = await load("language_words.js");
const { understand } = await load("language_sentences.js");
const { Reader, predicate, usualSeconds } = await load("language_reading.js");

const bytes = readFileSync(`${folder}/language.bin`);
useTables(read("language.json"), bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
const { models, texts } = read("requests.json");
const readers = models.map((facts) => new Reader(facts));

function readBy(reader, text) {
  try {
    const { steps, ...reading } = reader.read(text);
    const seconds = usualSeconds({ steps }, { fps: 20, max_frames: 60 });
    return { ...reading, seconds, predicates: steps.flat().map(predicate) };
  } catch (error) {
    return { refused: error.message, nearest: error.nearest };
  }
}

const answers = texts.map((text) => {
  const understood = understand(text);
  const understanding = { ...understood, corrected: Object.fromEntries(understood.corrected) };
  return { understanding, readings: readers.map((reader) => readBy(reader, text)) };
});
const choices = readers.map(({ abilities }) => abilities.actions.map((action) => [action, Object.fromEntries(abilities.choices(action))]));
console.log(JSON.stringify({ answers, choices }));
