// Draws the world after an event from above, as SVG: without WebGL, and in print.

import { svg } from "./dom.js";

const SIZE_MIN_M = 2;

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

  frame() {}

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
      title.textContent = object.name;
      shape.append(title);
      picture.append(shape);
    }
    paths.forEach(({ points: path, color }, index) => {
      const corners = path.map(([x, y]) => `${x},${-y}`).join(" ");
      const dash = index % 2 ? `${scale} ${scale}` : "none";
      const attributes = { points: corners, class: `path ${color.slice(2)}`, "stroke-width": scale * 0.5 };
      picture.append(svg("polyline", { ...attributes, "stroke-dasharray": dash }));
    });
    for (const { body } of present) {
      if (body.object.type === "ENVIRONMENT") continue;
      const { x, y } = body.group.position;
      const label = svg("text", { x, y: -y - scale * 1.5, "font-size": scale * 3, "text-anchor": "middle" });
      label.textContent = body.object.name;
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

/** The outline from above, the height and the colour of each shape of a body. */
function outlinesOf(body) {
  const outlines = [];
  body.group.traverse((each) => {
    if (!each.isMesh) return;
    each.geometry.computeBoundingBox();
    const { min, max } = each.geometry.boundingBox;
    const corners = [];
    for (const x of [min.x, max.x])
      for (const y of [min.y, max.y])
        for (const z of [min.z, max.z]) corners.push(new THREE.Vector3(x, y, z).applyMatrix4(each.matrixWorld));
    const top = Math.max(...corners.map((corner) => corner.z));
    outlines.push({ top, hull: hullOf(corners.map(({ x, y }) => [x, y])), color: `#${each.material.color.getHexString()}` });
  });
  return outlines;
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
