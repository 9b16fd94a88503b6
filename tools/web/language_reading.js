// Translates a sentence to captions that a model knows, and reports what the model does not know.
// A port of the modules wording, abilities and reading of flame_mdm.conditions.language.
import {
  actions, baseForms, constant, inflections, nearestTo, once, similarity,
} from "./language_words.js";
import { distinctActions, mentionsOf, understand } from "./language_sentences.js";

const distinct = (values) => [...new Set(values)];
const lookUp = (name, key) => {
  const table = constant(name);
  return Object.hasOwn(table, key) ? table[key] : undefined;
};

// ---- captions ----

/** Returns the words for an action and its attributes: "walks sideways to the left". */
export function predicate({ action, attributes = {} }) {
  const entry = actions().get(action);
  const { side, amount, direction, speed = "normal", count } = attributes;
  const words = [entry.say.replaceAll("{side}", limb(entry.part, side))];
  if (amount === "half") words.push("around");
  if (direction !== undefined) words.push(entry.ways[direction] ?? lookUp("directions", direction));
  else if (entry.usual && amount === undefined) words.push(entry.usual);
  words.push(lookUp("speeds", speed));
  if (count !== undefined) words.push(times(count));
  if (side !== undefined && !entry.say.includes("{side}")) words.push(`${entry.before_side} ${limb(entry.part, side)}`);
  return words.filter(Boolean).join(" ");
}

const times = (count) => lookUp("times", count) ?? `${count} times`;

/** Returns the caption for simultaneous actions: "a person walks forward while waving". */
export function caption(step) {
  const [first, ...others] = step.map(predicate);
  return [`${constant("who")} ${first}`, ...others.map(participle)].join(" while ");
}

/** Returns the words for an attribute: "right", "twice", "to the left", "quickly". */
export function attributeWords(name, value) {
  if (name === "count") return times(value);
  if (name === "amount") return value === "half" ? "halfway around" : "a quarter";
  const table = { direction: "directions", speed: "speeds" }[name];
  return (table && lookUp(table, value)) || value;
}

function limb(part, side) {
  if (side === undefined) return "a hand";
  return side === "both" ? `both ${lookUp("plurals", part) ?? part}` : `the ${side} ${part}`;
}

/** Returns a predicate with its verb as a participle: "waves twice" -> "waving twice". */
function participle(words) {
  const [verb, ...rest] = words.split(" ");
  const forms = inflections(baseForms(verb).at(-1)).filter((form) => form.endsWith("ing"));
  return [forms.at(-1), ...rest].join(" ");
}

/** Returns the duration of a reading's first step in seconds, for visitors who choose no duration. */
export function usualSeconds({ steps: [step = []] }, { fps, max_frames: longest, start }) {
  const most = start ? constant("usual_seconds") : Math.min(constant("usual_seconds"), longest / fps);
  const count = step.length === 1 ? step[0].attributes.count : undefined;
  return count === undefined ? most : Math.min(most, constant("start_and_end") + constant("repetition") * count);
}

// ---- what a model knows ----

/** Actions and attributes of a model, from its list of actions, its vocabulary and its captions. */
export class Abilities {
  constructor({ actions: names, vocabulary, captions }) {
    this.vocabulary = new Set(vocabulary);
    this.captions = captions;
    this.supported = new Map();
    this.actions = this.listed(names);
  }

  /** Whether any caption of the model describes two simultaneous actions. */
  get isSimultaneous() {
    this.simultaneous ??= this.captions
      .filter((text) => text.includes(" while ") || text.includes(" at the same time"))
      .some((text) => understand(text).steps.some((step) => step.length > 1));
    return this.simultaneous;
  }

  /** Returns the actions that the model knows, by their names in `actions.yaml`. */
  listed(names) {
    const entries = [...actions().values()];
    const listed = names.flatMap((name) => {
      const plain = name.replaceAll("_", " ").toLowerCase();
      const named = entries.filter((entry) => entry.names.includes(plain)).map((entry) => entry.name);
      return named.length ? named : mentionsOf(understand(plain)).slice(0, 1).map(({ action }) => action);
    });
    return distinct(listed).filter((action) => this.hasWords(actions().get(action).say.replaceAll("{side}", "")));
  }

  hasWords(text) {
    const words = text.replaceAll("-", " ").split(/\s+/u).filter(Boolean);
    return words.every((word) => this.vocabulary.has(word));
  }

  /** Returns whether the model knows a value for an attribute of an action. */
  supports(action, name, value) {
    const key = JSON.stringify([action, name, value]);
    if (!this.supported.has(key)) this.supported.set(key, this.states(action, name, value));
    return this.supported.get(key);
  }

  states(action, name, value) {
    const entry = actions().get(action);
    if (!this.hasWords(predicate({ action, attributes: { [name]: value } }))) return false;
    if (!this.captions.length || name === "amount") return true;
    if (name === "count" && entry.takes.has("steps")) return false;
    const verbs = new Set(entry.phrases.flatMap((phrase) => inflections(phrase.words[0])));
    const parts = lookUp("words_of_values", value) ?? [String(value)];
    return this.captions.some((text) => {
      if (!parts.some((part) => text.includes(part))) return false;
      if (!text.toLowerCase().split(/\s+/u).some((word) => verbs.has(word))) return false;
      const mentions = mentionsOf(understand(text));
      return mentions.some((mention) => mention.action === action && mention.attributes[name] === value);
    });
  }

  /** Returns the values of each attribute that the model knows for an action, as pairs of a name and its values. */
  choices(action) {
    const { takes } = actions().get(action);
    return Object.entries(constant("choices"))
      .filter(([name]) => takes.has(name))
      .map(([name, values]) => [name, values.filter((value) => this.supports(action, name, value))])
      .filter(([, values]) => values.length);
  }

  /** Returns the actions that the model knows, nearest meaning first. */
  ranked(action) {
    const scores = new Map(this.actions.map((other) => [other, similarity(action, other)]));
    return [...this.actions].sort((one, other) => scores.get(other) - scores.get(one));
  }

  /** Returns captions of three known actions with the meanings nearest to a sentence. */
  nearest(understood) {
    const words = understood.text.toLowerCase().split(/\s+/u).filter((word) => /^\p{L}+$/u.test(word));
    const ranked = [...understood.nearest, ...nearestTo(words).map(([action]) => action)];
    const known = ranked.filter((action) => this.actions.includes(action));
    return distinct(known).slice(0, 3).map((action) => caption([{ action }]));
  }
}

// ---- what a model reads ----

/** Thrown for a sentence that is rejected. `nearest` contains captions with similar meanings. */
export class NotUnderstood extends Error {
  constructor(message, nearest = []) {
    super(message);
    this.nearest = nearest;
  }
}

/** Reads sentences for a model in which every caption names one of a list of actions. */
export class Reader {
  constructor(facts) {
    this.abilities = new Abilities(facts);
  }

  /** Returns a sentence as the model reads it; throws `NotUnderstood`. */
  read(text) {
    const [sentence, style] = withoutStyle(text);
    const understood = understand(sentence);
    const shown = `'${text.length > 60 ? `${text.slice(0, 59)}…` : text}'`;
    if (understood.isForeign) {
      throw new NotUnderstood(`${shown}: only English prompts are supported. Write the prompt in English`);
    }
    const asTyped = { steps: [], captions: [text], texts: [text], changes: [], ignored: [] };
    if (!understood.steps.length) {
      const { unknown } = understood;
      if (unknown.length && this.abilities.hasWords(unknown.join(" "))) return asTyped;
      throw new NotUnderstood(`${shown}: no word says what happens`, this.abilities.nearest(understood));
    }

    try {
      return this.readSteps(understood, shown, style);
    } catch (error) {
      if (error instanceof NotUnderstood && this.abilities.captions.includes(sentence)) return asTyped;
      throw error;
    }
  }

  readSteps(understood, shown, style) {
    const typos = [...understood.corrected].map(([typed, word]) => `'${typed}' is read as '${word}'`);
    const notes = { changes: typos, ignored: [...understood.unknown] };
    const steps = [];
    const texts = [];
    for (const step of joinedSteps(understood.steps, this.abilities.actions)) {
      const read = step.map((mention) => this.mention(mention, shown, notes));
      const parts = this.possible(read, notes).flatMap((one) => this.repeated(one, notes));
      steps.push(...parts);
      texts.push(...(parts.length === 1 && step.length === 1 ? [read[0].text] : parts.map(caption)));
    }

    const lowered = understood.unknown.map((word) => word.toLowerCase());
    const special = new Set(lowered.filter((word) => this.abilities.vocabulary.has(word)));
    const captions = steps.map((step, number) => `${captionOf(step, texts[number], special)}${style}`);
    const ignored = distinct(notes.ignored).filter((word) => !special.has(String(word).toLowerCase()));
    return { steps, captions, texts, changes: distinct(notes.changes), ignored };
  }

  /** Returns a mention of an action that the model knows, with the attributes that it knows. */
  mention(mention, shown, notes) {
    const [action, implied] = this.knownAction(mention.action);
    if (action === undefined) {
      const nearest = this.abilities.ranked(mention.action).slice(0, 3).map((name) => caption([{ action: name }]));
      throw new NotUnderstood(`${shown}: the model does not know '${predicate({ action: mention.action })}'`, nearest);
    }

    if (mention.typed) {
      notes.changes.push(`'${mention.typed}' is read as '${predicate({ action })}'`);
    } else if (action !== mention.action) {
      const instead = predicate({ action, attributes: implied });
      notes.changes.push(`the model does not know '${predicate({ action: mention.action })}': the person ${instead} instead`);
    }
    const attributes = { ...implied };
    const { takes } = actions().get(action);
    for (const name of constant("attributes")) {
      const value = mention.attributes[name];
      if (value === undefined) continue;
      const isRepetition = name === "count" && takes.has(name) && !takes.has("steps");
      if (isRepetition || (takes.has(name) && this.abilities.supports(action, name, value))) {
        attributes[name] = value;
      } else if (!(name in implied) && !(name === "speed" && value === "normal")) {
        const isOfSteps = name === "count" && takes.has("steps");
        notes.ignored.push(isOfSteps ? `${value} steps` : attributeWords(name, value));
      }
    }
    return { ...mention, action, attributes };
  }

  /** Returns the action, or one that shows nearly the same, with its attributes. */
  knownAction(action) {
    if (this.abilities.actions.includes(action)) return [action, {}];
    const like = actions().get(action).like.find((other) => this.abilities.actions.includes(other.action));
    return like ? [like.action, like.attributes] : [undefined, {}];
  }

  /** Returns the step, or its actions one after the other if the model does not know simultaneous actions. */
  possible(step, notes) {
    const several = distinctActions(step);
    if (several.length === 1 || this.abilities.isSimultaneous) return [several];
    const both = several.map((mention) => `'${predicate(mention)}'`).join(" and ");
    notes.changes.push(`the model cannot do ${both} at the same time: they are sampled one after the other`);
    return several.map((mention) => [mention]);
  }

  /** Returns a step as often as its count requires: "kicks four times" becomes "kicks twice", two times. */
  repeated(step, notes) {
    const [mention, ...others] = step;
    const { count } = mention.attributes;
    const supports = (number) => this.abilities.supports(mention.action, "count", number);
    if (count === undefined || others.length || supports(count)) return [step];
    const counts = [3, 2, 1].filter(supports);
    if (!counts.length || count > constant("longest_count")) {
      notes.ignored.push(attributeWords("count", count));
      const { count: _, ...attributes } = mention.attributes;
      return [[{ ...mention, attributes }]];
    }

    const repeats = [];
    for (let missing = count; missing > 0; missing -= repeats.at(-1)) {
      repeats.push([...counts, missing].find((number) => number <= missing));
    }
    notes.changes.push(`${attributeWords("count", count)} is sampled as ${repeats.join(" + ")}`);
    return repeats.map((number) => [{ ...mention, attributes: { ...mention.attributes, count: number } }]);
  }
}

/** Returns the steps with pairs that the model knows as one action: "stretches both arms and leans to the left". */
function joinedSteps(steps, names) {
  const pairs = once(`pairs of ${names}`, () => {
    const joining = [...actions().values()].filter((entry) => entry.joins.length && names.includes(entry.name));
    return new Map(joining.map((entry) => [entry.joins.join(), entry]));
  });
  const joined = [];
  for (const step of steps) {
    const before = joined.at(-1) ?? [];
    const entry = pairs.get([...before, ...step].map(({ action }) => action).join());
    if (!entry || before.length !== 1) {
      joined.push(step);
      continue;
    }
    const stated = Object.entries({ ...before[0].attributes, ...step[0].attributes });
    const attributes = Object.fromEntries(stated.filter(([name]) => entry.takes.has(name)));
    const text = `${before[0].text} and ${step[0].text}`;
    joined.splice(-1, 1, [{ ...step[0], action: entry.name, attributes, text }]);
  }
  return joined;
}

/** Returns the caption for a step. If the model knows a word of the sentence that is in no table, the sentence is kept. */
function captionOf(step, words, special) {
  const isSpecial = words.toLowerCase().split(/\s+/u).some((word) => special.has(word));
  return isSpecial ? words : caption(step);
}

/** Returns a sentence without a final "in limp style", which adapters teach, and this ending. */
function withoutStyle(text) {
  const trimmed = text.replace(/[ .]+$/, "");
  const at = trimmed.lastIndexOf(" in ");
  const style = trimmed.slice(at + 4);
  const isStyle = at >= 0 && style.endsWith(" style") && style.split(" ").length === 2;
  return isStyle ? [trimmed.slice(0, at), ` in ${style}`] : [text, ""];
}
