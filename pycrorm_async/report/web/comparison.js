// Shows two episodes side by side: their task trees aligned, what differs in them, and their scenes on one clock.

import { Bodies } from "./bodies.js";
import { duration, element, recorded } from "./dom.js";
import { Episode, lastUpTo, signOf } from "./episode.js";
import { MapView } from "./map_view.js";
import { Playback } from "./playback.js";
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

/** The nodes of both episodes in pairs, by the events of their starts; a pair of which the page has none is left out. */
function rowsOf(pairs, sides) {
  const rowOf = new Map();
  const rows = [];
  for (const starts of pairs) {
    const nodes = starts.map((start, index) => sides[index].episode.nodeAt.get(start) ?? null);
    const node = nodes[0] ?? nodes[1];
    if (node === null) continue;
    const row = { number: rows.length, nodes, depth: node.depth, parent: rowOf.get(node.parent) ?? null, marks: [], holdsMark: false };
    rows.push(row);
    for (const each of nodes) if (each !== null) rowOf.set(each, row);
  }
  return rows;
}

class Comparison {
  constructor({ episodes, nodes, took, differences }) {
    this.sides = episodes.map((each, index) => new Side(new Episode(each), index));
    this.took = took;
    this.all = false;
    this.longest = Math.max(1e-6, ...this.sides.map(({ episode }) => episode.secondsAt(episode.last)));
    this.rows = rowsOf(nodes, this.sides);
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
    this.moments = [...new Set(this.sides.flatMap(({ episode }) => episode.times))].sort((one, other) => one - other);
    this.playback = new Playback({ onEvent: (index) => this.seek(this.moments[index] / 1e6), onEnd: () => this.#namePlay() });
    this.play = element("button", { type: "button", title: "play (space)", "aria-label": "play", onclick: () => this.togglePlay() }, "▶");
    this.slider = element("input", { type: "range", min: 0, max: STEPS, step: 1, "aria-label": "time since the start of both" });
    this.slider.addEventListener("input", () => {
      const seconds = (Number(this.slider.value) / STEPS) * this.longest;
      if (this.playback.running) this.#start(seconds);
      else this.seek(seconds);
    });
    this.clock = element("output", { class: "clock" });
    part("controls").append(this.play, this.slider, this.clock);
    addEventListener("keydown", (pressed) => {
      if (pressed.key !== " " || pressed.target instanceof HTMLButtonElement) return;
      pressed.preventDefault();
      this.togglePlay();
    });
  }

  togglePlay() {
    if (this.playback.running) this.playback.stop();
    else this.#start(this.seconds < this.longest ? this.seconds : 0);
    this.#namePlay();
  }

  /** Play the moments of both episodes from one on, in proportion to time. */
  #start(seconds) {
    this.seek(seconds);
    const last = this.moments.length - 1;
    if (last > 0) this.playback.start(0, Math.max(0, lastUpTo(this.moments, seconds * 1e6 + 0.5)), last, this.moments, true);
  }

  #namePlay() {
    const { running } = this.playback;
    this.play.textContent = running ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", running ? "pause" : "play");
  }

  /** Show both scenes so many seconds after their starts. */
  seek(seconds) {
    this.seconds = seconds;
    for (const each of this.sides) each.show(each.episode.eventAt(seconds));
    this.slider.value = (seconds / this.longest) * STEPS;
    this.clock.textContent = `${duration(seconds)} since the start of both${this.playback.shortened ? " · pauses cut" : ""}`;
  }

  /** Show the end of a node in each scene, at the times when it came. */
  #select(row) {
    if (this.playback.running) this.togglePlay();
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
    return element("td", { class: `is-${node.status.toLowerCase()}` }, element("span", { class: "fixed" }, sign, took), node.reason ? recorded(` ${node.reason}`, { class: "reason" }) : null);
  }

  /** Facts and places of objects that differ. */
  #facts(differences) {
    const rows = differences.map(([of, where, what, one, other]) => {
      const cells = [one, other].map((each) => element("td", { class: "wide" }, each === null ? "–" : recorded(each.slice(0, TEXT_MAX))));
      return element("tr", {}, element("td", {}, of === "object" ? "object " : "", recorded(where)), ...cells, element("td", { class: "quiet" }, what === "value" ? "" : what));
    });
    const heads = ["fact or object", ...LETTERS, "differs"].map((each) => element("th", { scope: "col" }, each));
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
