// Draws the bars of the chart so that each status is readable without colour: by its sign, by hatching, and by marks where
// a bar is too narrow for both. Bars that are too narrow and too close to be told apart are drawn together.

import { plain } from "./dom.js";
import { signOf } from "./episode.js";

export const LANE_PX = 19;
const BAR_PX = 16;
const NARROW_PX = 3;
const BIN_PX = 6;
const SIGN_PX = 9;
const NAME_PX = 26;
const LETTERS_MIN = 3;
const PALE = 0.35;

const BAR_COLORS = { SUCCEEDED: "good", FAILED: "bad", ERROR: "bad", RUNNING: "run" };
const GROUPS = ["bad", "odd", "run", "good"];
const groupOf = (node) => BAR_COLORS[node.status] ?? "odd";

/**
 * Draws the nodes of one lane; `span` gives the left and the right end of a node in pixels, `event` is the moment, and
 * `hueOf` a colour that takes the place of that of a node's status, or undefined.
 */
export function drawLane(pen, nodes, y, { left, right, span, event, selected, hueOf, colors }) {
  const bins = new Map();
  for (const node of nodes) {
    const [from, to] = span(node);
    if (to < left) continue;
    if (from > right) break;
    const ends = [Math.max(from, left), Math.min(to, right)].map(Math.round); // whole pixels, so that no line blurs
    const bar = { node, y: y + 1, left: ends[0], right: ends[1], later: node.start > event };
    bar.color = hueOf(node) ?? colors[groupOf(node)];
    if (to - from >= NARROW_PX) {
      drawBar(pen, bar, node === selected, colors);
      continue;
    }
    const bin = Math.floor((bar.left - left) / BIN_PX);
    if (!bins.has(bin)) bins.set(bin, []);
    bins.get(bin).push(bar);
  }
  for (const [bin, bars] of bins) {
    if (bars.length === 1) drawNarrow(pen, bars[0], colors);
    else drawBin(pen, bars, left + bin * BIN_PX, Math.min(BIN_PX, right - left - bin * BIN_PX), colors);
  }
}

function drawBar(pen, { node, y, left, right, later, color }, selected, colors) {
  const wide = right - left - 1;
  pen.globalAlpha = later ? PALE : 1;
  pen.fillStyle = color;
  pen.fillRect(left, y, wide, BAR_PX);
  pen.strokeStyle = colors["on-bar"];
  if (node.failed) hatch(pen, left, y, wide, 1);
  else if (groupOf(node) === "odd") hatch(pen, left, y, wide, 0);
  if (node.end === 0) openEnd(pen, left, y, wide, colors);
  pen.globalAlpha = 1;
  if (selected) {
    pen.strokeStyle = colors.ink;
    pen.lineWidth = 2;
    pen.strokeRect(left, y, wide, BAR_PX);
  }
  const text = textOf(pen, node, wide);
  if (text === "") return;
  const width = pen.measureText(text).width;
  const from = text.length === 1 ? left + (wide - width) / 2 : left + 4;
  if (node.status !== "SUCCEEDED") {
    pen.globalAlpha = later ? PALE : 1;
    pen.fillStyle = later ? colors.paper : color; // no hatching behind the letters
    pen.fillRect(from - 1, y + 2, width + 2, BAR_PX - 4);
    pen.globalAlpha = 1;
  }
  pen.fillStyle = later ? colors.ink : colors["on-bar"];
  pen.fillText(text, from, y + BAR_PX / 2 + 1);
}

/** The sign and as much of the name as there is room for; the sign alone, or nothing. */
function textOf(pen, node, wide) {
  const sign = node.status === "SUCCEEDED" ? "" : signOf(node.status);
  const name = wide < NAME_PX ? "" : shortened(pen, plain(node.name), wide - 8 - (sign && pen.measureText(`${sign} `).width));
  return name ? [sign, name].filter(Boolean).join(" ") : wide < SIGN_PX ? "" : sign;
}

/** A text that ends with an ellipsis if there is no room for all of it; empty if too little would be left. */
function shortened(pen, text, width) {
  if (pen.measureText(text).width <= width) return text;
  let length = Math.min(text.length - 1, Math.floor(width / 3));
  while (length >= LETTERS_MIN && pen.measureText(`${text.slice(0, length)}…`).width > width) length--;
  return length < LETTERS_MIN ? "" : `${text.slice(0, length)}…`;
}

/** Lines across a bar: diagonal ones, or upright ones with a slope of 0. */
function hatch(pen, x, y, width, slope) {
  pen.save();
  pen.beginPath();
  pen.rect(x, y, width, BAR_PX);
  pen.clip();
  pen.globalAlpha *= 0.55;
  pen.lineWidth = 1;
  pen.beginPath();
  for (let at = x - slope * BAR_PX + 2.5; at < x + width; at += slope ? 6 : 4) {
    pen.moveTo(at, y + BAR_PX);
    pen.lineTo(at + slope * BAR_PX, y);
  }
  pen.stroke();
  pen.restore();
}

/** Notches in the right end of a bar whose node has not ended. */
function openEnd(pen, x, y, width, colors) {
  pen.fillStyle = colors.paper;
  const deep = Math.min(4, width / 2);
  for (let at = 1; at < BAR_PX; at += 5) pen.fillRect(x + width - deep, y + at, deep, 3);
}

/** A bar without room: a failure is underlined, and what did not come to its own end is broken in the middle. */
function drawNarrow(pen, { node, y, left, right, later, color }, colors) {
  const wide = Math.max(right - left - 1, 1);
  const group = groupOf(node);
  pen.globalAlpha = later ? PALE : 1;
  pen.fillStyle = color;
  pen.fillRect(left, y, wide, BAR_PX);
  pen.fillStyle = colors.paper;
  if (group === "odd" || group === "run") pen.fillRect(left, y + BAR_PX / 2 - 2, wide, 4);
  pen.globalAlpha = 1;
  pen.fillStyle = colors.ink;
  if (node.failed) pen.fillRect(left, y + BAR_PX, wide, 2);
}

/** Many nodes together: the share of each outcome, failures at the bottom and striped. */
function drawBin(pen, bars, x, wide, colors) {
  const counts = new Map();
  for (const { node } of bars) {
    const group = node.failed ? "bad" : groupOf(node);
    counts.set(group, (counts.get(group) ?? 0) + 1);
  }
  const groups = GROUPS.filter((each) => counts.has(each));
  const { y } = bars[0];
  pen.globalAlpha = bars[0].later ? PALE : 1;
  let foot = y + BAR_PX;
  groups.forEach((group, index) => {
    const last = index === groups.length - 1;
    const high = last ? foot - y : Math.min(Math.max(4, Math.round((counts.get(group) / bars.length) * BAR_PX)), foot - y - 3);
    pen.fillStyle = bars.find(({ node }) => !node.failed && groupOf(node) === group)?.color ?? colors[group];
    pen.fillRect(x, foot - high, wide, high - (index > 0 ? 1 : 0));
    pen.fillStyle = colors.paper;
    if (group !== "good") for (let at = foot - high + 1; at < foot; at += 3) pen.fillRect(x, at, wide, 1);
    foot -= high;
  });
  pen.globalAlpha = 1;
}

/** Positions for ticks: both ends, and between them multiples of 1, 2 or 5 times a power of ten. */
export function roundTicks(from, to, most, whole) {
  const rough = (to - from) / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = Math.max([1, 2, 5, 10].map((each) => each * power).find((each) => each >= rough * 0.999), whole ? 1 : 0);
  const ticks = [from];
  for (let index = Math.ceil(from / step); index * step < to; index++) {
    const here = index * step;
    if (here > from) ticks.push(here);
  }
  return [...ticks, to];
}
