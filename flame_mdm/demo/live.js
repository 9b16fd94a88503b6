// A stream of motion on a page: clock, buffer, texts and waypoints. The blocks come from a source: a server, or a worker on the visitor's device.
const AHEAD = 1; // seconds of motion that are left when the next block is requested
const SLOW = 0.15; // seconds of motion that are left when the clock begins to slow down
const EASE = 0.15; // seconds over which the clock returns to its normal speed
const LEAD = 0.25; // minimum number of seconds from a new text to the first frame that follows it
const STEP = 0.1; // maximum clock step in seconds; a hidden page pauses the stream
const CHIPS = 6; // texts that can be clicked again
const SPARE = 1.4; // time reserved for the block of a new text, in multiples of the median
const TIMED = 5; // number of recent blocks whose median time predicts how long the next block takes
const MOST_POINTS = 16;
const GOES = /\b(walk|run|jog|march|stride|stroll|skip|sneak|limp|strafe|stagger|tiptoe|crawl)(s|ing)?\b/i; // texts that are kept when waypoints are added
const HINT = "Click on the floor: the person goes there";

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
 * @param source `block({ text, from, path })` returns a promise of { from, frames, reached, motion }: the frames starting at
 *   index `from`, in the format of the player, which lead along the waypoints `path`, and the indices of the frames that
 *   reach the first of these waypoints. `cancel()`, if it exists, rejects the promise of a block. `file(ending)` returns a
 *   promise of a file with the last minute.
 * @param page `player(motion)` returns the page of the player that shows a motion; `read(text)` returns what the source
 *   reads for a text, or throws an error with the texts `nearest` in meaning; `fps`; a first `text`, in which the person is
 *   standing; and a text `walk` for the path to waypoints, null without waypoints.
 */
export class Live {
  constructor(container, source, page) {
    Object.assign(this, { source, page, clock: new Clock(), end: 0, texts: [], text: page.text });
    this.pending = null; // the change that has not been requested yet, or whose block has not arrived: { text, from, entry }
    this.busy = false; // a block is being generated
    this.times = []; // seconds that the last blocks took
    this.points = []; // waypoints: { place, reached }, the index of the frame that reaches it, or null
    this.log = []; // for each new text: when it was typed, and when its first frame was shown
    container.innerHTML = `<form><input maxlength="300" autocomplete="off" aria-label="What the person does next"
        placeholder="What the person does next"><button>Go</button></form>
      <div class="texts" role="group" aria-label="Last texts"></div><p role="status"></p>
      <iframe title="The stream"></iframe>
      <div class="tools"><button type="button" class="pause">Pause</button>
      <button type="button" class="clear" hidden>Clear waypoints</button>
      <button type="button" class="bvh">Save BVH</button><button type="button" class="glb">Save GLB</button>
      <span>of the last minute</span></div>`;
    this.find = (selector) => container.querySelector(selector);
    this.find("form").addEventListener("submit", (event) => { event.preventDefault(); this.change(this.find("input").value.trim()); });
    this.find(".pause").addEventListener("click", () => this.pause(!this.clock.paused));
    this.find(".clear").addEventListener("click", () => this.removePoints(0, this.points.length));
    for (const ending of ["bvh", "glb"]) this.find(`.${ending}`).addEventListener("click", () => this.save(ending));
    addEventListener("message", ({ source: sender, data }) => {
      if (sender !== this.find("iframe").contentWindow) return;
      if (data.floor) this.addPoint(data.floor);
      else if (data.point !== undefined) this.removePoints(data.point, 1);
    });
  }

  async start() {
    const block = await this.timed({ text: this.page.read(this.text), from: 0, path: [] });
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

  /** Seconds that a block takes: the lower median over the last blocks, because the first block is slow. */
  get seconds() { return [...this.times].sort((a, b) => a - b)[(this.times.length - 1) >> 1]; }

  /** The text of the last frames after the pending change. */
  get next() { return this.pending?.text ?? this.text; }

  async timed(request) {
    const begin = performance.now(), block = await this.source.block(request);
    this.times = [...this.times, (performance.now() - begin) / 1000].slice(-TIMED);
    return block;
  }

  advance(seconds) {
    const end = this.pending?.from ?? this.end; // frames from `from` on are about to be replaced
    this.clock.advance(seconds, (end - 1) / this.fps);
    this.send({ frame: this.frame });
    for (const entry of this.log) if (entry.from !== undefined && entry.from <= this.frame) entry.shown ??= performance.now();
    const left = this.points.filter(({ reached }) => reached === null || reached > this.frame);
    if (left.length < this.points.length) this.showPoints(left);
    const ahead = this.end / this.fps - this.clock.time;
    if (!this.busy && (this.pending || ahead < this.clock.speed * Math.max(AHEAD, 1.5 * this.seconds))) this.ask();
  }

  async ask() {
    this.busy = true;
    const change = this.pending, from = change ? change.from : this.end;
    // Frames that reach waypoints are replaced, too.
    const path = this.points.filter(({ reached }) => reached === null || reached >= from);
    this.isSpare = !change;
    try {
      const text = this.page.read(change?.text ?? this.text);
      const block = await this.timed({ text, from, path: path.map(({ place }) => place) });
      this.end = block.from + block.frames;
      this.send({ from: block.from, motion: block.motion });
      path.forEach((point, k) => { point.reached = block.reached[k] ?? null; });
      if (change) this.follow(change, block.from);
    } catch (error) {
      if (!this.isCanceled) this.refuse(change, error);
    }
    this.isCanceled = false;
    if (this.pending === change) this.pending = null;
    else if (this.pending) this.pending.from = Math.min(this.pending.from, this.end);
    this.busy = false;
    if (!this.pending) this.stopAtLast();
  }

  /** Adopts the text of a change whose frames have arrived. */
  follow({ text, entry }, from) {
    if (text !== this.text) this.remember(text);
    this.text = text;
    if (entry) entry.from = from;
  }

  refuse(change, error) {
    this.say(error.message.split("\n")[0], error.nearest);
    if (!change) this.pause(true);
    else if (!this.find("input").value) this.find("input").value = change.text;
  }

  /** Stops a moving person where the last waypoint is reached. */
  stopAtLast() {
    const last = this.points.at(-1)?.reached ?? null;
    if (last !== null && GOES.test(this.text)) this.replace(this.page.text, undefined, last + 1);
  }

  /** Changes the text, starting at the first frame that can still be generated in time. */
  change(text) {
    if (!text) return;
    let caption;
    try {
      caption = this.page.read(text);
    } catch (error) {
      this.say(error.message, error.nearest);
      return;
    }
    this.say(caption === text ? "" : `Read as: ${caption}`);
    const entry = { text, typed: performance.now() };
    this.log.push(entry);
    this.replace(text, entry);
    this.find("input").value = "";
    this.pause(false);
  }

  /** Requests new frames, starting at index `least` or at the first frame that can still be generated in time. */
  replace(text, entry = undefined, least = 0) {
    if (this.busy && this.isSpare && this.source.cancel) {
      this.isCanceled = true;
      this.source.cancel();
    }
    // The clock does not slow down if the block takes as long as the previous blocks. A canceled block ends after its step.
    const lead = Math.ceil(this.fps * this.clock.speed * Math.max(LEAD, SPARE * this.seconds + SLOW));
    this.pending = { text, from: Math.min(this.end, Math.max(least, this.frame + 1 + lead)), entry };
  }

  /** Adds a waypoint. The person goes there as the text says, or walks if the text describes no locomotion. */
  addPoint(place) {
    if (!this.page.walk) return;
    if (this.points.length >= MOST_POINTS) {
      this.say(`A path can have at most ${MOST_POINTS} waypoints. Click one to remove it`);
      return;
    }
    this.say("");
    this.showPoints([...this.points, { place, reached: null }]);
    this.reroute(GOES.test(this.next) ? this.next : this.page.walk);
  }

  removePoints(first, count) {
    this.showPoints(this.points.filter((_, k) => k < first || k >= first + count));
    this.reroute(this.points.length || !GOES.test(this.next) ? this.next : this.page.text);
  }

  reroute(text) {
    this.replace(text, text === this.pending?.text ? this.pending.entry : undefined);
  }

  showPoints(points) {
    this.points = points;
    this.find(".clear").hidden = !points.length;
    this.send({ points: points.map(({ place }) => place) });
  }

  pause(paused) {
    this.clock.paused = paused;
    this.find(".pause").textContent = paused ? "Resume" : "Pause";
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
    const shown = text || (this.page.walk ? HINT : "");
    this.find("[role=status]").textContent = nearest.length ? `${text}. Nearest in meaning: ` : shown;
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
