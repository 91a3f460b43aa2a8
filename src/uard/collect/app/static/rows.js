// The rows of the form: one for the question, one for each further thing to rate.

export const shortened = (x) => String(Number(x.toPrecision(3)));
const NOTCHES = 200; // of a slider; the arrows move it by ten

export class SliderRow {
  constructor(place, config) {
    this.place = place;
    this.name = place.dataset.attribute;
    this.config = config;
    this.input = place.querySelector("input");
    this.box = place.querySelector(".slider");
    this.output = place.querySelector("output");
    for (const kind of ["input", "pointerup"]) this.input.addEventListener(kind, () => this.mark(true));
    this.reset();
  }

  get value() {
    const { low, high } = this.config;
    const value = Number((low + ((high - low) * Number(this.input.value)) / NOTCHES).toPrecision(12));
    return Math.min(Math.max(value, low), high);
  }

  mark(set) {
    this.isSet = set;
    this.box.classList.toggle("unset", !set);
    const text = set ? `${shortened(this.value)} ${this.config.unit}` : "not set";
    this.output.textContent = text;
    this.input.setAttribute("aria-valuetext", text);
    this.input.style.setProperty("--part", `${(100 * Number(this.input.value)) / NOTCHES}%`);
  }

  reset() {
    this.input.value = String(NOTCHES / 2);
    this.mark(false);
  }

  digit(number) {
    if (number < 1) return false;
    this.input.value = String(((number - 1) * NOTCHES) / 8);
    this.mark(true);
    return true;
  }

  arrow(key, fine) {
    const by = (fine ? 1 : NOTCHES / 20) * (key === "ArrowRight" || key === "ArrowUp" ? 1 : -1);
    this.input.value = String(Number(this.input.value) + by);
    this.mark(true);
    return true;
  }

  focus() {
    this.input.focus();
  }
}

// Stars, thumbs and the two sides of a pair: one of several buttons.
export class RadioRow {
  constructor(place, config) {
    this.place = place;
    this.name = place.dataset.attribute;
    this.config = config;
    this.inputs = [...place.querySelectorAll("input")];
    this.output = place.querySelector("output");
    for (const input of this.inputs) input.addEventListener("change", () => this.mark());
    this.mark();
  }

  get at() {
    return this.inputs.findIndex((input) => input.checked);
  }

  get isSet() {
    return this.at >= 0;
  }

  get value() {
    return this.config.levels[this.at];
  }

  get choice() {
    return this.inputs[this.at].value;
  }

  mark() {
    const { kind, stars, levels, unit } = this.config;
    this.inputs.forEach((input, k) => {
      input.parentElement.classList.toggle("on", kind === "stars" ? k <= this.at : k === this.at);
    });
    if (this.output) this.output.textContent = this.isSet ? `${this.at + 1} of ${stars}: ${shortened(levels[this.at])} ${unit}` : "not set";
    this.changed?.(this.isSet ? this.inputs[this.at].value : null);
  }

  pick(at) {
    if (at < 0 || at >= this.inputs.length) return false;
    if (this.inputs.includes(document.activeElement)) this.inputs[at].focus();
    this.inputs[at].checked = true;
    this.mark();
    return true;
  }

  reset() {
    for (const input of this.inputs) input.checked = false;
    this.mark();
  }

  digit(number) {
    const { kind } = this.config;
    if (kind === "stars") return this.pick((number || 10) - 1);
    if (kind === "thumbs") return number === 1 ? this.pick(1) : number === 2 && this.pick(0);
    return this.pick([-1, 0, 3, 1, 2][number] ?? -1);
  }

  arrow(key) {
    const { kind } = this.config;
    const on = key === "ArrowRight" || key === "ArrowUp";
    if (kind === "thumbs") return this.pick(on ? 1 : 0);
    if (kind === "pairs") return this.pick({ ArrowLeft: 0, ArrowUp: 1, ArrowDown: 2, ArrowRight: 3 }[key]);
    if (!this.isSet) return this.pick(on ? Math.floor(this.inputs.length / 2) : Math.ceil(this.inputs.length / 2) - 1);
    return this.pick(Math.min(Math.max(this.at + (on ? 1 : -1), 0), this.inputs.length - 1));
  }

  focus() {
    (this.inputs[this.at] ?? this.inputs[0]).focus();
  }
}
