// Items on a page: clips from one sheet of frames, drawn on a canvas, and texts as they are.

export const SPEEDS = [0.25, 0.5, 1, 2];
const QUIET = window.matchMedia("(prefers-reduced-motion: reduce)");

// Fetches a clip's sheet and decodes it; a text needs nothing.
export async function prepare(content) {
  if (!content) throw new Error("there is no such item");
  if (content.kind !== "clip") return { content };
  const response = await fetch(`/media/${content.sheet}`);
  if (!response.ok) throw new Error(`${response.status}`);
  return { content, sheet: await createImageBitmap(await response.blob()) };
}

function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "class") made.className = value;
    else if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function textBox(title, text, kind) {
  const box = element("div", { class: `text ${kind}`, tabindex: "0", role: "region", "aria-label": title });
  box.textContent = text;
  return element("div", { class: "texts" }, element("p", { class: "label", "aria-hidden": "true" }, title), box);
}

// What is shown of one clip; `draw` shows a frame of it, the last one if it is shorter.
class Clip {
  constructor({ content, sheet }, label) {
    this.content = content;
    this.sheet = sheet;
    this.canvas = element("canvas", { role: "img", "aria-label": label });
    this.canvas.width = content.width;
    this.canvas.height = content.height;
    if (content.width < 120) this.canvas.className = "pixels";
    this.pen = this.canvas.getContext("2d");
  }

  draw(frame) {
    const { width, height, columns, frames } = this.content;
    const at = Math.max(Math.min(Math.floor(frame), frames - 1), 0);
    const x = (at % columns) * width;
    const y = Math.floor(at / columns) * height;
    this.pen.drawImage(this.sheet, x, y, width, height, 0, 0, width, height);
  }
}

// One item or two side by side, with one set of controls for all clips among them.
export class Stage {
  constructor(place, { autoplay = true, compact = false } = {}) {
    this.place = place;
    this.autoplay = autoplay;
    this.compact = compact;
    this.clips = [];
    this.speed = 1;
    this.tick = this.tick.bind(this);
  }

  // `parts`: what `prepare` has returned, from left to right; `names`: what each is called.
  show(parts, names) {
    this.stop();
    this.clips = [];
    const same = parts.length > 1 && parts.every((p) => p.content.kind === "text" && p.content.prompt === parts[0].content.prompt);
    const panels = parts.map((part, k) => this.panel(part, names[k], parts.length > 1, same));
    const row = element("div", { class: `panels n${parts.length}` }, ...panels);
    const shared = same && parts[0].content.prompt ? [textBox("Prompt", parts[0].content.prompt, "prompt")] : [];
    this.place.replaceChildren(...shared, row);
    this.controls = null;
    if (this.clips.length) {
      this.frames = Math.max(...this.clips.map((c) => c.content.frames));
      this.fps = this.clips[0].content.fps;
      if (this.frames > 1) this.place.append(this.transport());
      this.seek(0);
      if (this.autoplay && !QUIET.matches) this.play();
    }
  }

  panel(part, name, titled, promptAbove) {
    const { content } = part;
    const title = titled ? [element("h2", { class: "side" }, name)] : [];
    const paid = content.reward === undefined || content.reward === null ? [] : [element("p", { class: "paid" }, `The environment paid ${Number(content.reward.toPrecision(3))} per step.`)];
    if (content.kind === "clip") {
      const clip = new Clip(part, `${name}, ${content.frames} frames`);
      clip.canvas.addEventListener("click", () => this.toggle());
      this.clips.push(clip);
      return element("div", { class: "panel card" }, ...title, clip.canvas, ...paid);
    }
    const prompt = content.prompt && !promptAbove ? [textBox(titled ? `Prompt, ${name.toLowerCase()}` : "Prompt", content.prompt, "prompt")] : [];
    const answer = textBox(titled ? `Answer, ${name.toLowerCase()}` : "Answer", content.completion, "completion");
    return element("div", { class: "panel card" }, ...title, ...prompt, answer, ...paid);
  }

  transport() {
    this.toggler = element("button", { type: "button", class: "play", "aria-label": "Play", onclick: () => this.toggle() });
    this.scrub = element("input", { type: "range", class: "scrub", min: "0", max: String(this.frames - 1), step: "1", value: "0", "aria-label": "Frame" });
    this.scrub.addEventListener("input", () => { this.stop(); this.seek(Number(this.scrub.value)); });
    this.scrub.addEventListener("pointerup", () => this.scrub.blur());
    this.counter = element("span", { class: "frame", "aria-hidden": "true" });
    const step = (by, name, sign) => element("button", { type: "button", "aria-label": name, onclick: () => this.step(by) }, sign);
    this.speeds = SPEEDS.map((speed) => element("button", { type: "button", "aria-pressed": String(speed === this.speed), "aria-label": `Speed ${speed}`, onclick: () => this.setSpeed(speed) }, `${speed}×`));
    const speeds = element("span", { class: "speeds", role: "group", "aria-label": "Speed" }, ...this.speeds);
    const parts = this.compact ? [this.toggler, this.scrub] : [this.toggler, step(-1, "One frame back", "‹"), step(1, "One frame on", "›"), this.scrub, this.counter, speeds];
    this.controls = element("div", { class: "transport", role: "group", "aria-label": "Player" }, ...parts);
    return this.controls;
  }

  get playing() { return this.request !== undefined; }

  seek(frame) {
    this.frame = Math.max(0, Math.min(frame, this.frames - 1));
    for (const clip of this.clips) clip.draw(this.frame);
    if (!this.controls) return;
    const at = Math.floor(this.frame);
    this.scrub.value = String(at);
    this.scrub.setAttribute("aria-valuetext", `frame ${at + 1} of ${this.frames}`);
    this.counter.textContent = `${at + 1}/${this.frames}`;
  }

  step(by) {
    if (!this.clips.length) return;
    this.stop();
    this.seek(Math.floor(this.frame) + by);
  }

  toggle() {
    if (this.playing) this.stop();
    else this.play();
  }

  play() {
    if (!this.clips.length || this.playing) return;
    if (this.frame >= this.frames - 1) this.frame = 0;
    this.before = undefined;
    this.request = requestAnimationFrame(this.tick);
    this.label();
  }

  stop() {
    if (this.playing) cancelAnimationFrame(this.request);
    this.request = undefined;
    this.along = undefined;
    this.label();
  }

  label() {
    if (!this.controls) return;
    this.toggler.setAttribute("aria-label", this.playing ? "Pause" : "Play");
    this.toggler.classList.toggle("playing", this.playing);
  }

  // Goes round and round, with a short rest on the last frame.
  tick(now) {
    const passed = this.before === undefined ? 0 : Math.min((now - this.before) / 1000, 0.5);
    this.before = now;
    const rest = 0.6 * this.fps;
    let at = (this.along ?? this.frame) + passed * this.fps * this.speed;
    if (at >= this.frames + rest) at = 0;
    this.seek(at);
    this.along = at > this.frames - 1 ? at : undefined;
    this.request = requestAnimationFrame(this.tick);
  }

  setSpeed(speed) {
    this.speed = speed;
    this.speeds?.forEach((button, k) => button.setAttribute("aria-pressed", String(SPEEDS[k] === speed)));
  }

  changeSpeed(by) {
    const at = SPEEDS.indexOf(this.speed) + by;
    if (at >= 0 && at < SPEEDS.length) this.setSpeed(SPEEDS[at]);
  }
}

// The parts of an item as it stands in a page of examples or of the owner, from left to right.
export async function parts(item) {
  return Promise.all((item.kind === "pair" ? [item.left, item.right] : [item]).map(prepare));
}

// Shows items where they stand as data in a page.
export function showAll(selector) {
  for (const place of document.querySelectorAll(selector)) {
    const item = JSON.parse(place.dataset.item);
    const stage = new Stage(place, { autoplay: false, compact: true });
    const names = item.kind === "pair" ? ["Left", "Right"] : [item.kind === "text" ? "Text" : "Clip"];
    parts(item).then((ready) => stage.show(ready, names)).catch(() => { place.textContent = "This item cannot be shown: its file is missing."; });
  }
}
