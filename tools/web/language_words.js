// Looks up words: tables, base forms, typos and meanings.
// A port of the modules tables, morphology, spelling, vectors, meaning and tokens of flame_mdm.conditions.language.

export const GAP = "...";

// Tables from language.json and vectors from language.bin; tools/web.py writes both files.
let tables;
let cached = new Map();

const WORDS_AND_SPACES = /\s+/u;
const listOf = (text) => text.split(WORDS_AND_SPACES).filter(Boolean);
const distinct = (values) => [...new Set(values)];
const byCodePoint = (words) => [...words].sort();

/** Sets the language tables. `bytes` contains vectors of 8-bit numbers, then the words, one per line. */
export function useTables(content, bytes) {
  tables = content;
  cached = new Map();
  const { count, dimensions } = content.vectors;
  const size = count * dimensions;
  const words = new TextDecoder().decode(bytes.slice(size)).split("\n");
  if (words.length !== count) throw new Error("language.bin is damaged");
  tables.rows = new Map(words.map((word, row) => [word, row]));
  tables.numbers = new Int8Array(bytes, 0, size);
}

/** Returns the value of a function, computed only once per key. */
export function once(key, compute) {
  if (!cached.has(key)) cached.set(key, compute());
  return cached.get(key);
}

export const constant = (name) => tables.constants[name];
export const phrases = () => tables.phrases;

/** Returns the words in a list in `phrases.yaml`. */
export function wordsOf(...keys) {
  return once(`words of ${keys}`, () => new Set(listOf(keys.reduce((entry, key) => entry[key], phrases()))));
}

/** Returns the value that each word in a table states: wordValues("speed").get("slowly") is "slow". */
export function wordValues(key) {
  return once(`values of ${key}`, () => {
    const rows = Object.entries(phrases()[key]);
    return new Map(rows.flatMap(([value, listed]) => listOf(listed).map((word) => [word, value])));
  });
}

/** Returns the number that each word in a table means, such as "numbers". */
export function numbersOf(key) {
  return once(`numbers of ${key}`, () => new Map(Object.entries(phrases()[key])));
}

/** Returns the actions by name. */
export function actions() {
  return once("actions", () => {
    const entries = tables.actions.map((entry) => [entry.name, { ...entry, takes: new Set(entry.takes) }]);
    return new Map(entries);
  });
}

export const sizeOf = (phrase) => phrase.words.filter((word) => word !== GAP).length;

/** Returns the phrases for actions by their first words, the longest phrases first. */
export function phrasesByFirstWord() {
  return once("phrases by first word", () => {
    const listed = new Map();
    for (const entry of actions().values()) {
      for (const phrase of entry.phrases) {
        const [first] = phrase.words;
        if (!listed.has(first)) listed.set(first, []);
        listed.get(first).push(phrase);
      }
    }
    for (const group of listed.values()) group.sort((one, other) => sizeOf(other) - sizeOf(one));
    return listed;
  });
}

// ---- base forms and inflections ----

/** Returns the forms that a word may be an inflection of, the word itself first. */
export function baseForms(word) {
  return once(`base ${word}`, () => distinct([word, ...(irregular().get(word) ?? []), ...stems(word)]));
}

function stems(word) {
  const found = [];
  if (/(?:ies|ied)$/.test(word) && word.length > 4) found.push(`${word.slice(0, -3)}y`);
  for (const ending of ["ing", "ed", "es", "s", "in"]) {
    if (!word.endsWith(ending)) continue;
    const stem = word.slice(0, -ending.length);
    if (stem.length < 2) continue;
    if (ending === "s") {
      if (!stem.endsWith("s")) found.push(stem);
      continue;
    }

    found.push(stem);
    if (ending === "es") continue;
    if (stem.length > 2) found.push(`${stem}e`);
    if (stem.length > 3 && stem.at(-1) === stem.at(-2)) found.push(stem.slice(0, -1));
  }
  return found;
}

/** Returns the forms of a verb or noun: wave -> wave, waves, waving, waved. */
export function inflections(verb) {
  return once(`forms of ${verb}`, () => {
    const isSibilant = /(?:s|sh|ch|x|z)$/.test(verb);
    const stem = verb.endsWith("e") && !verb.endsWith("ee") ? verb.slice(0, -1) : verb;
    const forms = [verb, isSibilant ? `${verb}es` : `${verb}s`, `${stem}ing`, `${stem}ed`];
    if (verb.length > 2 && verb.endsWith("y") && !isVowel(verb.at(-2))) {
      forms.push(`${verb.slice(0, -1)}ies`, `${verb.slice(0, -1)}ied`);
    }
    if (doubles(verb)) forms.push(`${verb}${verb.at(-1)}ing`, `${verb}${verb.at(-1)}ed`);
    for (const [form, bases] of irregular()) if (bases.includes(verb)) forms.push(form);
    return distinct(forms);
  });
}

const isVowel = (letter) => constant("vowels").includes(letter);

/** Returns whether the last consonant of a verb may be doubled: hop, hopping. */
function doubles(verb) {
  if (verb.length < 3) return false;
  const [before, vowel, last] = verb.slice(-3);
  return !isVowel(last) && !"wxy".includes(last) && isVowel(vowel) && !isVowel(before);
}

function irregular() {
  return once("irregular", () => {
    const bases = new Map();
    for (const [base, forms] of Object.entries(phrases().irregular)) {
      for (const form of listOf(forms)) bases.set(form, [...(bases.get(form) ?? []), base]);
    }
    return bases;
  });
}

// ---- typos ----

/** Returns the number of letters inserted, removed, replaced or swapped with a neighbor; above `most`, most + 1. */
export function distance(first, second, most) {
  if (Math.abs(first.length - second.length) > most) return most + 1;
  let earlier = [];
  let before = [];
  let row = Array.from({ length: second.length + 1 }, (_, j) => j);
  for (let i = 1; i <= first.length; i++) {
    [earlier, before, row] = [before, row, [i]];
    for (let j = 1; j <= second.length; j++) {
      const isOther = first[i - 1] !== second[j - 1];
      let cost = Math.min(before[j] + 1, row[j - 1] + 1, before[j - 1] + isOther);
      const isSwapped = i > 1 && j > 1 && first[i - 1] === second[j - 2] && first[i - 2] === second[j - 1];
      if (isSwapped) cost = Math.min(cost, earlier[j - 2] + 1);
      row.push(cost);
    }
    if (Math.min(...row) > most) return most + 1;
  }
  return Math.min(row.at(-1), most + 1);
}

const sortedLetters = (word) => [...word].sort().join("");

/** Returns the words in the tables that a misspelled word may mean, all equally near; [] if none is near. */
export function corrections(word) {
  return once(`corrections of ${word}`, () => {
    const shortest = constant("never_corrected");
    if (word.length <= shortest || /\p{Nd}/u.test(word)) return [];
    const most = word.length <= 5 ? 1 : 2;
    const near = new Map();
    for (const other of correctWords()) {
      if (other.length <= shortest) continue;
      const far = distance(word, other, most);
      if (far > most) continue;
      const beginsOtherwise = sortedLetters(other.slice(0, 2)) !== sortedLetters(word.slice(0, 2)) && other[0] !== word[0];
      const hasReplaced = other.length === word.length && sortedLetters(other) !== sortedLetters(word);
      const cost = 3 * far + beginsOtherwise + hasReplaced;
      if (!near.has(cost)) near.set(cost, []);
      near.get(cost).push(other);
    }
    return near.size ? near.get(Math.min(...near.keys())) : [];
  });
}

/** Returns the forms of all words in the phrases for actions. */
export function actionWords() {
  return once("action words", () => {
    const bases = [...actions().values()].flatMap((entry) => entry.phrases.flatMap((phrase) => phrase.words));
    return new Set(distinct(bases).filter((base) => base !== GAP).flatMap(inflections));
  });
}

/** Returns the words that a typo may mean: frequent words, then words for actions, then all others. */
function correctWords() {
  return once("correct words", () => {
    const listed = ["body", "people", "function", "objects"].flatMap((key) => [...wordsOf(key)]);
    for (const key of ["numbers", "times"]) listed.push(...numbersOf(key).keys());
    for (const key of ["direction", "speed"]) listed.push(...wordValues(key).keys());
    const nouns = [...wordsOf("body"), ...wordsOf("objects")].flatMap((word) => inflections(word).slice(0, 2));
    const others = byCodePoint(new Set([...listed, ...nouns]));
    return distinct([...constant("frequent"), ...byCodePoint(actionWords()), ...others]);
  });
}

// ---- meanings: a table of vectors of length 1, the most frequent words first ----

const has = (word) => tables.rows.has(word);

/** Returns the rank in frequency of a word, or of its base form; undefined if the table has neither. */
function rank(word) {
  const form = baseForms(word).find(has);
  return form === undefined ? undefined : tables.rows.get(form);
}

/** Returns a row of the table as 32-bit numbers. */
function rowVector(row) {
  return once(`row ${row}`, () => {
    const { dimensions } = tables.vectors;
    const numbers = tables.numbers.subarray(row * dimensions, (row + 1) * dimensions);
    const length = Math.fround(Math.sqrt(numbers.reduce((sum, x) => sum + x * x, 0)));
    return Float32Array.from(numbers, (x) => x / length);
  });
}

function vectorOf(word) {
  const row = rank(word);
  return row === undefined ? undefined : rowVector(row);
}

function dot(first, second) {
  let sum = 0;
  for (let k = 0; k < first.length; k++) sum += first[k] * second[k];
  return sum;
}

/** Returns the weighted sum of vectors, scaled to length 1. */
function unitSum(vectors, weights) {
  const sum = new Float64Array(tables.vectors.dimensions);
  for (const [number, vector] of vectors.entries()) {
    for (let k = 0; k < sum.length; k++) sum[k] += weights[number] * vector[k];
  }
  const length = Math.max(Math.sqrt(dot(sum, sum)), 1e-9);
  return sum.map((x) => x / length);
}

/** Returns the mean vector of words, scaled to length 1. Frequent words have less weight. */
function meanOf(words) {
  const rows = words.map(rank).filter((row) => row !== undefined);
  if (!rows.length) return undefined;
  const total = once("sum of frequencies", () => {
    let sum = 0;
    for (let row = 0; row < tables.vectors.count; row++) sum += 1 / (row + 2);
    return sum;
  });
  const smoothing = constant("smoothing");
  const weights = rows.map((row) => smoothing / (smoothing + 1 / (row + 2) / total));
  return unitSum(rows.map(rowVector), weights);
}

/** Returns the actions with their scores by the similarity of a word, the nearest first. */
export function nearestActions(word) {
  const vector = vectorOf(word);
  return vector ? ranked(vector) : [];
}

/** Returns the actions with their scores by the similarity of the mean of several words, the nearest first. */
export function nearestTo(words) {
  const vector = meanOf(words);
  return vector ? ranked(vector) : [];
}

/** Returns the similarity of two actions: the cosine between the means of their words. */
export function similarity(action, other) {
  return dot(actionVectors().get(action).center, actionVectors().get(other).center);
}

/** Returns whether most of the listed words with the nearest meanings are things, not actions. */
export function isThing(word) {
  const vector = vectorOf(word);
  if (!vector) return false;
  const scores = [...actionVectors().values()].flatMap(({ words }) => words.map((listed) => [dot(listed, vector), 0]));
  scores.push(...thingVectors().map((listed) => [dot(listed, vector), 1]));
  scores.sort((one, other) => other[0] - one[0]);
  const neighbors = constant("neighbors");
  const things = scores.slice(0, neighbors).filter(([, thing]) => thing).length;
  return things * 2 > neighbors;
}

function ranked(vector) {
  const rows = [...actionVectors()].map(([name, { words, center }]) => {
    const nearest = Math.max(-1, ...words.map((listed) => dot(listed, vector)));
    return [name, (nearest + dot(center, vector)) / 2];
  });
  return rows.sort((one, other) => other[1] - one[1]);
}

/** Returns the vectors of the single words for each action, and their mean. */
function actionVectors() {
  return once("action vectors", () => {
    const vectors = new Map();
    for (const [name, entry] of actions()) {
      const single = entry.phrases.filter((phrase) => sizeOf(phrase) === 1).map((phrase) => phrase.words[0]);
      let words = single.filter((word) => !wordsOf("weak").has(word)).map(vectorOf).filter(Boolean);
      if (!words.length) words = [meanOf(entry.phrases[0].words)].filter(Boolean);
      vectors.set(name, { words, center: unitSum(words, words.map(() => 1)) });
    }
    return vectors;
  });
}

function thingVectors() {
  return once("thing vectors", () => [...wordsOf("objects")].map(vectorOf).filter(Boolean));
}

// ---- tokens ----

const TOKEN = /(?:anti|counter)[- ]?clockwise|\p{Nd}+|[\p{L}\p{Nl}\p{No}]+|[.,;:!?|\n]/giu;
const DIGITS = /^\p{Nd}+$/u;
const LETTER = /\p{L}/u;
const LATIN = /\p{Script=Latin}/u;
const ASCII = /^[\x00-\x7f]*$/;

export const isNumber = (word) => DIGITS.test(word);
export const hasForm = (token, ...bases) => baseForms(token.word).some((form) => bases.includes(form));

/** Returns the words and punctuation marks of a sentence, as typed. */
export function tokenize(text) {
  return [...text.matchAll(TOKEN)].map((match) => ({
    typed: match[0],
    word: match[0].toLowerCase().replace(/[- ]/g, ""),
    start: match.index,
    end: match.index + match[0].length,
    isWord: /^[\p{L}\p{N}]/u.test(match[0]),
  }));
}

/** Returns whether a word is English: in the tables or among the frequent words, in any form. */
function isKnown(word) {
  if (isNumber(word) || listedWords().has(word)) return true;
  return baseForms(word).some((form) => has(form) && (form === word || form.length > 3));
}

/** Returns whether a sentence is in a language other than English. */
export function isForeign(tokens) {
  const words = tokens.filter((token) => token.isWord).map((token) => token.word);
  if (!words.length) return false;
  const letters = [...words.join("")].filter((char) => LETTER.test(char));
  if (letters.filter((char) => !LATIN.test(char)).length * 2 > letters.length) return true;

  const languages = Object.keys(phrases().foreign).map((language) => wordsOf("foreign", language));
  const counts = languages.map((marks) => words.filter((word) => marks.has(word)).length);
  const typical = languages[counts.indexOf(Math.max(...counts))];
  const isMarked = (word) => (typical.has(word) && !listedWords().has(word)) || !ASCII.test(word);
  if (!words.some(isMarked)) return false;
  const english = words.filter((word) => !isMarked(word) && isEnglish(word));
  return english.length * 2 < words.length;
}

function isEnglish(word) {
  const row = rank(word);
  if (row !== undefined && row < constant("rare")) return true;
  return baseForms(word).some((form) => listedWords().has(form)) || corrections(word).length > 0;
}

/** Returns the tokens with typos corrected: unknown words with only a few similar candidates. */
export function corrected(tokens) {
  return tokens.map((token) => {
    if (!token.isWord || isKnown(token.word)) return token;
    const near = corrections(token.word);
    const meanings = new Set(near.map((word) => (actionWords().has(word) ? baseForms(word).at(-1) : word)));
    return near.length && meanings.size <= 3 ? { ...token, word: near[0] } : token;
  });
}

/** Returns the tokens with one rare word replaced by an action that differs in one letter: "doge to the left". */
export function correctedToAction(tokens, free) {
  for (const number of free) {
    const token = tokens[number];
    const row = rank(token.word);
    if (token.word.length < 3 || (row !== undefined && row < constant("rare"))) continue;
    const [meant] = nearestActions(token.word);
    if (meant && meant[1] >= constant("similar")) continue;
    const starts = byCodePoint(actionWords()).find(
      (word) => word.length > 2 && word[0] === token.word[0] && distance(token.word, word, 1) === 1,
    );
    if (starts) return tokens.map((other) => (other === token ? { ...token, word: starts } : other));
  }
  return tokens;
}

/** Returns the words in all tables, with the forms of verbs and nouns. */
function listedWords() {
  return once("listed words", () => {
    const words = new Set(actionWords());
    const add = (listed) => { for (const word of listed) words.add(word); };
    for (const key of ["numbers", "times", "speed_again"]) add(Object.keys(phrases()[key]));
    for (const key of ["direction", "speed"]) add(wordValues(key).keys());
    for (const key of ["people", "function", "objects", "body"]) {
      add([...wordsOf(key)].flatMap((word) => inflections(word).slice(0, 2)));
    }
    return words;
  });
}
