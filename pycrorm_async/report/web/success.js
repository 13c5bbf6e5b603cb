// Draws the share of successes over two columns as a heat map, with the number of rows in each cell, and says rates.

import { plain, svg } from "./dom.js";

const SIZE = 384;
const TEXT_MIN = 30;
const FEW = 5; // a rate of fewer rows needs its interval
const [INTERVAL_WIDE, INTERVAL_HIGH] = [56, 44];
const NORMAL_95 = 1.959964; // 95 % of a normal distribution are within this many standard deviations
const TICK_PX = 34;

/** The 95 % interval of a share by Wilson's score; `query.success.interval_95` computes the same. */
export function interval95(good, tries) {
  if (tries === 0) return [0, 1];
  const [rate, spread] = [good / tries, NORMAL_95 ** 2 / tries];
  const middle = (rate + spread / 2) / (1 + spread);
  const half = (NORMAL_95 * Math.sqrt((rate * (1 - rate)) / tries + spread / (4 * tries))) / (1 + spread);
  return [Math.max(0, middle - half), Math.min(1, middle + half)];
}

/** A share of successes with its interval, as `55 % of 20 (34 to 74 %)`. */
export function rateText(good, tries) {
  const [low, high] = interval95(good, tries).map((each) => Math.round(each * 100));
  return `${Math.round((good / tries) * 100)} % of ${tries} (${low} to ${high} %)`;
}

/** The map of a table: `cells` are [x, y, succeeded, rows]. */
export function successMap({ x, y, cells, succeeded, rows }) {
  const left = y.labels.length > 0 ? 14 + 7 * Math.max(...y.labels.map((each) => each.length)) : 46;
  const [wide, high] = [SIZE / x.cells, Math.min(SIZE / y.cells, 64)];
  const height = high * y.cells;
  const label = `share of successes over ${x.name} and ${y.name}: ${succeeded} of ${rows}`;
  const view = `0 -26 ${left + SIZE + 20} ${height + 70}`;
  const picture = svg("svg", { viewBox: view, class: "success", role: "img", "aria-label": label });
  for (const [column, row, good, count] of cells) {
    const rate = good / count;
    const [from, top] = [left + column * wide, height - (row + 1) * high];
    const text = `${Math.round(rate * 100)} %`;
    const cell = svg("g", { class: rate > 0.75 ? "cell lit" : "cell" });
    const hint = `${placeOf(x, column)}, ${placeOf(y, row)}: ${rateText(good, count)}`;
    const shape = { x: from, y: top, width: wide, height: high, "fill-opacity": 0.06 + 0.9 * rate };
    cell.append(svg("title", {}, plain(hint)), svg("rect", shape));
    const middle = { x: from + wide / 2, "text-anchor": "middle" };
    if (wide >= TEXT_MIN && high >= TEXT_MIN) {
      const [low, up] = interval95(good, count).map((each) => Math.round(each * 100));
      const spread = wide >= INTERVAL_WIDE && high >= INTERVAL_HIGH ? [`${low} to ${up} %`] : [];
      const lines = [text, ...spread, `n = ${count}`];
      const first = top + high / 2 + 5 - (lines.length - 1) * 7;
      lines.forEach((line, index) => cell.append(svg("text", { ...middle, y: first + index * 14, class: index > 0 ? "rows" : "" }, line)));
    } else cell.append(svg("text", { ...middle, y: top + high / 2 + 3, class: "small" }, count < FEW ? `${good}/${count}` : String(Math.round(rate * 100))));
    picture.append(cell);
  }
  for (const [at, text] of ticksOf(x, wide)) picture.append(svg("text", { x: left + at, y: height + 16, "text-anchor": "middle" }, text));
  for (const [at, text] of ticksOf(y, high)) picture.append(svg("text", { x: left - 6, y: height - at + 4, "text-anchor": "end" }, text));
  picture.append(svg("text", { x: left + SIZE / 2, y: height + 36, "text-anchor": "middle" }, captionOf(x)));
  picture.append(svg("text", { x: 2, y: -14 }, captionOf(y)));
  return picture;
}

const captionOf = ({ name, unit }) => (unit ? `${name} (${unit})` : name);

const placeOf = (axis, cell) => axis.labels[cell] ?? `${axis.name} ${axis.edges[cell]} to ${axis.edges[cell + 1]}`;

/** Positions along an axis and their texts: the middle of each category, and edges as far apart as their texts need. */
function ticksOf(axis, width) {
  if (axis.labels.length > 0) return axis.labels.map((text, index) => [(index + 0.5) * width, text]);
  const step = Math.ceil(TICK_PX / width);
  return axis.edges.map((text, index) => [index * width, text]).filter((_, index) => index % step === 0);
}
