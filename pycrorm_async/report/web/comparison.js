// Shows two episodes side by side: their task trees aligned, what differs in them, and their scenes on one clock.

import { Bodies } from "./bodies.js";
import { duration, element, recorded } from "./dom.js";
import { Episode, signOf } from "./episode.js";
import { MapView } from "./map_view.js";
import { SceneView } from "./scene_view.js";

const LETTERS = ["A", "B"];
const LISTED_MAX = 1000;
const INDENT_PX = 14;
const INDENTS_MAX = 12;
const LONGER = 1.5; // so many times as long is marked,
const LONGER_SHARE = 0.02; // unless it is less than this share of the longer episode
const STEPS = 1000;
const TEXT_MAX = 300;

const part = (name) => document.getElementById(name);

/** Pairs of nodes, each before those below it; a node that has no partner stands where it would be among its siblings. */
function alignedNodes(roots, otherRoots) {
  const rows = [];
  const stack = siblingPairs(roots, otherRoots, null).reverse();
  while (stack.length > 0) {
    const row = stack.pop();
    row.number = rows.push(row) - 1;
    const [children, others] = row.nodes.map((each) => each?.children ?? []);
    for (const each of siblingPairs(children, others, row).reverse()) stack.push(each);
  }
  return rows;
}

/** Siblings in pairs: those of one name correspond by their number among those of this name. */
function siblingPairs(siblings, others, parent) {
  const [keys, otherKeys] = [siblings, others].map(namesInOrder);
  const places = new Map(otherKeys.map((key, index) => [key, index]));
  const own = new Set(keys);
  const pairs = [];
  let next = 0;
  const depth = parent === null ? 0 : parent.depth + 1;
  const add = (one, other) => pairs.push({ nodes: [one, other], depth, parent, marks: [], holdsMark: false });
  const addOthersTo = (end) => {
    for (; next < end; next++) if (!own.has(otherKeys[next])) add(null, others[next]);
  };
  keys.forEach((key, index) => {
    const place = places.get(key);
    if (place !== undefined) addOthersTo(place);
    add(siblings[index], place === undefined ? null : others[place]);
  });
  addOthersTo(others.length);
  return pairs;
}

function namesInOrder(siblings) {
  const times = new Map();
  return siblings.map(({ name }) => {
    times.set(name, (times.get(name) ?? 0) + 1);
    return `${name} ${times.get(name)}`;
  });
}

class Comparison {
  constructor({ episodes, took, differences }) {
    this.sides = episodes.map((each, index) => new Side(new Episode(each), index));
    this.took = took;
    this.all = false;
    this.longest = Math.max(1e-6, ...this.sides.map(({ episode }) => episode.secondsAt(episode.last)));
    this.rows = alignedNodes(...this.sides.map(({ episode }) => episode.roots));
    for (const each of this.rows) this.#mark(each);
    this.#head();
    this.#controls();
    this.#facts(differences);
    this.#draw();
    this.seek(this.longest);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.sides.forEach((each) => each.view?.paint()));
  }

  /** Note what differs in a pair of nodes; nodes below one without a partner are not marked. */
  #mark(row) {
    const [one, other] = row.nodes;
    if (one === null || other === null) {
      if (row.parent === null || !row.parent.nodes.includes(null)) row.marks.push(["presence", `only in ${LETTERS[one === null ? 1 : 0]}`]);
    } else {
      if (one.status !== other.status || one.reason !== other.reason) row.marks.push(["outcome", "ended otherwise"]);
      else if (one.message !== other.message) row.marks.push(["parameters", "another message"]);
      if (one.parameters !== other.parameters) row.marks.push(["parameters", "other parameters"]);
      const seconds = row.nodes.map((each) => this.#secondsOf(each));
      const [least, most] = [Math.min(...seconds), Math.max(...seconds)];
      if (most >= LONGER * least && most - least > LONGER_SHARE * this.longest) {
        const times = least > 0 ? `${(most / least).toFixed(1)} times as long` : "longer";
        row.marks.push(["longer", `${LETTERS[seconds.indexOf(most)]} took ${times}`]);
      }
    }
    if (row.marks.length > 0) for (let each = row; each !== null && !each.holdsMark; each = each.parent) each.holdsMark = true;
  }

  /** How long a node took; NaN, which compares as false, as long as it runs. */
  #secondsOf({ episode, start, end }) {
    return end ? episode.secondsAt(end) - episode.secondsAt(start) : NaN;
  }

  #head() {
    const facts = this.sides.map(({ episode }, index) => {
      const badge = element("span", { class: `badge is-${episode.status.toLowerCase()}` }, `${signOf(episode.status)} ${episode.status}`);
      const whole = episode.first === 1 && episode.last === episode.head ? "" : `, events ${episode.first} to ${episode.last} of ${episode.head}`;
      return element("span", {}, element("b", {}, LETTERS[index]), ` episode ${episode.number} `, badge, " ", recorded(episode.description), ` ${this.took[index]} ${episode.started}${whole}`);
    });
    part("facts").replaceChildren(...facts);
  }

  #controls() {
    this.slider = element("input", { type: "range", min: 0, max: STEPS, step: 1, "aria-label": "time since the start of both" });
    this.slider.addEventListener("input", () => this.seek((Number(this.slider.value) / STEPS) * this.longest));
    this.clock = element("output", { class: "clock" });
    part("controls").append(this.slider, this.clock);
  }

  /** Show both scenes so many seconds after their starts. */
  seek(seconds) {
    for (const each of this.sides) each.show(each.episode.eventAt(seconds));
    this.slider.value = (seconds / this.longest) * STEPS;
    this.clock.textContent = `${duration(seconds)} since the start of both`;
  }

  /** Show the end of a node in each scene, at the times when it came. */
  #select(row) {
    row.nodes.forEach((node, index) => node !== null && this.sides[index].show(node.lastEvent));
    this.clock.replaceChildren("at the end of ", recorded((row.nodes[0] ?? row.nodes[1]).name));
    this.selected = row;
    this.#draw();
  }

  #draw() {
    const marked = this.rows.filter(({ marks }) => marks.length > 0);
    const listed = this.all ? this.rows : this.rows.filter(({ holdsMark }) => holdsMark);
    const shown = listed.slice(0, LISTED_MAX);
    const count = `${marked.length} of ${this.rows.length} nodes differ`;
    const toggle = element("button", { type: "button", "aria-pressed": String(this.all), onclick: () => this.#toggle() }, this.all ? "only what differs" : "all nodes");
    const heads = ["node", ...LETTERS, "differs"].map((each) => element("th", { scope: "col" }, each));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...shown.map((each) => this.#row(each))));
    const left = listed.length - shown.length;
    const content = shown.length > 0 ? table : element("p", { class: "quiet" }, "The task trees do not differ.");
    const focused = document.activeElement?.dataset?.row;
    part("nodes").replaceChildren(element("h2", {}, `${count} `, toggle), content, left > 0 ? element("p", { class: "quiet" }, `${left} more nodes`) : "");
    if (focused !== undefined) part("nodes").querySelector(`[data-row="${focused}"]`)?.focus({ preventScroll: true });
  }

  #toggle() {
    this.all = !this.all;
    this.#draw();
  }

  #row(row) {
    const node = row.nodes[0] ?? row.nodes[1];
    const name = element("button", { type: "button", class: "link", "data-row": row.number, title: `show the scenes at its end ${node.parameters}`.slice(0, TEXT_MAX), onclick: () => this.#select(row) }, recorded(node.name));
    const place = element("td", { class: "node" }, name);
    place.style.paddingInlineStart = `${Math.min(row.depth, INDENTS_MAX) * INDENT_PX}px`;
    const marks = row.marks.map(([kind, text]) => element("span", { class: `mark is-${kind}` }, text));
    const detail = row.marks.some(([kind]) => kind === "parameters") ? row.nodes : [];
    const texts = detail.map((each, index) => element("div", { class: "quiet" }, `${LETTERS[index]} `, recorded([each.parameters, each.message].filter(Boolean).join(" · ").slice(0, TEXT_MAX))));
    return element("tr", { class: row === this.selected ? "lit" : null }, place, ...row.nodes.map((each) => this.#cell(each)), element("td", {}, ...marks, ...texts));
  }

  #cell(node) {
    if (node === null) return element("td", { class: "quiet" }, "–");
    const seconds = this.#secondsOf(node);
    const took = Number.isNaN(seconds) ? "" : `\u00a0${duration(seconds).replace(" ", "\u00a0")}`;
    const sign = element("span", { class: "sign", title: node.status }, signOf(node.status));
    return element("td", { class: `is-${node.status.toLowerCase()}` }, sign, took, node.reason ? recorded(` ${node.reason}`, { class: "reason" }) : null);
  }

  /** Facts and places of objects that differ. */
  #facts(differences) {
    const rows = differences.map(([of, where, what, one, other]) => {
      const cells = [one, other].map((each) => element("td", { class: "wide" }, each === null ? "–" : recorded(each.slice(0, TEXT_MAX))));
      return element("tr", {}, element("td", {}, of === "object" ? "object " : "", recorded(where)), ...cells, element("td", { class: "quiet" }, what === "value" ? "" : what));
    });
    const heads = ["fact or object", ...LETTERS, ""].map((each) => element("th", { scope: "col" }, each));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows));
    part("differences").replaceChildren(element("h2", {}, "Facts and last places of objects"), rows.length > 0 ? table : element("p", { class: "quiet" }, "They do not differ."));
  }
}

/** One episode with its scene, or with a map where the browser has no WebGL; without objects it has neither. */
class Side {
  constructor(episode, index) {
    this.episode = episode;
    if (episode.objects.length === 0) return;
    const holder = element("div", { class: "scene" });
    this.caption = element("div", { class: "hint" });
    part("scenes").append(element("div", { class: "twin" }, holder, this.caption));
    this.letter = LETTERS[index];
    const bodies = new Bodies(episode);
    try {
      this.view = new SceneView(holder, episode, bodies, { onPick: (object) => this.view.choose(object) });
    } catch {
      this.view = new MapView(holder, episode, bodies);
    }
  }

  /** Show the scene after an event, but not the empty world at the end. */
  show(event) {
    if (this.view === undefined) return;
    const { episode } = this;
    const shown = Math.min(event, episode.opens);
    this.view.show(shown, null, []);
    this.caption.textContent = `${this.letter} · ${duration(episode.secondsAt(shown))} · event ${shown}`;
  }
}

globalThis.pycrormComparison = new Comparison(JSON.parse(part("document").textContent));
document.documentElement.dataset.ready = "yes";
