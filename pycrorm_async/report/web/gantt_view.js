// Draws every node as a bar over events or over time on a canvas; bars narrower than a pixel are drawn together.

import { FAILED } from "./episode.js";
import { colorOf, duration } from "./dom.js";

const LANE_PX = 19;
const AXIS_PX = 20;
const PAD_PX = 8;

export class GanttView {
  constructor(holder, episode, { onSeek, onSelect }) {
    this.holder = holder;
    this.episode = episode;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", "Gantt chart of the nodes");
    holder.append(this.canvas);
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
      this.canvas.title = node === null ? "" : `${node.name} ${node.status} ${node.parameters}`.slice(0, 200);
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
    const height = this.lanes.nodes.length * LANE_PX + AXIS_PX;
    const ratio = window.devicePixelRatio || 1;
    Object.assign(this.canvas, { width: width * ratio, height: height * ratio });
    Object.assign(this.canvas.style, { width: `${width}px`, height: `${height}px` });
    const pen = this.canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    const colors = Object.fromEntries(["good", "bad", "odd", "run", "ink", "quiet", "on-bar"].map((each) => [each, colorOf(`--${each}`)]));
    this.lanes.nodes.forEach((nodes, lane) => this.#drawLane(pen, nodes, lane * LANE_PX, colors));
    this.#drawAxis(pen, height, colors);
    if (this.event !== undefined) {
      pen.fillStyle = colors.ink;
      pen.fillRect(this.#xOf(this.event) - 1, 0, 2, height - AXIS_PX + 4);
    }
  }

  #drawLane(pen, nodes, y, colors) {
    const narrow = new Map();
    for (const node of nodes) {
      const left = Math.max(this.#xOf(node.start), PAD_PX);
      const right = Math.min(this.#xOf(node.lastEvent), PAD_PX + this.width);
      if (right < PAD_PX) continue;
      if (left > PAD_PX + this.width) break;
      if (right - left < 1) {
        const column = Math.floor(left);
        const [all, bad, start] = narrow.get(column) ?? [0, 0, node.start];
        narrow.set(column, [all + 1, bad + FAILED.has(node.status), start]);
      } else this.#drawBar(pen, node, left, right, y, colors);
    }
    this.#drawNarrow(pen, narrow, y, colors);
  }

  /** One column of a pixel for many nodes: the red part is the share of them that failed. */
  #drawNarrow(pen, columns, y, colors) {
    const height = LANE_PX - 3;
    for (const [x, [all, bad, start]] of columns) {
      pen.globalAlpha = start > (this.event ?? Infinity) ? 0.35 : 1;
      pen.fillStyle = colors.good;
      pen.fillRect(x, y + 1, 1, height);
      if (bad === 0) continue;
      const share = Math.max(3, (bad / all) * height);
      pen.fillStyle = colors.bad;
      pen.fillRect(x, y + 1 + height - share, 1, share);
    }
    pen.globalAlpha = 1;
  }

  #drawBar(pen, node, left, right, y, colors) {
    const bad = FAILED.has(node.status);
    const later = node.start > (this.event ?? Infinity);
    const wide = Math.max(right - left - 1, 1);
    pen.globalAlpha = later ? 0.35 : 1;
    pen.fillStyle = colors[{ SUCCEEDED: "good", RUNNING: "run" }[node.status] ?? (bad ? "bad" : "odd")];
    pen.fillRect(left, y + 1, wide, LANE_PX - 3);
    if (bad && wide > 3) this.#hatch(pen, left, y + 1, wide, LANE_PX - 3, colors["on-bar"]);
    pen.globalAlpha = 1;
    if (node === this.selected) {
      pen.strokeStyle = colors.ink;
      pen.lineWidth = 2;
      pen.strokeRect(left, y + 1, wide, LANE_PX - 3);
    }
    const ink = later ? colors.ink : colors["on-bar"];
    if (wide > 24) this.#write(pen, `${bad ? "✗ " : ""}${node.name}`, left + 4, y + LANE_PX / 2, wide - 6, ink);
  }

  #hatch(pen, x, y, width, height, color) {
    pen.save();
    pen.beginPath();
    pen.rect(x, y, width, height);
    pen.clip();
    pen.strokeStyle = color;
    pen.globalAlpha *= 0.45;
    pen.lineWidth = 1;
    pen.beginPath();
    for (let at = x - height; at < x + width; at += 6) {
      pen.moveTo(at, y + height);
      pen.lineTo(at + height, y);
    }
    pen.stroke();
    pen.restore();
  }

  #write(pen, text, x, y, width, color) {
    pen.save();
    pen.beginPath();
    pen.rect(x - 2, y - LANE_PX / 2, width + 2, LANE_PX);
    pen.clip();
    pen.fillStyle = color;
    pen.fillText(text, x, y);
    pen.restore();
  }

  #drawAxis(pen, height, colors) {
    const [from, to] = this.window;
    const count = Math.max(2, Math.floor(this.width / 110));
    pen.fillStyle = colors.quiet;
    for (let index = 0; index <= count; index++) {
      const here = from + ((to - from) * index) / count;
      pen.textAlign = index === 0 ? "left" : index === count ? "right" : "center";
      const text = this.byTime ? duration(here) : `e${Math.round(here)}`;
      pen.fillText(text, PAD_PX + (this.width * index) / count, height - AXIS_PX / 2 + 2);
    }
    pen.textAlign = "left";
  }
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
