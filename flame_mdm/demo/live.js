// A stream of motion on a page: clock, buffer, texts. A source makes the blocks: a server, or a worker on the visitor's device.
const AHEAD = 1; // seconds that are left when the next block is asked for
const SLOW = 0.3; // seconds that are left when the clock begins to slow down
const EASE = 0.15; // seconds in which the clock gets back to its speed
const LEAD = 0.25; // least number of seconds from a new text to the first frame that follows it
const STEP = 0.1; // longest step of the clock in seconds; a hidden page pauses the stream
const CHIPS = 6; // texts that can be clicked again

/** A clock that slows down before it reaches the end of the buffer, so that no frame is missing and none is skipped. */
export class Clock {
  constructor(speed = 1) {
    Object.assign(this, { speed, time: 0, rate: 1, slowest: 1, paused: false });
  }

  /** Moves on by up to `seconds`; frames exist until the time `end`. */
  advance(seconds, end) {
    if (this.paused) return this.time;
    const step = Math.min(seconds, STEP) * this.speed;
    const most = Math.min(1, Math.max(0, end - this.time) / (SLOW * this.speed));
    this.rate = Math.min(most, this.rate + (1 - this.rate) * Math.min(1, step / EASE));
    this.slowest = Math.min(this.slowest, this.rate);
    this.time = Math.min(this.time + step * this.rate, end);
    return this.time;
  }
}

/**
 * A stream in a container.
 *
 * @param container element that gets the form, the player and the buttons.
 * @param source `block({ text, from })` returns a promise of { from, frames, motion }: the frames from number `from` on,
 *   in the format of the player. `file(ending)` returns a promise of a file of the last minute.
 * @param page `player(motion)` returns the page of the player that shows a motion; `read(text)` returns what the source
 *   reads for a text, or throws an error with the texts `nearest` in meaning; `fps`, and a first `text`.
 */
export class Live {
  constructor(container, source, page) {
    Object.assign(this, { source, page, clock: new Clock(), end: 0, texts: [], text: page.text, pending: null, busy: false });
    this.seconds = 0; // that a block takes, on average
    this.log = []; // for each new text, when it was typed and when its first frame was shown
    container.innerHTML = `<form><input maxlength="300" autocomplete="off" aria-label="What the person does next"
        placeholder="What the person does next"><button>Go</button></form>
      <div class="texts" role="group" aria-label="Last texts"></div><p role="status"></p>
      <iframe title="The stream"></iframe>
      <div class="tools"><button type="button" class="pause">Pause</button>
      <button type="button" class="bvh">Save BVH</button><button type="button" class="glb">Save GLB</button>
      <span>of the last minute</span></div>`;
    this.find = (selector) => container.querySelector(selector);
    this.find("form").addEventListener("submit", (event) => { event.preventDefault(); this.change(this.find("input").value.trim()); });
    this.find(".pause").addEventListener("click", () => this.pause(!this.clock.paused));
    for (const ending of ["bvh", "glb"]) this.find(`.${ending}`).addEventListener("click", () => this.save(ending));
  }

  async start() {
    const begin = performance.now(), block = await this.source.block({ text: this.page.read(this.text), from: 0 });
    this.seconds = (performance.now() - begin) / 1000;
    this.end = block.from + block.frames;
    const loaded = new Promise((done) => this.find("iframe").addEventListener("load", done, { once: true }));
    this.find("iframe").srcdoc = this.page.player({ ...block.motion, live: true });
    await loaded;
    this.say("");
    this.remember(this.text);
    let before = performance.now();
    const tick = (now) => {
      this.advance((now - before) / 1000);
      before = now;
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  get fps() { return this.page.fps; }
  get frame() { return Math.floor(this.clock.time * this.fps); }

  advance(seconds) {
    const end = this.pending?.from ?? this.end; // frames from `from` on are about to be replaced
    this.clock.advance(seconds, (end - 1) / this.fps);
    this.send({ frame: this.frame });
    for (const entry of this.log) if (entry.from !== undefined && entry.from <= this.frame) entry.shown ??= performance.now();
    const left = this.end / this.fps - this.clock.time;
    if (!this.busy && (this.pending || left < this.clock.speed * Math.max(AHEAD, 1.5 * this.seconds))) this.ask();
  }

  async ask() {
    this.busy = true;
    const change = this.pending, from = change ? change.from : this.end, begin = performance.now();
    try {
      const block = await this.source.block({ text: this.page.read(change?.text ?? this.text), from });
      this.seconds += 0.3 * ((performance.now() - begin) / 1000 - this.seconds);
      this.end = block.from + block.frames;
      this.send({ from: block.from, motion: block.motion });
      if (change) {
        this.text = change.text;
        change.entry.from = block.from;
      }
    } catch (error) {
      this.say(error.message.split("\n")[0], error.nearest);
      if (!change) this.pause(true);
    }
    if (this.pending === change) this.pending = null;
    else if (this.pending) this.pending.from = Math.min(this.pending.from, this.end);
    this.busy = false;
  }

  /** Changes the text from the first frame on that can still be made in time. */
  change(text) {
    if (!text) return;
    try {
      this.page.read(text);
    } catch (error) {
      this.say(error.message, error.nearest);
      return;
    }
    this.say("");
    const lead = Math.ceil(this.fps * this.clock.speed * Math.max(LEAD, 1.5 * this.seconds));
    const entry = { text, typed: performance.now() };
    this.log.push(entry);
    this.pending = { text, from: Math.min(this.end, this.frame + 1 + lead), entry };
    this.remember(text);
    this.find("input").value = "";
    this.pause(false);
  }

  pause(paused) {
    this.clock.paused = paused;
    this.find(".pause").textContent = paused ? "Go on" : "Pause";
  }

  remember(text) {
    this.texts = [text, ...this.texts.filter((other) => other !== text)].slice(0, CHIPS);
    this.find(".texts").replaceChildren(...this.texts.map((other, k) => this.button(other, k === 0)));
  }

  button(text, current = false) {
    const button = Object.assign(document.createElement("button"), { type: "button", textContent: text });
    if (current) button.setAttribute("aria-current", "true");
    button.addEventListener("click", () => this.change(text));
    return button;
  }

  say(text, nearest = []) {
    this.find("[role=status]").textContent = nearest.length ? `${text}. Nearest in meaning: ` : text;
    this.find("[role=status]").append(...nearest.map((other) => this.button(other)));
  }

  send(message) {
    this.find("iframe").contentWindow.postMessage(message, "*");
  }

  async save(ending) {
    const link = Object.assign(document.createElement("a"), { download: `stream.${ending}` });
    try {
      link.href = URL.createObjectURL(await this.source.file(ending));
    } catch (error) {
      this.say(error.message.split("\n")[0]);
      return;
    }
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }
}
