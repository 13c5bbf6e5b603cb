// Draws a path as a square rod, because a line of WebGL is one pixel wide; paths differ in their dashes, not only in colour.

const DASHES_MAX = 4000;
const SIDES = [[1, 1], [-1, 1], [-1, -1], [1, -1]];

/** The geometry of a way through positions; `dash` holds the lengths of dash and gap in widths, or is null. */
export function rodAlong(positions, width, dash) {
  const [vertices, faces] = [[], []];
  const points = positions.map(([x, y, z]) => new THREE.Vector3(x, y, z + width));
  for (const [from, to] of dash === null ? pairsOf(points) : dashesOf(points, ...dash.map((each) => each * width))) {
    addRod(vertices, faces, from, to, width / 2);
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(vertices, 3));
  geometry.setIndex(faces);
  geometry.computeVertexNormals();
  return geometry;
}

const pairsOf = (points) => points.slice(1).map((each, index) => [points[index], each]);

/** The parts of a way that are drawn, of at most `DASHES_MAX` dashes. */
function* dashesOf(points, drawn, gap) {
  const whole = pairsOf(points).reduce((sum, [from, to]) => sum + from.distanceTo(to), 0);
  const scale = Math.max(1, whole / (drawn + gap) / DASHES_MAX);
  const period = [drawn * scale, gap * scale];
  let [turn, left] = [0, period[0]];
  for (const [from, to] of pairsOf(points)) {
    const length = from.distanceTo(to);
    for (let at = 0; at < length; ) {
      const step = Math.min(left, length - at);
      if (turn === 0) yield [from.clone().lerp(to, at / length), from.clone().lerp(to, (at + step) / length)];
      at += step;
      left -= step;
      if (left > 1e-9) break;
      turn = 1 - turn;
      left = period[turn];
    }
  }
}

function addRod(vertices, faces, from, to, half) {
  const along = to.clone().sub(from).normalize();
  const across = new THREE.Vector3(-along.y, along.x, 0);
  if (across.lengthSq() < 1e-6) across.set(1, 0, 0);
  across.normalize();
  const upright = new THREE.Vector3().crossVectors(along, across);
  const first = vertices.length / 3;
  for (const end of [from, to]) {
    for (const [x, y] of SIDES) {
      const corner = end.clone().addScaledVector(across, x * half).addScaledVector(upright, y * half);
      vertices.push(corner.x, corner.y, corner.z);
    }
  }
  for (let side = 0; side < 4; side++) {
    const [a, b] = [first + side, first + ((side + 1) % 4)];
    faces.push(a, b, a + 4, b, b + 4, a + 4);
  }
}
