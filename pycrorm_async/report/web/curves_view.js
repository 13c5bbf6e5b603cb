// Shows values over the axis of the chart: a small curve of each in the panel, and the chosen ones over one another below it.

import { element, HUES, recorded, replaceIn, svg } from "./dom.js";
import { extremes, lastUpTo } from "./episode.js";

const FIGURES_MAX = 60;
const POINTS_MAX = 1000;
const [HIGH, PAD] = [124, 16]; // of the chosen ones, with room for the ends of their scales
const [FIGURE_WIDE, FIGURE_HIGH] = [220, 46];
const STROKES = ["none", "7 3", "2 3", "9 3 2 3", "14 4", "4 4"]; // of the chosen ones, which so differ without colour

const short = (number) => String(Number(Number(number).toPrecision(4)));

export class CurvesView {
  /** `gantt` has the axis; `onChoose` is called when other curves are chosen. */
  constructor(holder, episode, gantt, onChoose) {
    Object.assign(this, { holder, episode, gantt, onChoose, chosen: new Map(), alone: false });
    this.legend = element("div", { class: "legend", tabindex: -1 }); // it gets the focus of a button that is gone
    const keys = "W and S zoom, A and D move, 0 shows all";
    this.overlay = element("div", { class: "overlay", role: "application", tabindex: 0, "aria-label": `Curves on the axis of the chart: ${keys}` });
    gantt.steer(this.overlay);
    this.find = element("input", { type: "search", placeholder: "names", "aria-label": "words in the names of curves", "data-key": "names" });
    this.find.addEventListener("input", () => this.onChoose());
    this.find.addEventListener("keydown", (pressed) => pressed.stopPropagation());
    this.note = element("span", { class: "quiet" });
    this.head = element("p", {}, this.find, this.note); // one for all drawings, so that the field keeps the focus
  }

  /** All values that change, as `{ key, name, track, unit }`. */
  get #moving() {
    const { series, samples } = this.episode;
    const curves = [...series].map(([name, track]) => ({ key: name, name, track, unit: "" }));
    for (const [id, channels] of samples) {
      for (const [name, track] of channels) curves.push({ key: `${id} ${name}`, name: `${this.episode.nameOf(id)} ${name}`, track, unit: this.episode.unitOf(id, name) });
    }
    return curves.filter(({ track: { values } }) => values.some((each) => each !== values[0]));
  }

  /** Draw the curves with these keys below the chart, and no others. */
  choose(keys) {
    const moving = this.#moving;
    this.chosen.clear();
    for (const curve of keys.map((key) => moving.find((each) => each.key === key))) if (curve !== undefined && !this.chosen.has(curve.key)) this.#choose(curve);
  }

  /** Draw a curve below the chart, or no longer. */
  #choose(curve) {
    const free = STROKES.findIndex((_, index) => ![...this.chosen.values()].some(({ number }) => number === index));
    if (!this.chosen.delete(curve.key) && free >= 0) this.chosen.set(curve.key, { ...curve, number: free });
    this.drawn = "";
    this.show(this.event);
    this.onChoose();
  }

  /** The panel: a small curve of each value, with a button that draws it below the chart. */
  figures() {
    const moving = this.#moving;
    const words = this.find.value.toLowerCase().split(/\s+/).filter(Boolean);
    const matching = moving.filter(({ name }) => words.every((word) => name.toLowerCase().includes(word)));
    const figures = matching.slice(0, FIGURES_MAX).map((each) => this.#figure(each));
    const left = matching.length - figures.length;
    const notes = [left > 0 ? `${left} more: search for their names.` : "", moving.length === 0 ? "No value changes." : "", this.chosen.size >= STROKES.length ? `${STROKES.length} are below the chart; no more have room there.` : ""];
    this.note.textContent = ` A name draws its curve below the chart, over the others. ${notes.filter(Boolean).join(" ")}`;
    const holder = element("div", { class: "curves" }, ...figures);
    holder.addEventListener("keydown", (pressed) => this.gantt.press(pressed));
    return [this.head, holder];
  }

  #figure(curve) {
    const { name, track, unit, key } = curve;
    const { low, high, path } = this.#stepsOf(track, [0, FIGURE_WIDE], (event) => this.gantt.shareOf(event) * FIGURE_WIDE, FIGURE_HIGH, 3);
    const x = this.gantt.shareOf(this.event) * FIGURE_WIDE;
    const picture = svg("svg", { viewBox: `0 0 ${FIGURE_WIDE} ${FIGURE_HIGH}`, class: "curve", preserveAspectRatio: "none", "aria-hidden": "true" });
    picture.append(svg("path", { d: path() }), svg("line", { x1: x, x2: x, y1: 0, y2: FIGURE_HIGH }));
    const chosen = this.chosen.has(key);
    const state = { "aria-pressed": String(chosen), "data-key": key, disabled: !chosen && this.chosen.size >= STROKES.length };
    const button = element("button", { type: "button", class: "link", ...state, onclick: () => this.#choose(curve) }, recorded(name));
    const range = low > high ? "none in this part" : `${short(low)} to ${short(high)} ${unit}`;
    return element("figure", {}, element("figcaption", {}, button, element("b", {}, this.#valueText(track, unit))), picture, element("span", { class: "range" }, range));
  }

  #valueText(track, unit) {
    return `${short(track.valueAt(this.event))} ${unit}`;
  }

  /** The least and the greatest value in the part of the axis that is drawn, and the path of the values between two others. */
  #stepsOf({ at, values }, [left, right], xOf, height, pad) {
    const [first, last] = this.gantt.shownEvents;
    const begin = Math.max(0, lastUpTo(at, first));
    const shown = values.slice(begin, lastUpTo(at, last) + 1);
    const indices = shown.length > POINTS_MAX ? extremes(shown, POINTS_MAX) : [...shown.keys()];
    const low = indices.reduce((least, each) => Math.min(least, shown[each]), Infinity);
    const high = indices.reduce((most, each) => Math.max(most, shown[each]), -Infinity);
    const path = (bottom = low, top = high) => {
      const y = (value) => (height - pad - ((value - bottom) / (top - bottom || 1)) * (height - 2 * pad)).toFixed(1);
      const steps = indices.map((each, index) => `${index === 0 ? "M" : "H"}${Math.max(xOf(at[begin + each]), left).toFixed(1)}${index === 0 ? "," : "V"}${y(shown[each])}`);
      return steps.length > 0 ? `${steps.join("")}H${right}` : "";
    };
    return { low, high, path };
  }

  /** Show the values at a moment. */
  show(event) {
    this.event = event;
    if (this.gantt.places === undefined) return; // the chart is not drawn yet
    this.draw();
    const x = this.gantt.xOf(event);
    for (const each of this.overlay.querySelectorAll("line")) for (const end of ["x1", "x2"]) each.setAttribute(end, x);
    const buttons = [...this.chosen].map(([key, curve]) => {
      const line = svg("svg", { width: 28, height: 10, "aria-hidden": "true" }, svg("path", { d: "M0,5H28", "stroke-dasharray": STROKES[curve.number] }));
      const range = this.alone && curve.low <= curve.high ? ` (${short(curve.low)} to ${short(curve.high)})` : "";
      const texts = [recorded(curve.name), element("b", {}, this.#valueText(curve.track, curve.unit)), range, element("span", { "aria-hidden": "true" }, "✕")];
      return element("button", { type: "button", class: `hue-${curve.number % HUES}`, "data-key": key, title: "no longer below the chart", onclick: () => this.#choose(curve) }, line, ...texts);
    });
    const alone = { type: "button", "data-key": "alone", "aria-pressed": String(this.alone), onclick: () => this.#scale() };
    if (buttons.length > 1) buttons.push(element("button", alone, "each in its own scale"));
    replaceIn(this.legend, ...buttons);
  }

  #scale() {
    this.alone = !this.alone;
    this.drawn = "";
    this.show(this.event);
  }

  /** Draw the chosen curves again if they, or the part of the axis that is drawn, have changed. */
  draw() {
    const { chosen, gantt } = this;
    if (this.holder.hasChildNodes() !== chosen.size > 0) this.holder.replaceChildren(...(chosen.size > 0 ? [this.legend, this.overlay] : []));
    if (chosen.size === 0 || this.drawn === gantt.places) return;
    this.drawn = gantt.places;
    const paths = [];
    const scales = new Map();
    for (const curve of chosen.values()) {
      const steps = this.#stepsOf(curve.track, gantt.ends, (event) => gantt.xOf(event), HIGH, PAD);
      Object.assign(curve, { low: steps.low, high: steps.high });
      const scale = this.alone ? curve.key : curve.unit;
      const [low, high] = scales.get(scale) ?? [Infinity, -Infinity];
      scales.set(scale, [Math.min(low, steps.low), Math.max(high, steps.high)]);
      paths.push(() => svg("path", { d: steps.path(...scales.get(scale)), class: `hue-${curve.number % HUES}`, "stroke-dasharray": STROKES[curve.number] }));
    }
    const units = this.alone ? [] : [...scales].filter(([, [low, high]]) => low <= high);
    const ends = [1, 0].map((end) => svg("text", { x: 10, y: end ? 12 : HIGH - 4 }, units.map(([unit, range]) => `${short(range[end])} ${unit}`.trim()).join(" · ")));
    const cursor = svg("line", { y1: 0, y2: HIGH });
    this.overlay.replaceChildren(svg("svg", { width: "100%", height: HIGH, "aria-hidden": "true" }, ...paths.map((each) => each()), ...ends, cursor));
  }
}
