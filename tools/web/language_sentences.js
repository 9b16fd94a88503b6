// Parses sentences: which actions they request, in which order and with which attributes.
// A port of the modules matching, attributes, clauses and parsing of flame_mdm.conditions.language.
import {
  GAP, actions, baseForms, constant, corrected, correctedToAction, isForeign, isNumber, isThing, nearestActions,
  nearestTo, numbersOf, once, phrasesByFirstWord, sizeOf, tokenize, wordValues, wordsOf,
} from "./language_words.js";

const distinct = (values) => [...new Set(values)];
const isDeterminer = (word) => wordsOf("determiners").has(word);

/** Returns the actions that a sentence requests, as far as they are understood. */
export function understand(text) {
  return once(`understood ${text}`, () => {
    const nothing = { text, steps: [], objects: [], unknown: [], corrected: new Map(), isForeign: false, nearest: [] };
    const typed = tokenize(text);
    if (isForeign(typed)) return { ...nothing, isForeign: true };

    let tokens = corrected(typed);
    let matches = findPhrases(tokens);
    if (!matches.length) {
      const free = tokens.flatMap((token, number) => (token.isWord && !isExplained(token.word) ? [number] : []));
      tokens = correctedToAction(tokens, free);
      matches = findPhrases(tokens);
    }

    const sentence = new Sentence(text, tokens, matches);
    const steps = sentence.steps();
    const changed = tokens.filter((token) => token.typed.toLowerCase() !== token.word);
    return {
      ...nothing,
      steps,
      ...sentence.rest(),
      corrected: new Map(changed.map((token) => [token.typed, token.word])),
      nearest: steps.length ? [] : nearest(tokens),
    };
  });
}

export const mentionsOf = (understood) => understood.steps.flat();

/** Returns whether a word is in a table of words that are not actions. */
function isExplained(word) {
  if (isNumber(word) || word === "x" || numbersOf("numbers").has(word) || numbersOf("times").has(word)) return true;
  if (wordValues("direction").has(word) || wordValues("speed").has(word)) return true;
  const keys = ["people", "function", "body", "objects"];
  return baseForms(word).some((base) => keys.some((key) => wordsOf(key).has(base)));
}

/** Returns the actions with the meanings nearest to the words of a sentence that are in no table, or to all. */
function nearest(tokens) {
  const words = tokens.filter((token) => token.isWord).map((token) => token.word);
  const free = words.filter((word) => !isExplained(word));
  return nearestTo(free.length ? free : words).slice(0, constant("nearest")).map(([action]) => action);
}

// ---- phrases for actions in the words of a sentence ----

/** Returns the phrases for actions in a sentence, the longest one at each word; phrases do not overlap. */
function findPhrases(tokens) {
  const matches = [];
  let number = 0;
  while (number < tokens.length) {
    const match = longestAt(tokens, number);
    if (!match || isConnective(tokens, number)) {
      number += 1;
      continue;
    }
    if (!isNegated(tokens, number)) matches.push(match);
    number = match.last + 1;
  }
  return matches;
}

function longestAt(tokens, start) {
  const listed = baseForms(tokens[start].word).flatMap((base) => phrasesByFirstWord().get(base) ?? []);
  listed.sort((one, other) => sizeOf(other) - sizeOf(one));
  for (const phrase of listed) {
    const used = matchAt(tokens, start, phrase.words);
    if (used) return matchOf(phrase, used, isWeak(tokens, used, phrase));
  }
  return undefined;
}

function matchOf(phrase, used, weak) {
  return { phrase, used, isWeak: weak, first: used[0], last: used.at(-1) };
}

/** Returns the positions of a phrase's words from a token on; undefined if they are not there. */
function matchAt(tokens, start, words) {
  if (!words.length) return [];
  if (words[0] === GAP) {
    for (let skipped = 0; skipped <= constant("longest_gap"); skipped++) {
      if (tokens.slice(start, start + skipped).some((token) => !token.isWord)) return undefined;
      const used = matchAt(tokens, start + skipped, words.slice(1));
      if (used) return used;
    }
    return undefined;
  }

  const token = tokens[start];
  if (!token?.isWord) return undefined;
  if (baseForms(token.word).includes(words[0])) {
    const rest = matchAt(tokens, start + 1, words.slice(1));
    return rest && [start, ...rest];
  }
  return isDeterminer(token.word) ? matchAt(tokens, start + 1, words) : undefined;
}

/** Returns whether a word begins "followed by", which states an order and not an action. */
function isConnective(tokens, number) {
  return tokens[number].word === "followed" && tokens[number + 1]?.word === "by";
}

function isNegated(tokens, number) {
  return number > 0 && wordsOf("negation").has(tokens[number - 1].word) && tokens[number].word !== "not";
}

/** Returns whether a phrase is a general verb, such as "go", or a noun after an article, such as "the guard". */
function isWeak(tokens, used, phrase) {
  if (sizeOf(phrase) > 1) return constant("weak_phrases").includes(phrase.words.join(" "));
  const before = used[0] ? tokens[used[0] - 1].word : "";
  return wordsOf("weak").has(phrase.words[0]) || isDeterminer(before);
}

// ---- clauses, and how they follow each other in time ----

/** Returns the clauses of a sentence: they end at punctuation, at "and" and at connectors, but not in a phrase. */
function splitClauses(tokens, matches) {
  const clauses = [];
  const begin = (isFirst) => ({ numbers: [], link: "", isFirst, afterComma: false, matches: [] });
  const isInside = (number) => matches.some(({ first, last }) => first <= number && number <= last);
  let clause = begin(true);
  let number = 0;
  while (number < tokens.length) {
    const token = tokens[number];
    const connector = isInside(number) ? undefined : connectorAt(tokens, number);
    const divides = connector || !token.isWord || ["and", "or", "but"].includes(token.word);
    if (isInside(number) || !divides) {
      clause.numbers.push(number);
      number += 1;
      continue;
    }

    const link = connector?.link ?? "";
    number += connector?.words.length ?? 1;
    if (link && constant("at_the_end").includes(connector.words[0]) && clause.numbers.length) {
      clause.link = link;
      continue;
    }
    if (clause.numbers.length) {
      clauses.push(clause);
      clause = begin(false);
    }
    clause.link = link || clause.link;
    if (!token.isWord) {
      clause.afterComma = token.word === ",";
      clause.isFirst ||= token.word !== ",";
    }
  }
  if (clause.numbers.length) clauses.push(clause);
  for (const part of clauses) part.matches = matches.filter((match) => part.numbers.includes(match.first));
  return clauses;
}

/** Returns the connector at a token, such as "then"; undefined if there is none. */
function connectorAt(tokens, number) {
  return constant("connectors").find(({ words }) => {
    if (words.some((word, ahead) => tokens[number + ahead]?.word !== word)) return false;
    const after = tokens[number + words.length]?.word ?? "";
    const isSubject = wordsOf("people").has(after) || isDeterminer(after);
    if (constant("need_subject").includes(words[0]) && !isSubject) return false;
    return !(constant("need_clause").includes(words[0]) && ["to", "the"].includes(after));
  });
}

/** Returns clauses with one action each; words without an action belong to the previous clause, or to the next if first. */
function joinedClauses(clauses) {
  const merged = [];
  let waiting = [];
  let first;
  for (const clause of clauses) {
    const before = merged.at(-1);
    if (clause.matches.length) {
      if (waiting.length) {
        clause.numbers = [...waiting, ...clause.numbers];
        clause.link = first.link || clause.link;
        clause.isFirst = true;
        waiting = [];
      }
      merged.push(clause);
    } else if (before && clause.link !== "then") {
      before.numbers.push(...clause.numbers);
      if (clause.link === "while" && merged.length > 1) before.link ||= "while";
    } else if (before) {
      merged.push(clause);
    } else {
      first ??= clause;
      waiting.push(...clause.numbers);
    }
  }
  return merged;
}

// ---- attributes of an action ----

const LEFT_OR_RIGHT = ["left", "right"];
const isSideOf = (word) => baseForms(word).some((base) => wordsOf("sides_of").has(base));

/** Reads the attributes of one action from the words of its clause. */
class AttributeReader {
  constructor(entry, tokens, numbers, verb) {
    Object.assign(this, { entry, tokens, numbers, verb: new Set(verb) });
    this.used = new Set();
    this.dropped = new Set();
    this.attributes = {};
  }

  read() {
    for (const [position, number] of this.numbers.entries()) {
      const { word } = this.tokens[number];
      if (["left", "right", "both", "hands", "arms", "fists"].includes(word)) this.readSide(position, number);
      if (!this.verb.has(number)) {
        this.readDirection(position, number);
        this.readSpeed(number);
      }
      this.readCount(position, number);
    }
    this.readTurn();
    return Object.fromEntries(Object.entries(this.attributes).filter(([name]) => this.entry.takes.has(name)));
  }

  /** Returns the word at a position in the clause; "" outside of it. */
  wordAt(position) {
    return this.tokens[this.numbers[position]]?.word ?? "";
  }

  state(name, value, ...numbers) {
    this.attributes[name] = value;
    const noted = this.entry.takes.has(name) ? this.used : this.dropped;
    if (noted === this.dropped && name === "direction") return;
    for (const number of numbers) noted.add(number);
  }

  readSide(position, number) {
    const { takes } = this.entry;
    const { word } = this.tokens[number];
    const next = this.wordAt(position + 1);
    const after = isDeterminer(next) ? this.wordAt(position + 2) : next;
    const namesBody = isSideOf(after);
    if (word === "both") {
      if (namesBody || next.includes("hand")) this.state("side", "both", number);
      return;
    }
    if (["hands", "arms", "fists"].includes(word)) {
      if (!("side" in this.attributes)) this.state("side", "both");
      return;
    }

    const isHanded = after === "handed" || (namesBody && !["hip", "hips", "side"].includes(after));
    if (!takes.has("side") && isHanded && takes.has("direction")) {
      if (["shoulder", "side"].includes(next)) this.state("direction", word, number);
      return;
    }
    let before = this.wordAt(position - 1);
    if (isDeterminer(before)) before = this.wordAt(position - 2);
    const isPlain = !takes.has("direction") && !["to", "turn"].includes(before);
    if (isHanded || ["with", "using"].includes(before) || isPlain) this.state("side", word, number);
  }

  readDirection(position, number) {
    const { word } = this.tokens[number];
    const value = wordValues("direction").get(word);
    if (value === undefined || this.used.has(number)) return;
    const before = this.wordAt(position - 1);
    if (["up", "down"].includes(value) && !this.entry.takes.has("vertical")) return;
    if (word === "back" && isDeterminer(before)) return;
    if (LEFT_OR_RIGHT.includes(value)) {
      const next = this.wordAt(position + 1);
      const after = isDeterminer(next) ? this.wordAt(position + 2) : next;
      if (baseForms(after).some((base) => base !== "side" && wordsOf("sides_of").has(base))) return;
      if ("side" in this.attributes && ["with", "using"].includes(before)) return;
    }
    this.state("direction", this.around(value), number);
  }

  /** Returns the direction, with a side of a circle as the direction of turning. */
  around(value) {
    const earlier = this.attributes.direction ?? "";
    const turns = { left: "counterclockwise", right: "clockwise" };
    const turn = (other) => turns[other] ?? (other.endsWith("clockwise") ? other : "circle");
    if (earlier === "circle") return turn(value);
    if (value === "circle") return turn(earlier);
    const isKept = earlier.endsWith("clockwise") && ["forward", ...LEFT_OR_RIGHT].includes(value);
    return isKept ? earlier : value;
  }

  readSpeed(number) {
    const value = wordValues("speed").get(this.tokens[number].word);
    if (value !== undefined) this.state("speed", value, number);
  }

  readCount(position, number) {
    const { word } = this.tokens[number];
    if (numbersOf("times").has(word)) {
      if (!this.isConnector(position)) this.state("count", numbersOf("times").get(word), number);
      return;
    }
    const next = this.wordAt(position + 1);
    if (word === "x" && isNumber(next)) {
      this.state("count", numberOf(next), number, this.numbers[position + 1]);
      return;
    }

    let count = isNumber(word) && word.length < 4 ? numberOf(word) : numbersOf("numbers").get(word);
    if (word === "couple" && next === "of") count = 2;
    if (count === undefined) return;
    const ahead = [1, 2, 3, 4].map((step) => this.wordAt(position + step));
    const following = ahead.filter((after) => !["of", "more"].includes(after));
    const [first = ""] = following;
    if (["time", "times", "x", "repetitions", "reps"].includes(first)) {
      this.state("count", count, number);
      return;
    }
    if (baseForms(first).some((base) => constant("measures").includes(base))) {
      if (baseForms(first).includes("step")) this.state("count", count, number);
      return;
    }
    if (following.slice(0, 2).some(isSideOf)) return;
    if (this.namesAction(position)) this.state("count", count, number);
  }

  /** Returns whether "once" begins a clause: "once they have looked around". */
  isConnector(position) {
    const next = this.wordAt(position + 1);
    return this.wordAt(position) === "once" && (wordsOf("people").has(next) || isDeterminer(next));
  }

  /** Returns whether the verb of the clause is a noun that follows a number: "five quick push-ups". */
  namesAction(position) {
    return [1, 2, 3].some((step) => this.verb.has(this.numbers[position + step]));
  }

  readTurn() {
    if (!this.entry.takes.has("amount")) return;
    const words = this.numbers.map((number) => this.tokens[number].word);
    const says = (word) => words.includes(word);
    if (says("180") || says("half") || (says("around") && !says("look"))) this.attributes.amount = "half";
    else if (says("quarter") || says("90")) this.attributes.amount = "quarter";
  }
}

/** Returns the value of decimal digits of any script. */
function numberOf(digits) {
  const isDigit = (code) => isNumber(String.fromCodePoint(code));
  const value = (char) => {
    let code = char.codePointAt(0);
    let above = 0;
    // Unicode lists the digits 0 to 9 of a script one after the other
    while (above < 9 && isDigit(code - 1)) {
      code -= 1;
      above += 1;
    }
    return above;
  };
  return [...digits].reduce((sum, char) => 10 * sum + value(char), 0);
}

// ---- the sentence ----

/** The actions in a sentence, from its tokens and the phrases for actions in them. */
class Sentence {
  constructor(text, tokens, matches) {
    Object.assign(this, { text, tokens });
    this.used = new Set();
    this.dropped = new Set();
    this.verbs = new Set();
    this.typed = new Map();
    const clauses = splitClauses(tokens, matches);
    for (const clause of clauses) this.choose(clause);
    this.clauses = joinedClauses(clauses);
  }

  /** Returns the actions in order. */
  steps() {
    let steps = [];
    let during = []; // "While walking," before the clause that it belongs to
    let later = []; // "Before sitting down,"
    for (const clause of this.clauses) {
      let added = this.actionsOf(clause, steps);
      if (!added.length) continue;
      if (clause.link === "while" && clause.isFirst) {
        during = added;
        continue;
      }
      if (clause.link === "before" && clause.isFirst) {
        later = added;
        continue;
      }

      if (during.length) {
        added = [...during.slice(0, -1), [...during.at(-1), ...added[0]], ...added.slice(1)];
        during = [];
      }
      const last = steps.at(-1);
      const [next, ...others] = added;
      if (last && (clause.link === "while" || this.isManner(clause, steps))) {
        steps.splice(-1, 1, [...last, ...next], ...others);
      } else if (last && clause.link === "after" && !clause.isFirst) {
        steps.splice(-1, 0, ...added);
      } else if (last && !clause.link && isSame(last, next)) {
        steps.splice(-1, 1, [stating(last[0], next[0].attributes)], ...others);
      } else {
        steps.push(...added);
      }
      steps = [...steps, ...later];
      later = [];
    }
    return [...steps, ...during, ...later].map(withoutIdle);
  }

  /** Returns the words for things, and the words that are not understood. */
  rest() {
    const objects = [];
    const unknown = [];
    for (const [number, token] of this.tokens.entries()) {
      if (!token.isWord || this.verbs.has(number)) continue;
      if (this.dropped.has(number)) {
        unknown.push(token.typed);
      } else if (baseForms(token.word).some((base) => wordsOf("objects").has(base))) {
        objects.push(token.word);
      } else if (!this.used.has(number) && !isExplained(token.word)) {
        if (this.isNoun(number) && isThing(token.word)) objects.push(token.word);
        else unknown.push(token.typed);
      }
    }
    return { objects: distinct(objects), unknown: distinct(unknown) };
  }

  /** Keeps the phrases of a clause that are its actions; without one, a word with the meaning of an action. */
  choose(clause) {
    const strong = clause.matches.filter((match) => !match.isWeak);
    if (strong.length) {
      clause.matches = strong;
      return;
    }
    if (clause.matches.every((match) => this.isNoun(match.first))) {
      const meant = this.byMeaning(clause);
      clause.matches = meant ? [meant] : clause.matches;
    }
    const verbs = clause.matches.filter((match) => !this.isNoun(match.first));
    clause.matches = (verbs.length ? verbs : clause.matches).slice(-1);
  }

  byMeaning(clause) {
    let best;
    for (const number of clause.numbers) {
      const { word } = this.tokens[number];
      if (this.isNoun(number) || isExplained(word) || isThing(word) || word.endsWith("ly")) continue;
      const [meant] = nearestActions(word);
      if (!meant || meant[1] < constant("similar")) continue;
      if (!best || meant[1] >= best.score) best = { score: meant[1], number, action: meant[0] };
    }
    if (!best) return undefined;
    const { word } = this.tokens[best.number];
    this.typed.set(best.number, word);
    return matchOf({ words: [word], action: best.action, attributes: {} }, [best.number], false);
  }

  /** Returns whether an article or a preposition precedes a word. */
  isNoun(number) {
    const before = number ? this.tokens[number - 1].word : "";
    return isDeterminer(before) || wordsOf("prepositions").has(before);
  }

  /** Returns the actions of a clause, and takes note of the words that state them. */
  actionsOf(clause, steps) {
    if (!clause.matches.length) return this.again(clause, steps);
    const added = [];
    for (const [position, match] of clause.matches.entries()) {
      const begin = position ? match.first : 0;
      const end = clause.matches[position + 1]?.first ?? this.tokens.length;
      const mention = this.mention(match, clause.numbers.filter((number) => begin <= number && number < end));
      const last = added.at(-1);
      if (last && isSame(last, [mention])) {
        added.splice(-1, 1, [stating(last[0], mention.attributes)]);
      } else if (last && this.tokens[match.first].word.endsWith("ing")) {
        last.push(mention);
      } else {
        added.push([mention]);
      }
    }
    return added;
  }

  mention(match, numbers) {
    const { action, attributes } = match.phrase;
    const reader = new AttributeReader(actions().get(action), this.tokens, numbers, match.used);
    const stated = { ...attributes, ...reader.read() };
    for (const number of [...reader.used, ...match.used]) this.used.add(number);
    for (const number of reader.dropped) this.dropped.add(number);
    this.verbs.add(match.first);
    return {
      action,
      attributes: stated,
      text: this.words(numbers),
      start: this.tokens[match.first].start,
      end: this.tokens[match.last].end,
      typed: this.typed.get(match.first) ?? "",
    };
  }

  /** Returns the previous action with the attributes from a clause without an action: "then faster". */
  again(clause, steps) {
    if (steps.at(-1)?.length !== 1) return [];
    const [before] = steps.at(-1);
    const reader = new AttributeReader(actions().get(before.action), this.tokens, clause.numbers, []);
    const stated = reader.read();
    for (const number of reader.used) this.used.add(number);
    if (!Object.keys(stated).length) return [];
    const text = `${this.text.slice(before.start, before.end)} ${this.words(clause.numbers)}`;
    return [[{ ...stating(before, stated), text, typed: "" }]];
  }

  /** Returns whether a clause states what happens during the previous clause: "stands still, waving". */
  isManner(clause, steps) {
    if (clause.link || !clause.afterComma || !clause.matches.length) return false;
    const [before] = steps.at(-1);
    const { first } = clause.matches[0];
    if (clause.numbers.some((number) => number < first) || !this.tokens[first].word.endsWith("ing")) return false;
    return before.action === "idle" || !this.text.slice(before.start, before.end).toLowerCase().endsWith("ing");
  }

  /** Returns the words of a clause, as typed. */
  words(numbers) {
    const words = [];
    for (const number of numbers) {
      const token = this.tokens[number];
      const isAttached = words.length && this.tokens.at(number - 1).end === token.start;
      if (isAttached) words.push(words.pop() + token.typed);
      else words.push(token.typed);
    }
    return words.join(" ");
  }
}

const stating = (mention, attributes) => ({ ...mention, attributes: { ...mention.attributes, ...attributes } });

/** Returns whether two steps are one action that the sentence names twice, with attributes that agree. */
function isSame(step, other) {
  if (step.length > 1 || other.length > 1 || step[0].action !== other[0].action) return false;
  const [first, second] = [step[0].attributes, other[0].attributes];
  return Object.keys(first).every((name) => !(name in second) || first[name] === second[name]);
}

/** Returns a step without "stands still", if another action happens at the same time, and without duplicates. */
function withoutIdle(step) {
  const moving = step.filter((mention) => mention.action !== "idle");
  return distinctActions(moving.length ? moving : step.slice(0, 1));
}

/** Returns the actions of a step, each once. */
export function distinctActions(step) {
  return [...new Map(step.map((mention) => [mention.action, mention])).values()];
}
