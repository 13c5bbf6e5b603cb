// Puts the page together: one moment, `event`, that the tree, the scene, the chart and the panels show.

import { Bodies, pathsOf } from "./bodies.js";
import { CurvesView } from "./curves_view.js";
import { backTo, duration, element, recorded, strokeOf, svg } from "./dom.js";
import { Episode, signOf } from "./episode.js";
import { Find, testOf } from "./find.js";
import { GanttView } from "./gantt_view.js";
import { MapView } from "./map_view.js";
import { Panels } from "./panels.js";
import { Playback } from "./playback.js";
import { SceneView } from "./scene_view.js";
import { SeenView } from "./seen_view.js";
import { TreeView } from "./tree_view.js";

const NOTES_MAX = 3;
const NAMED_MAX = 2;
const ROBOTS_MAX = 4;
const HELD_MAX = 4;
const HELP = [
  "Space plays, in proportion to time if the axis of the chart is time. ← → go by one event, with Shift by ten; Home and End to the ends. F goes to the next failure, A changes the axis of the chart.",
  "Scene: drag turns, drag with the right button or two fingers moves, the wheel zooms; a click chooses an object, a double click goes to it. W shows all of the moment and its paths, R follows the robot.",
  "Chart: the wheel zooms, with Shift or sideways it moves, a double click shows all; the map below the axis is dragged. While the chart or a curve has the focus, W and S zoom, A and D move, 0 shows all.",
  "Curves: they follow the chart. A name draws its curve below the chart, over the others that are chosen, one scale for each unit; a click on its legend takes it away.",
  "Tree: / finds nodes by words, or by type:PickUp object:milk robot:pr2 status:failed reason:IK text:grasp; Enter goes to the next one. The address of the page keeps the moment, the node, the chosen curves and what was searched.",
  "Words: an episode is one recorded run of a plan. A node is one performed step of it, such as an action or a motion. An event is one fact that was stored when it happened, e12 the twelfth of the episode. A snapshot is the state of nodes, objects and robots at one moment.",
];
const part = (name) => document.getElementById(name);

class Page {
  constructor(episode, similar) {
    this.episode = episode;
    this.event = episode.opens;
    this.selected = null;
    this.query = "";
    this.object = null;
    this.playback = new Playback({ onEvent: (event) => this.#moveTo(event), onEnd: () => this.#namePlay() });
    this.following = false;
    const seek = (event) => this.seek(event);
    const select = (node, options) => this.select(node, options);
    this.bodies = new Bodies(episode);
    this.map = new MapView(part("map"), episode, this.bodies);
    this.view = this.#sceneOrMap();
    this.tree = new TreeView(part("tree"), episode, { onSelect: select });
    this.gantt = new GanttView(part("gantt"), episode, { onSeek: seek, onSelect: select, onDraw: () => this.#followAxis() });
    this.curves = new CurvesView(part("curves"), episode, this.gantt, () => this.#showCurves());
    const holders = { strip: part("strip"), inset: part("seen"), dialog: part("picture") };
    this.seen = new SeenView(holders, episode, { xOf: (event) => this.gantt.xOf(event), onSeek: seek });
    const choose = (object) => this.choose(object);
    this.panels = new Panels(part("panels"), episode, { onSeek: seek, onSelect: select, onChoose: choose, similar, curves: this.curves });
    this.find = new Find(part("find"), {
      onQuery: (query) => this.search(query),
      onStep: (step) => this.#nextMatch(step),
      onLeave: () => part("tree").focus(),
    });
    this.#head();
    this.#controls();
    this.#listen();
    const events = Math.max(episode.last - episode.first, 1);
    if (episode.secondsAt(episode.last) / events > 0.05) this.#changeAxis();
    if (!this.#goToAddress()) this.show();
  }

  /** Show the node, the moment and the search that the address names; return whether it names one of the first two. */
  #goToAddress() {
    const { episode } = this;
    const parts = location.hash.slice(1).split("&");
    const number = (sign) => Number(parts.find((each) => RegExp(`^${sign}\\d+$`).test(each))?.slice(1) ?? NaN);
    const [event, node] = [number("e"), episode.nodeAt.get(number("n"))];
    const query = decoded(parts.find((each) => each.startsWith("q="))?.slice(2) ?? "");
    if (query !== this.query) this.search(query);
    this.curves.choose(parts.filter((each) => each.startsWith("c=")).map((each) => decoded(each.slice(2))));
    if (Number.isNaN(event) && node === undefined) return false;
    if (node !== undefined && node !== this.selected) this.select(node);
    if (!Number.isNaN(event) && event !== this.event) this.#moveTo(event, this.selected === node ? node : null);
    return true;
  }

  #address() {
    const { event, selected, query } = this;
    const names = [];
    if (selected !== null) names.push(`n${selected.start}`);
    if (selected === null ? !this.following : selected.lastEvent !== event) names.push(`e${event}`);
    if (query) names.push(`q=${encodeURIComponent(query)}`);
    for (const key of this.curves.chosen.keys()) names.push(`c=${encodeURIComponent(key)}`);
    return names.length > 0 ? `#${names.join("&")}` : location.pathname + location.search;
  }

  /** List the nodes that match a query, and the ways to them; all without one. */
  search(query) {
    this.query = query.trim() === "" ? "" : query;
    const matches = this.tree.filter(this.query ? testOf(this.query) : null);
    this.find.show(query, matches?.size ?? null);
    this.#keepAddress();
  }

  #nextMatch(step) {
    const next = this.tree.matchBeside(this.selected, step);
    if (next !== undefined) this.select(next);
  }

  #sceneOrMap() {
    try {
      return new SceneView(part("scene"), this.episode, this.bodies, { onPick: (object) => this.choose(object) });
    } catch {
      document.body.classList.add("no-webgl");
      return this.map;
    }
  }

  #head() {
    const { episode } = this;
    const failures = episode.nodes.filter((each) => each.kind === "action" && (each.status === "FAILED" || each.status === "ERROR")).length;
    const all = episode.status !== "SUCCEEDED" || failures === 0 ? "" : `, ${failures} action${failures === 1 ? "" : "s"} failed`;
    part("status").textContent = `${signOf(episode.status)} ${episode.status}${all}`;
    part("status").className = `badge is-${episode.status.toLowerCase()}`;
    const failed = episode.failedCount;
    const roots = episode.rootFailures.length;
    const whole = episode.first === 1 && episode.last === episode.head;
    const facts = [
      `episode ${episode.number}`,
      episode.started,
      duration(episode.secondsAt(episode.last)),
      `${episode.nodes.length} node${episode.nodes.length === 1 ? "" : "s"}${failed ? `, ${failed} failed from ${roots} cause${roots === 1 ? "" : "s"}` : ""}`,
      `by ${episode.created_by}`,
      episode.simulated ? "a simulation" : null,
      episode.tags.length > 0 ? episode.tags.join(", ") : null,
      episode.robots.length > 0 ? `robot${episode.robots.length === 1 ? "" : "s"} ${episode.robots.slice(0, ROBOTS_MAX).join(", ")}${episode.robots.length > ROBOTS_MAX ? ` and ${episode.robots.length - ROBOTS_MAX} more` : ""}` : null,
      whole ? null : `events ${episode.first} to ${episode.last} of ${episode.head}`,
    ].filter((each) => each !== null);
    const list = episode.overview ? element("a", { href: backTo(episode.overview) }, "all episodes") : "";
    part("facts").replaceChildren(list, ...facts.map((each) => recorded(each)));
    const notes = this.#assumptions().slice(0, NOTES_MAX).map((each) => element("p", {}, recorded(each)));
    document.body.classList.toggle("no-objects", episode.objects.length === 0);
    document.body.classList.toggle("has-pictures", episode.cameras.size > 0);
    if (episode.objects.length === 0) notes.push(element("p", {}, "This episode recorded no objects: there is no scene to draw."));
    part("notes").replaceChildren(...notes);
  }

  /** What is not drawn as it was recorded, with the names of the objects; the most of them first. */
  #assumptions() {
    const { episode } = this;
    const names = new Map();
    for (const { name, model } of episode.objects) {
      const { assumed, boxes } = episode.models[model] ?? episode.models[""];
      for (const text of [assumed && `drawn as ${assumed}`, boxes && `boxes instead of ${boxes}`].filter(Boolean)) {
        names.set(text, (names.get(text) ?? new Set()).add(name));
      }
    }
    const sorted = [...names].map(([text, all]) => [text, [...all]]).sort(([, one], [, other]) => other.length - one.length);
    return sorted.map(([text, all]) => {
      const others = all.length - NAMED_MAX;
      const shown = others > 1 ? `${all.slice(0, NAMED_MAX).join(", ")} and ${others} others` : all.join(", ");
      return `${shown}: ${text}`;
    });
  }

  #controls() {
    const { episode } = this;
    this.play = element("button", { type: "button", title: "play (space)", "aria-label": "play", onclick: () => this.togglePlay() }, "▶");
    this.slider = element("input", { type: "range", min: episode.first, max: episode.last, step: 1, "aria-label": "event" });
    this.slider.addEventListener("input", () => this.seek(Number(this.slider.value)));
    this.clock = element("output", { class: "clock" });
    this.axis = element("button", { type: "button", class: "axis", title: "axis of the chart: events, which are equally far apart, or time (A)", onclick: () => this.#changeAxis() }, "by event");
    this.colors = element("select", { "aria-label": "colours of the chart", title: "colours of the chart", onchange: () => this.#color() });
    this.colors.append(...["status", "robot", "type"].map((each) => element("option", { value: each }, `by ${each}`)));
    const help = element("button", { type: "button", class: "help", title: "keys, mouse and words (?)", "aria-label": "keys, mouse and words", onclick: () => this.#help() }, "?");
    part("controls").append(this.play, this.slider, this.clock, this.axis, this.colors, help);
    const whole = element("button", { type: "button", title: "show all that is there at this moment, and its paths (W)", onclick: () => this.#showWhole() }, "whole scene");
    this.tracking = element("button", { type: "button", title: "keep the robot, or the chosen object, in sight (R)", onclick: () => this.#track() });
    const pictures = element("button", { type: "button", class: "pictures", title: "show what was seen at this moment", "aria-pressed": "true", onclick: () => this.#showPictures(pictures) }, "pictures");
    part("views").append(pictures, whole, this.tracking);
    this.#nameTracked();
  }

  #showPictures(button) {
    const hidden = document.body.classList.toggle("pictures-hidden");
    button.setAttribute("aria-pressed", String(!hidden));
  }

  /** Colour the chart as chosen, and name its colours. */
  #color() {
    this.gantt.setColors(this.colors.value);
    const hues = this.gantt.hues.map(([name, number]) => element("span", { class: `robot hue-${number}` }, recorded(name)));
    part("hues").replaceChildren(...hues);
  }

  #help() {
    part("help").replaceChildren(...(part("help").hasChildNodes() ? [] : HELP.map((each) => element("p", {}, each))));
  }

  #showWhole() {
    if (this.tracked) this.#track();
    this.view.frameMoment();
    this.show();
  }

  /** Follow the chosen object or the robot with the camera, or stop it. */
  #track() {
    this.tracked = this.tracked ? null : this.#trackable() ?? null;
    this.view.follow(this.tracked);
    this.#nameTracked();
    this.show();
  }

  #trackable() {
    const present = this.episode.presentAt(this.event);
    return present.find((each) => each === this.object) ?? present.find((each) => each.type === "ROBOT");
  }

  #nameTracked() {
    const object = this.tracked ?? this.#trackable();
    this.tracking.hidden = object === undefined;
    this.tracking.setAttribute("aria-pressed", String(Boolean(this.tracked)));
    this.tracking.replaceChildren("follow ", recorded(object?.name ?? ""));
  }

  /** Show an object of the scene, or none. */
  choose(object) {
    this.object = object;
    this.view.choose(object);
    this.panels.choose(object);
    if (object !== null) this.panels.open("objects");
    this.show();
  }

  /** Draw the panel of the curves for those that are chosen, and keep them in the address. */
  #showCurves() {
    this.panels.redrawCurves();
    this.#keepAddress();
  }

  /** Draw what stands on the axis of the chart where its events have other places. */
  #followAxis() {
    this.seen?.drawStrip();
    this.curves?.draw();
    this.panels?.redrawCurves();
  }

  #changeAxis() {
    this.gantt.setAxis(!this.gantt.byTime);
    this.axis.textContent = this.gantt.byTime ? "by time" : "by event";
    if (this.playback.running) this.#play();
  }

  #listen() {
    addEventListener("hashchange", () => {
      if (this.playback.running) this.togglePlay();
      this.#goToAddress();
    });
    addEventListener("keydown", (pressed) => this.#press(pressed));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.#paint());
    matchMedia("print").addEventListener("change", ({ matches }) => (matches ? this.#print() : this.show()));
    addEventListener("beforeprint", () => this.#print());
    addEventListener("afterprint", () => this.show());
  }

  #press(pressed) {
    if (pressed.ctrlKey || pressed.metaKey || pressed.altKey) return;
    if (pressed.target instanceof HTMLButtonElement && pressed.key === " ") return;
    const step = pressed.shiftKey ? 10 : 1;
    const { first, last } = this.episode;
    const actions = {
      " ": () => this.togglePlay(),
      ArrowRight: () => this.seek(this.event + step),
      ArrowLeft: () => this.seek(this.event - step),
      Home: () => this.seek(first),
      End: () => this.seek(last),
      f: () => this.#nextFailure(),
      a: () => this.#changeAxis(),
      r: () => this.#track(),
      w: () => this.#showWhole(),
      Escape: () => this.#leave(),
      "/": () => this.find.focus(),
      "?": () => this.#help(),
    };
    const action = actions[pressed.key.length === 1 ? pressed.key.toLowerCase() : pressed.key];
    if (action === undefined) return;
    pressed.preventDefault();
    action();
  }

  /** Show all nodes again, or no object. */
  #leave() {
    if (this.query) this.search("");
    else this.choose(null);
  }

  #nextFailure() {
    const failures = this.episode.rootFailures;
    const next = failures.find((each) => each.lastEvent > this.event) ?? failures[0];
    if (next !== undefined) this.select(next);
  }

  /** Add parts to the episode, and move to its last moment if the page follows it. */
  extend(...parts) {
    const { episode } = this;
    for (const each of parts) episode.extend(each);
    for (const each of [this.view, this.tree, this.gantt, this.panels]) each.grow();
    if (this.query) this.find.show(this.find.field.value, this.tree.found.matches.size);
    this.#color();
    this.seen.drawStrip();
    this.slider.max = episode.last;
    this.#head();
    if (this.following) this.event = episode.opens;
    this.show();
  }

  /** Follow the last moment of an episode that grows, or stay. */
  follow(following) {
    this.following = following;
    if (following) Object.assign(this, { event: this.episode.opens, selected: null });
    this.show();
    this.onFollow?.(following);
  }

  /** Show another moment; what plays goes on from there. */
  seek(event) {
    this.#moveTo(event);
    if (!this.playback.running) return;
    if (this.event < this.episode.opens) this.#play();
    else this.togglePlay();
  }

  #moveTo(event, selected = null) {
    if (this.following) this.follow(false);
    const { first, last } = this.episode;
    this.event = Math.min(Math.max(Math.round(event), first), last);
    this.selected = selected;
    this.show();
  }

  /** Show a node and the moment at which it ended, or its last one. */
  select(node, { seek = true } = {}) {
    if (this.following) this.follow(false);
    this.selected = node;
    if (seek) {
      this.event = node.lastEvent;
      this.tree.reveal(node);
    }
    this.panels.open("details");
    this.show();
  }

  togglePlay() {
    if (this.playback.running) this.playback.stop();
    else this.#play();
    this.#namePlay();
    this.show();
  }

  #play() {
    const { first, last, opens, times } = this.episode;
    const end = Math.min(last, opens);
    if (this.event >= end) this.event = first;
    if (end > first) this.playback.start(first, this.event, end, times, this.gantt.byTime);
  }

  #namePlay() {
    const { running } = this.playback;
    this.play.textContent = running ? "❚❚" : "▶";
    this.play.setAttribute("aria-label", running ? "pause" : "play");
  }

  #paint() {
    this.view.paint();
    this.gantt.draw();
  }

  show() {
    const { episode, event } = this;
    const running = episode.runningAt(event);
    const action = this.selected ?? running.filter((each) => each.kind === "action").at(-1) ?? null;
    this.action = action;
    const paths = pathsOf(episode, action);
    this.view.show(event, action, paths);
    this.#legend(paths);
    this.seen.show(event);
    if (!this.tracked) this.#nameTracked();
    if (this.following) this.tree.follow(running);
    this.tree.show(event, running, { selected: this.selected });
    this.gantt.show(event, this.selected);
    this.curves.show(event);
    this.panels.show(event, this.selected, running);
    this.slider.value = event;
    this.clock.textContent = `${duration(episode.secondsAt(event))} · event ${event} of ${episode.last}${this.playback.shortened ? " · pauses cut" : ""}`;
    this.slider.setAttribute("aria-valuetext", this.clock.textContent);
    if (matchMedia("print").matches) this.#print();
    this.#keepAddress();
  }

  #keepAddress() {
    clearTimeout(this.writing);
    this.writing = setTimeout(() => history.replaceState(null, "", this.#address()), 250);
  }

  /** Name the paths in the scene, and the distance of its lines. */
  #legend(paths) {
    const ways = paths.slice(0, 4).map(({ object, color, dash }) => {
      const line = svg("line", { x1: 0, x2: 32, y1: 5, y2: 5, class: color.slice(2), "stroke-dasharray": strokeOf(dash, 2.5) });
      return element("span", {}, svg("svg", { width: 32, height: 10, "aria-hidden": "true" }, line), " path of ", recorded(object.name));
    });
    const held = this.episode.heldAt(this.event).slice(0, HELD_MAX).map(({ robot, object, by }) =>
      element("span", {}, recorded(robot.name), " holds ", recorded(object.name), by ? element("span", {}, " in its ", recorded(by)) : null));
    const during = ways.length > 0 ? element("span", {}, "during ", recorded(this.action.name)) : null;
    part("legend").replaceChildren(...held, ...ways, ...(during ? [during] : []), element("span", {}, "grid 1 m"));
  }

  #print() {
    this.map.show(this.event, this.action, pathsOf(this.episode, this.action));
    this.tree.drawForPrint();
    this.panels.drawForPrint();
  }
}

/** The text that an address holds; the address itself if it is none that a page writes. */
function decoded(encoded) {
  try {
    return decodeURIComponent(encoded);
  } catch {
    return encoded;
  }
}

const written = JSON.parse(part("document").textContent);
const page = new Page(new Episode(written), written.similar ?? null);
document.documentElement.dataset.ready = "yes";
globalThis.pycrormPage = page;
