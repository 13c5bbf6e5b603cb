// Shows every node as a bar over events or over time: which moment and which part of the episode is drawn, and the axis.

import { colorOf, duration, element, HUES, plain } from "./dom.js";
import { drawLane, LANE_PX, roundTicks } from "./gantt_bars.js";

const AXIS_PX = 26;
const TEXT_PX = 11; // the middle of the labels; below them is what part of the whole is drawn
const MAP_PX = 12; // of the axis, from its lower edge on, are the map of the whole to the pointer
const TICK_PX = 90;
const PAD_PX = 8;
const HEADING_PX = 17;
const STEP = 0.2; // of what is drawn, by one key

export class GanttView {
  /** `onDraw` is called when other events have other places. */
  constructor(holder, episode, { onSeek, onSelect, onDraw }) {
    Object.assign(this, { holder, episode, onSeek, onDraw });
    this.canvas = document.createElement("canvas");
    const keys = "W and S zoom, A and D move, 0 shows all";
    for (const [name, value] of Object.entries({ role: "application", tabindex: 0, "aria-label": `Gantt chart of the nodes: ${keys}` })) {
      this.canvas.setAttribute(name, value);
    }
    this.axis = element("canvas", { class: "axis", "aria-hidden": "true" });
    holder.append(this.canvas, this.axis);
    this.byTime = false;
    this.colors = "status";
    this.lanes = new Lanes();
    this.lanes.extend(episode.nodes);
    this.window = this.extent = this.#all();
    this.steer(this.canvas, ({ offsetX, offsetY }) => {
      const node = this.#nodeAt(offsetX, offsetY);
      if (node !== null) onSelect(node, { seek: false });
    });
    this.steer(this.axis);
    this.canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
      const node = this.#nodeAt(offsetX, offsetY);
      this.canvas.title = node === null ? "" : plain(`${node.name} ${node.status} ${node.parameters}`.slice(0, 200));
    });
    new ResizeObserver(() => this.draw()).observe(holder);
  }

  /** Let the keys, the wheel and the pointer on an element as wide as the chart move what is drawn, and the moment. */
  steer(surface, onPoint = () => {}) {
    let drag = null;
    surface.addEventListener("keydown", (pressed) => this.press(pressed));
    surface.addEventListener("wheel", (turned) => this.#turn(turned), { passive: false });
    surface.addEventListener("dblclick", () => this.#showWindow(this.#all()));
    surface.addEventListener("pointerdown", (pointed) => {
      surface.setPointerCapture(pointed.pointerId);
      const onMap = surface === this.axis && pointed.offsetY >= AXIS_PX - MAP_PX && !this.#isWhole;
      drag = onMap ? ({ offsetX }) => this.#centre(offsetX) : ({ offsetX }) => this.onSeek(this.#eventAt(offsetX));
      drag(pointed);
      if (!onMap) onPoint(pointed);
    });
    surface.addEventListener("pointermove", (pointed) => drag?.(pointed));
    for (const kind of ["pointerup", "pointercancel"]) surface.addEventListener(kind, () => (drag = null));
  }

  setAxis(byTime) {
    this.byTime = byTime;
    this.extent = this.#all();
    this.#showWindow(this.extent);
  }

  /** Colour the bars by `status`, `robot` or `type`. */
  setColors(colors) {
    this.colors = colors;
    this.draw();
  }

  /** The names that have colours of their own, with the numbers of these; none by status. */
  get hues() {
    const { robots, nodes } = this.episode;
    if (this.colors === "status") return [];
    if (this.colors === "robot") return robots.map((each, index) => [each, index % HUES]);
    if (this.counted !== nodes.length) {
      const counts = new Map();
      for (const { name, kind } of nodes) if (kind !== "root") counts.set(name, (counts.get(name) ?? 0) + 1);
      this.types = [...counts].sort(([, one], [, other]) => other - one).slice(0, HUES).map(([name], index) => [name, index]);
      this.counted = nodes.length;
    }
    return this.types;
  }

  /** Take in the nodes that the episode has by now; `show` draws them. */
  grow() {
    const whole = this.window.every((each, index) => each === this.extent[index]);
    this.lanes.extend(this.episode.nodes);
    this.extent = this.#all();
    if (whole) this.window = this.extent;
  }

  show(event, selected) {
    Object.assign(this, { event, selected });
    this.draw();
  }

  #all() {
    const { first, last } = this.episode;
    return [this.#position(first), Math.max(this.#position(last), this.#position(first) + 1e-6)];
  }

  #showWindow(window) {
    this.window = window;
    this.draw();
  }

  /** Zoom by the wheel; move by a sideways one, or with Shift. */
  #turn(turned) {
    const { deltaX, deltaY, ctrlKey, shiftKey, offsetX } = turned;
    turned.preventDefault();
    if (!ctrlKey && (shiftKey || Math.abs(deltaX) > Math.abs(deltaY))) return this.#move((deltaX || deltaY) / this.width);
    const [from, to] = this.window;
    return this.#zoomAt(from + ((offsetX - PAD_PX) / this.width) * (to - from), deltaY > 0 ? 1.25 : 0.8);
  }

  /** Draw a larger or a smaller part around a position. */
  #zoomAt(here, factor) {
    const [from, to] = this.window;
    const [low, high] = this.#all();
    const narrowest = this.byTime ? 1e-5 : 4;
    if ((to - from) * factor < narrowest) return;
    this.#showWindow([Math.max(low, here - (here - from) * factor), Math.min(high, here + (to - here) * factor)]);
  }

  /** Draw a part before or after the present one, of the same size. */
  #move(share) {
    const [from, to] = this.window;
    const [low, high] = this.#all();
    const by = Math.min(Math.max((to - from) * share, low - from), high - to);
    this.#showWindow([from + by, to + by]);
  }

  /** Draw the part of the same size around a place on the map of the whole, in pixels from the left edge. */
  #centre(x) {
    const [from, to] = this.window;
    const [low, high] = this.#all();
    const middle = low + ((x - PAD_PX) / this.width) * (high - low);
    this.#move((middle - (from + to) / 2) / (to - from));
  }

  get #isWhole() {
    return this.#all().every((each, index) => each === this.window[index]);
  }

  press(pressed) {
    if (pressed.ctrlKey || pressed.metaKey || pressed.altKey) return;
    const [from, to] = this.window;
    const cursor = this.#position(this.event);
    const middle = from <= cursor && cursor <= to ? cursor : (from + to) / 2;
    const actions = {
      w: () => this.#zoomAt(middle, 0.7),
      s: () => this.#zoomAt(middle, 1 / 0.7),
      a: () => this.#move(-STEP),
      d: () => this.#move(STEP),
      0: () => this.#showWindow(this.#all()),
    };
    const action = actions[pressed.key.toLowerCase()];
    if (action === undefined) return;
    action();
    pressed.preventDefault();
    pressed.stopPropagation();
  }

  #position(event) {
    return this.byTime ? this.episode.secondsAt(event) : event;
  }

  /** The place of an event in what is drawn: 0 is its left end, 1 its right one. */
  shareOf(event) {
    const [from, to] = this.window;
    return (this.#position(event) - from) / (to - from);
  }

  /** The place of an event, in pixels from the left edge. */
  xOf(event) {
    return PAD_PX + this.shareOf(event) * this.width;
  }

  /** The ends of the axis, in pixels from the left edge. */
  get ends() {
    return [PAD_PX, PAD_PX + this.width];
  }

  /** The first and the last event of what is drawn. */
  get shownEvents() {
    return this.ends.map((each) => this.#eventAt(each));
  }

  #eventAt(x) {
    const [from, to] = this.window;
    const here = from + (Math.min(Math.max(x - PAD_PX, 0), this.width) / this.width) * (to - from);
    return this.byTime ? this.episode.eventAt(here) : Math.round(here);
  }

  #nodeAt(x, y) {
    const lane = this.lanes.drawn.findLast((each) => each.y <= y);
    if (lane === undefined || y > lane.y + LANE_PX) return null;
    for (const node of lane.nodes) {
      if (this.xOf(node.start) - 1 <= x && x <= this.xOf(node.lastEvent) + 1) return node;
    }
    return null;
  }

  draw() {
    const width = this.holder.clientWidth;
    if (width === 0) return;
    this.width = width - 2 * PAD_PX;
    const names = ["good", "bad", "odd", "run", "ink", "quiet", "paper", "on-bar"];
    const colors = Object.fromEntries(names.map((each) => [each, colorOf(`--${each}`)]));
    const { drawn, height } = this.lanes;
    const pen = penOf(this.canvas, width, height);
    const span = (node) => [this.xOf(node.start), this.xOf(node.lastEvent)];
    const ends = { left: PAD_PX, right: PAD_PX + this.width };
    const moment = { event: this.event ?? Infinity, selected: this.selected };
    const hues = new Map(this.hues.map(([name, number]) => [name, colorOf(`--hue-${number}`)]));
    const hueOf = (node) => hues.get(this.colors === "robot" ? node.robot : node.name);
    for (const { nodes, y, robot } of drawn) {
      if (robot !== undefined) drawHeading(pen, robot, y, colors);
      drawLane(pen, nodes, y, { ...ends, ...moment, span, hueOf, colors });
    }
    this.#drawCursor(pen, height, colors);
    const axis = penOf(this.axis, width, AXIS_PX);
    this.#drawAxis(axis, colors);
    this.#drawCursor(axis, 4, colors);
    const places = [...this.window, width, this.episode.last, this.byTime].join();
    const moved = places !== this.places;
    this.places = places;
    if (moved) this.onDraw();
  }

  #drawCursor(pen, height, colors) {
    if (this.event === undefined) return;
    pen.fillStyle = colors.ink;
    pen.fillRect(this.xOf(this.event) - 1, 0, 2, height);
  }

  /** The labels of the axis and their left ends in pixels: all different, and none over another; the ends come first. */
  ticks() {
    const [from, to] = this.window;
    const ticks = roundTicks(from, to, Math.max(2, Math.floor(this.width / TICK_PX)), !this.byTime);
    const pen = this.axis.getContext("2d");
    const placed = [];
    for (const here of [from, to, ...ticks.slice(1, -1)]) {
      const text = this.byTime ? duration(here) : `e${Math.round(here)}`;
      const { width } = pen.measureText(text);
      const middle = PAD_PX + ((here - from) / (to - from)) * this.width;
      const left = Math.min(Math.max(middle - width / 2, PAD_PX), PAD_PX + this.width - width);
      const isFree = placed.every((each) => each.text !== text && (left > each.left + each.width + 8 || left + width + 8 < each.left));
      if (isFree) placed.push({ text, left, width });
    }
    return placed;
  }

  #drawAxis(pen, colors) {
    pen.fillStyle = colors.quiet;
    for (const { text, left } of this.ticks()) pen.fillText(text, left, TEXT_PX);
    if (this.#isWhole) return;
    const [low, high] = this.#all();
    const [from, to] = this.window;
    const xOf = (position) => PAD_PX + ((position - low) / (high - low)) * this.width;
    pen.globalAlpha = 0.3;
    pen.fillRect(PAD_PX, AXIS_PX - 5, this.width, 3);
    pen.globalAlpha = 1;
    pen.fillRect(xOf(from), AXIS_PX - 6, Math.max(xOf(to) - xOf(from), 3), 5);
    pen.fillStyle = colors.bad;
    for (const { lastEvent } of this.episode.rootFailures.slice(0, this.width)) pen.fillRect(xOf(this.#position(lastEvent)) - 1, AXIS_PX - 6, 2, 5);
  }
}

function drawHeading(pen, robot, y, colors) {
  pen.globalAlpha = 1;
  pen.fillStyle = colors.quiet;
  pen.fillText(plain(robot), PAD_PX, y - HEADING_PX / 2 + 1);
}

/** A pen for a canvas of a size in pixels of the page. */
function penOf(canvas, width, height) {
  const ratio = window.devicePixelRatio || 1;
  Object.assign(canvas, { width: width * ratio, height: height * ratio });
  Object.assign(canvas.style, { width: `${width}px`, height: `${height}px` });
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  pen.font = "11px system-ui, sans-serif";
  pen.textBaseline = "middle";
  return pen;
}

/**
 * Gives each node the first free lane below its parent's, so that concurrent branches do not cover each other. Where
 * several robots act, each has lanes of its own, below a heading.
 */
class Lanes {
  constructor() {
    this.of = new Map();
    this.lanes = new Map();
  }

  /** Give lanes to the nodes that have none yet, of all nodes in the order in which they started. */
  extend(nodes) {
    for (let index = this.of.size; index < nodes.length; index++) {
      const node = nodes[index];
      if (!this.lanes.has(node.robot)) this.lanes.set(node.robot, []);
      const lanes = this.lanes.get(node.robot);
      let lane = node.parent?.robot === node.robot ? this.of.get(node.parent) + 1 : 0;
      while ((lanes[lane]?.at(-1)?.lastEvent ?? 0) > node.start) lane++;
      while (lanes.length <= lane) lanes.push([]);
      this.of.set(node, lane);
      lanes[lane].push(node);
    }
    this.#place();
  }

  #place() {
    const several = [...this.lanes.keys()].filter(Boolean).length > 1;
    this.drawn = [];
    this.height = 0;
    for (const [robot, lanes] of this.lanes) {
      lanes.forEach((nodes, index) => {
        const isHeaded = several && index === 0 && robot !== "";
        if (isHeaded) this.height += HEADING_PX;
        this.drawn.push({ nodes, y: this.height, robot: isHeaded ? robot : undefined });
        this.height += LANE_PX;
      });
    }
  }
}
