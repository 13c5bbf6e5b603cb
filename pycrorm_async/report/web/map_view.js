// Draws the world after an event from above, as SVG: without WebGL, and in print.

import { heldName, namedOf } from "./bodies.js";
import { plain, strokeOf, svg } from "./dom.js";

const SIZE_MIN_M = 2;
const DIRECTIONS = 160;

export class MapView {
  constructor(holder, episode, bodies) {
    this.holder = holder;
    this.episode = episode;
    this.bodies = bodies;
    this.chosen = null;
  }

  /** Draw an object with a thick outline, or none. */
  choose(object) {
    this.chosen = object;
  }

  /** The map always shows everything. */
  follow() {}

  frameMoment() {}

  paint() {
    if (this.event !== undefined) this.show(this.event, null, this.paths);
  }

  /** The map has nothing to take in: `show` draws the episode as it is. */
  grow() {}

  show(event, _node, paths) {
    Object.assign(this, { event, paths });
    const present = this.bodies.at(event).map((body) => ({ body, outlines: outlinesOf(body) }));
    const points = present.flatMap(({ outlines }) => outlines.flatMap((each) => each.hull));
    for (const { points: path } of paths) points.push(...path);
    const [left, right, low, high] = extent(points);
    const view = `${left} ${-high} ${right - left} ${high - low}`;
    const scale = Math.max(right - left, high - low) / 100;
    const picture = svg("svg", { viewBox: view, class: "map", role: "img", "aria-label": "map of the world from above" });
    for (let x = Math.ceil(left); x <= right; x++) picture.append(line([x, low], [x, high], scale));
    for (let y = Math.ceil(low); y <= high; y++) picture.append(line([left, y], [right, y], scale));
    const shapes = present.flatMap(({ body, outlines }) => outlines.map((each) => ({ ...each, object: body.object })));
    for (const { hull, color, object } of shapes.sort((one, other) => one.top - other.top)) {
      const corners = hull.map(([x, y]) => `${x.toFixed(3)},${(-y).toFixed(3)}`).join(" ");
      const thick = object === this.chosen ? 0.7 : 0.15;
      const shape = svg("polygon", { points: corners, fill: color, class: "outline", "stroke-width": scale * thick });
      const title = svg("title");
      title.textContent = plain(object.name);
      shape.append(title);
      picture.append(shape);
    }
    for (const { points: path, color, dash } of paths) {
      const corners = path.map(([x, y]) => `${x},${-y}`).join(" ");
      const attributes = { points: corners, class: `path ${color.slice(2)}`, "stroke-width": scale * 0.5 };
      picture.append(svg("polyline", { ...attributes, "stroke-dasharray": strokeOf(dash, scale * 0.5) }));
    }
    const named = namedOf(present.map(({ body }) => body), this.chosen);
    const outlined = present.filter(({ body }) => named.includes(body));
    for (const { x, y, size, name } of labelsOf(outlined, this.episode.heldAt(event), scale * 2.2, left, right)) {
      const label = svg("text", { x, y: -y, "font-size": size, "text-anchor": "middle" });
      label.textContent = name;
      picture.append(label);
    }
    this.holder.replaceChildren(picture);
  }
}

const line = ([x, y], [u, v], scale) =>
  svg("line", { x1: x, y1: -y, x2: u, y2: -v, class: "grid", "stroke-width": scale * 0.1 });

function extent(points) {
  if (points.length === 0) return [-1, 1, -1, 1];
  let [left, right, low, high] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const [x, y] of points) {
    left = Math.min(left, x);
    right = Math.max(right, x);
    low = Math.min(low, y);
    high = Math.max(high, y);
  }
  const margin = Math.max(0.3, (SIZE_MIN_M - Math.max(right - left, high - low)) / 2);
  return [left - margin, right + margin, low - margin, high + margin];
}

const LETTER = 0.6; // the usual width of a letter, in heights

/** Names above their bodies, inside the map, each above those that it would cover. */
function labelsOf(bodies, held, size, left, right) {
  const placed = [];
  for (const { body, outlines } of bodies) {
    const points = outlines.flatMap(({ hull }) => hull);
    if (points.length === 0) points.push([body.group.position.x, body.group.position.y]);
    const [xs, ys] = [points.map(([x]) => x), points.map(([, y]) => y)];
    const [whole, letters] = [plain(heldName(body.object, held)), Math.floor((right - left) / (size * LETTER))];
    const name = whole.length > letters ? `${whole.slice(0, letters - 1)}…` : whole;
    const half = Math.min((name.length * size * LETTER) / 2, (right - left) / 2);
    const middle = (Math.min(...xs) + Math.max(...xs)) / 2;
    placed.push({ name, size, half, x: Math.min(Math.max(middle, left + half), right - half), y: Math.max(...ys) + size * 0.4 });
  }
  const upwards = [...placed].sort((one, other) => one.y - other.y);
  upwards.forEach((each, index) => {
    const covers = (other) => Math.abs(each.x - other.x) < each.half + other.half && Math.abs(each.y - other.y) < size;
    while (upwards.slice(0, index).some(covers)) each.y += size / 4;
  });
  return placed;
}

/** The outline from above, the height and the colour of each shape of a body. */
function outlinesOf(body) {
  const outlines = [];
  body.group.traverse((each) => {
    if (!each.isMesh) return;
    const corners = outermostOf(each.geometry).map((corner) => corner.clone().applyMatrix4(each.matrixWorld));
    const top = corners.reduce((highest, { z }) => Math.max(highest, z), -Infinity);
    outlines.push({ top, hull: hullOf(corners.map(({ x, y }) => [x, y])), color: `#${each.material.color.getHexString()}` });
  });
  return outlines;
}

/** The vertices of a geometry that can be corners of an outline: all of a few, of many the outermost in each direction. */
function outermostOf(geometry) {
  const { position } = geometry.attributes;
  if (geometry.userData.outermost === undefined) {
    const vertexAt = (index) => new THREE.Vector3().fromBufferAttribute(position, index);
    const outermost = position.count > DIRECTIONS ? outermostIndices(position) : Array.from({ length: position.count }, (_, index) => index);
    geometry.userData.outermost = outermost.map(vertexAt);
  }
  return geometry.userData.outermost;
}

/** Directions spread evenly over the sphere (Fibonacci), and for each the vertex that lies farthest in it. */
function outermostIndices(position) {
  const { array } = position;
  const found = new Set();
  for (let index = 0; index < DIRECTIONS; index++) {
    const z = 1 - (2 * index + 1) / DIRECTIONS;
    const [across, turn] = [Math.sqrt(1 - z * z), index * Math.PI * (3 - Math.sqrt(5))];
    const [x, y] = [Math.cos(turn) * across, Math.sin(turn) * across];
    let [best, farthest] = [0, -Infinity];
    for (let at = 0; at < array.length; at += 3) {
      const far = x * array[at] + y * array[at + 1] + z * array[at + 2];
      if (far > farthest) [best, farthest] = [at / 3, far];
    }
    found.add(best);
  }
  return [...found];
}

/** The convex hull of points in the plane. */
export function hullOf(points) {
  const sorted = points.slice().sort(([x, y], [u, v]) => x - u || y - v);
  const turn = ([x, y], [u, v], [p, q]) => (u - x) * (q - y) - (v - y) * (p - x);
  const half = (ordered) => {
    const chain = [];
    for (const each of ordered) {
      while (chain.length > 1 && turn(chain.at(-2), chain.at(-1), each) <= 0) chain.pop();
      chain.push(each);
    }
    return chain.slice(0, -1);
  };
  return [...half(sorted), ...half(sorted.reverse())];
}
