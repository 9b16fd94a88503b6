// Shows the recognized meaning of a text as chips: a port of flame_mdm/demo/chips.py. The text is interpreted by
// language_words.js, language_sentences.js and language_reading.js.
import { download, json } from "./sampling.js";
import { actions, constant, useTables } from "./language_words.js";
import { mentionsOf, understand } from "./language_sentences.js";
import { Reader, attributeWords, caption, predicate } from "./language_reading.js";

/** Returns the language tables, the word vectors, and the names of the pictures. */
export function languageFiles() {
  return Promise.all([json("language.json"), download("language.bin"), json("pictures.json")]);
}

/** Returns the reader for a model, and a function that returns the picture for the action in a caption. */
export function openLanguage(model, [tables, bytes, pictures]) {
  useTables(tables, bytes);
  const picture = (text) => {
    const [mention] = mentionsOf(understand(text));
    return mention && pictures[mention.action];
  };
  return { reader: new Reader(model), picture };
}

/**
 * Returns the chips for a text: its actions in order, their attributes, and the words that have no effect.
 * `choose` is called with the text in which the chosen value replaces the value of the chip.
 */
export function chips(abilities, { steps, ignored }, choose) {
  const rows = steps.map((step, number) => {
    const row = document.createElement("span");
    if (number) row.classList.add("later");
    if (number) row.append("then");
    for (const [position, mention] of step.entries()) {
      if (position) row.append("+");
      const changed = (other) => {
        const mentions = step.map((one) => (one === mention ? other : one));
        return steps.map((one) => caption(one === step ? mentions : one)).join(", then ");
      };
      row.append(...selects(abilities, mention, changed, choose));
    }
    return row;
  });
  if (!rows.length) return [];
  const crossed = ignored.map((word) => Object.assign(document.createElement("del"), { textContent: word }));
  return [...rows, ...crossed];
}

/** Returns the chips for an action; `changed` returns the text with another action. */
function selects(abilities, mention, changed, choose) {
  const names = [mention.action, ...abilities.actions.filter((name) => name !== mention.action)];
  const others = names.map((name) => [changed(withAction(mention, name)), actionLabel(name)]);
  const listed = [select("Action", others, 0, choose)];
  for (const [name, values] of abilities.choices(mention.action)) {
    const options = [[changed(withValue(mention, name, undefined)), `any ${name}`]];
    for (const value of values) {
      options.push([changed(withValue(mention, name, value)), attributeWords(name, value)]);
    }
    const label = name[0].toUpperCase() + name.slice(1);
    listed.push(select(label, options, 1 + values.indexOf(mention.attributes[name]), choose));
  }
  return listed;
}

/** Returns the words for an action without its usual direction, which another chip may contradict. */
function actionLabel(action) {
  const words = predicate({ action });
  const usual = ` ${actions().get(action).usual}`;
  return words.endsWith(usual) ? words.slice(0, -usual.length) : words;
}

function select(label, options, chosen, choose) {
  const element = document.createElement("select");
  element.setAttribute("aria-label", label);
  for (const [text, shown] of options) element.append(new Option(shown, text));
  element.selectedIndex = chosen;
  element.classList.toggle("open", label !== "Action" && chosen === 0);
  element.addEventListener("change", () => choose(element.value));
  return element;
}

function withValue(mention, name, value) {
  const { [name]: _, ...rest } = mention.attributes;
  return { ...mention, attributes: value === undefined ? rest : { ...rest, [name]: value } };
}

function withAction(mention, action) {
  const { takes } = actions().get(action);
  const stated = Object.entries(mention.attributes);
  const kept = stated.filter(([name]) => takes.has(name) && constant("shown").includes(name));
  return { ...mention, action, attributes: Object.fromEntries(kept) };
}
