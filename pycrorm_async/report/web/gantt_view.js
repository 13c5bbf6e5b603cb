// Shows every node as a bar over events or over time: which moment and which part of the episode is drawn, and the axis.

import { colorOf, duration, element, plain } from "./dom.js";
import { drawLane, LANE_PX, roundTicks } from "./gantt_bars.js";

const AXIS_PX = 20;
const TICK_PX = 90;
const PAD_PX = 8;

export class GanttView {
  constructor(holder, episode, { onSeek, onSelect }) {
    this.holder = holder;
    this.episode = episode;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "Gantt chart of the nodes");
    this.axis = element("canvas", { class: "axis", "aria-hidden": "true" });
    holder.append(this.canvas, this.axis);
    this.byTime = false;
    this.lanes = new Lanes();
    this.lanes.extend(episode.nodes);
    this.window = this.extent = this.#all();
    let dragging = false;
    const seek = (pointed) => onSeek(this.#eventAt(pointed.offsetX));
    this.canvas.addEventListener("pointerdown", (pointed) => {
      dragging = true;
      this.canvas.setPointerCapture(pointed.pointerId);
      const node = this.#nodeAt(pointed.offsetX, pointed.offsetY);
      seek(pointed);
      if (node !== null) onSelect(node, { seek: false });
    });
    this.canvas.addEventListener("pointermove", (pointed) => {
      if (dragging) seek(pointed);
      const node = this.#nodeAt(pointed.offsetX, pointed.offsetY);
      this.canvas.title = node === null ? "" : plain(`${node.name} ${node.status} ${node.parameters}`.slice(0, 200));
    });
    for (const kind of ["pointerup", "pointercancel"]) this.canvas.addEventListener(kind, () => (dragging = false));
    this.canvas.addEventListener("wheel", (turned) => this.#zoom(turned), { passive: false });
    this.canvas.addEventListener("dblclick", () => this.#showWindow(this.#all()));
    new ResizeObserver(() => this.draw()).observe(holder);
  }

  setAxis(byTime) {
    this.byTime = byTime;
    this.extent = this.#all();
    this.#showWindow(this.extent);
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

  #zoom(turned) {
    if (!turned.ctrlKey && !turned.shiftKey && Math.abs(turned.deltaY) <= Math.abs(turned.deltaX)) return;
    turned.preventDefault();
    const [from, to] = this.window;
    const [low, high] = this.#all();
    const here = from + ((turned.offsetX - PAD_PX) / this.width) * (to - from);
    const factor = turned.deltaY > 0 ? 1.25 : 0.8;
    const narrowest = this.byTime ? 1e-5 : 4;
    if ((to - from) * factor < narrowest) return;
    this.#showWindow([Math.max(low, here - (here - from) * factor), Math.min(high, here + (to - here) * factor)]);
  }

  #position(event) {
    return this.byTime ? this.episode.secondsAt(event) : event;
  }

  #xOf(event) {
    const [from, to] = this.window;
    return PAD_PX + ((this.#position(event) - from) / (to - from)) * this.width;
  }

  #eventAt(x) {
    const [from, to] = this.window;
    const here = from + (Math.min(Math.max(x - PAD_PX, 0), this.width) / this.width) * (to - from);
    return this.byTime ? this.episode.eventAt(here) : Math.round(here);
  }

  #nodeAt(x, y) {
    const lane = Math.floor(y / LANE_PX);
    for (const node of this.lanes.nodes[lane] ?? []) {
      if (this.#xOf(node.start) - 1 <= x && x <= this.#xOf(node.lastEvent) + 1) return node;
    }
    return null;
  }

  draw() {
    const width = this.holder.clientWidth;
    if (width === 0) return;
    this.width = width - 2 * PAD_PX;
    const names = ["good", "bad", "odd", "run", "ink", "quiet", "paper", "on-bar"];
    const colors = Object.fromEntries(names.map((each) => [each, colorOf(`--${each}`)]));
    const height = this.lanes.nodes.length * LANE_PX;
    const pen = penOf(this.canvas, width, height);
    const span = (node) => [this.#xOf(node.start), this.#xOf(node.lastEvent)];
    const ends = { left: PAD_PX, right: PAD_PX + this.width };
    const moment = { event: this.event ?? Infinity, selected: this.selected };
    this.lanes.nodes.forEach((nodes, lane) => drawLane(pen, nodes, lane * LANE_PX, { ...ends, ...moment, span, colors }));
    this.#drawCursor(pen, height, colors);
    const axis = penOf(this.axis, width, AXIS_PX);
    this.#drawAxis(axis, colors);
    this.#drawCursor(axis, 4, colors);
  }

  #drawCursor(pen, height, colors) {
    if (this.event === undefined) return;
    pen.fillStyle = colors.ink;
    pen.fillRect(this.#xOf(this.event) - 1, 0, 2, height);
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
    for (const { text, left } of this.ticks()) pen.fillText(text, left, AXIS_PX / 2 + 2);
  }
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

/** Gives each node the first free lane below its parent's, so that concurrent branches do not cover each other. */
class Lanes {
  constructor() {
    this.nodes = [];
    this.of = new Map();
  }

  /** Give lanes to the nodes that have none yet, of all nodes in the order in which they started. */
  extend(nodes) {
    for (let index = this.of.size; index < nodes.length; index++) {
      const node = nodes[index];
      let lane = node.parent === null ? 0 : this.of.get(node.parent) + 1;
      while ((this.nodes[lane]?.at(-1)?.lastEvent ?? 0) > node.start) lane++;
      while (this.nodes.length <= lane) this.nodes.push([]);
      this.of.set(node, lane);
      this.nodes[lane].push(node);
    }
  }
}
