// Runs the script of a player page without a browser and prints the values of expressions.
// Stand-ins for elements keep what is assigned to them. Arguments: the page, and a JSON list of expressions.
import { readFileSync } from "node:fs";
import vm from "node:vm";

const [file, expressions] = [process.argv[2], JSON.parse(process.argv[3])];
const source = readFileSync(file, "utf-8");
const parts = [...source.matchAll(/<script([^>]*)>([\s\S]*?)<\/script>/g)];
const texts = Object.fromEntries(parts.flatMap(([, tag, text]) => (tag.includes("id=") ? [[tag.match(/id="(\w+)"/)[1], text]] : [])));
const strokes = []; // calls of all canvases, with the colors and the width at that time

class Classes extends Set {
  toggle(name, on) { if (on) this.add(name); else this.delete(name); }
  contains(name) { return this.has(name); }
}

class Stub {
  constructor(tag, id = "") {
    Object.assign(this, { tagName: tag.toUpperCase(), id, style: {}, classList: new Classes(), children: [], found: {}, listeners: {} });
    Object.assign(this, { textContent: texts[id] ?? "", value: "0", checked: false, hidden: false, width: 0, height: 0 });
    Object.assign(this, { clientWidth: 600, clientHeight: 400 });
  }
  get parentElement() { return (this.above ??= new Stub("div")); }
  append(...items) { this.children.push(...items); }
  replaceChildren(...items) { this.children = items; }
  setAttribute(name, value) { this[name] = value; }
  querySelector(name) { return this.children.map((c) => (c.tagName === name.split(" ").at(-1).toUpperCase() ? c : c.querySelector?.(name))).find((c) => c?.tagName === name.split(" ").at(-1).toUpperCase()) ?? (this.tagName === "BUTTON" ? (this.found[name] ??= new Stub(name)) : undefined); }
  addEventListener(kind, handler) { (this.listeners[kind] ??= []).push(handler); }
  send(kind, event = {}) { for (const handler of this.listeners[kind] ?? []) handler({ target: this, preventDefault() {}, ...event }); }
  getBoundingClientRect() { return { left: 0, top: 0, width: this.width || 600, height: this.height || 400, bottom: this.height || 400 }; }
  click() { this.send("click"); }
  getContext() {
    this.context ??= new Proxy({ canvas: this }, {
      get: (state, name) => state[name] ?? ((...words) => {
        strokes.push({ name, words, fill: state.fillStyle, stroke: state.strokeStyle, wide: state.lineWidth });
        return { addColorStop() {} };
      }),
    });
    return this.context;
  }
}

const elements = {}, listeners = {}, posted = [], root = new Stub("html");
const main = new Stub("main"), global = { console, atob, strokes, posted, listeners, devicePixelRatio: 2 };
const ids = new Map([...source.matchAll(/<(\w+)[^>]* id="([\w-]+)"([^>]*)>/g)].map(([, tag, id]) => [id, tag]));
global.document = {
  getElementById: (id) => (elements[id] ??= new Stub(ids.get(id) ?? "div", id)),
  createElement: (tag) => new Stub(tag),
  querySelector: () => main,
  querySelectorAll: () => [],
  documentElement: root,
  body: new Stub("body"),
  addEventListener: (kind, handler) => (listeners[kind] = handler),
};
elements.loop = Object.assign(new Stub("input", "loop"), { checked: true });
elements.follow = Object.assign(new Stub("input", "follow"), { checked: true });
elements.speed = Object.assign(new Stub("select", "speed"), { value: "1" });
for (const id of ["filter", "group"]) elements[id] = Object.assign(new Stub("input", id), { value: "" });
global.addEventListener = (kind, handler) => (listeners[kind] = handler);
global.parent = { postMessage: (message) => posted.push(message) };
global.window = global;
global.matchMedia = () => ({ matches: true, addEventListener() {} });
const shades = { left: "#2f7fd1", right: "#e2702a", middle: "#8c95a3", contact: "#0f9d6b", trail: "#7a5bd0" };
global.getComputedStyle = () => ({ getPropertyValue: (name) => shades[name.slice(2)] ?? "#ffffff" });
global.ImageData = class { constructor(width, height) { Object.assign(this, { width, height, data: new Uint8ClampedArray(4 * width * height) }); } };
global.requestAnimationFrame = () => {};
global.ResizeObserver = class { observe() {} };
global.setTimeout = () => {};
global.Blob = class { constructor(content) { this.text = content.join(""); } };
global.URL = { createObjectURL: (blob) => blob.text, revokeObjectURL() {} };
vm.createContext(global);
vm.runInContext(parts.at(-1)[2], global);
// Numbers that JSON lacks and typed arrays become plain
const plain = (key, value) => (ArrayBuffer.isView(value) ? [...value] : value instanceof Set ? [...value] : value);
console.log(JSON.stringify(expressions.map((text) => vm.runInContext(text, global) ?? null), plain));
