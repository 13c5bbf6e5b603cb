// Finds what must be in the picture: at one moment, and of a whole episode; never for the sake of what is far from all else.

const SURROUNDINGS_M = 2.5; // of a large environment, as much is framed around the objects in it
const ACTION_M = 3; // what lies farther from all that moves, and never moves itself, is left out
const FAR_M = 10;
const FAR_TIMES = 6;
const SAMPLES_MAX = 4000;
const MOMENTS = 12;
const OUTWARDS = Array.from({ length: 16 }, (_, index) => [Math.cos((index * Math.PI) / 8), Math.sin((index * Math.PI) / 8), 0]);
OUTWARDS.push([0, 0, 1], [0, 0, -1]);

/** The points to look at, to see bodies and paths at one moment. */
export function pointsOfMoment(bodies, paths) {
  const seen = surroundings(bodies);
  const isNear = nearTo(seen.map(({ group }) => group.position.toArray()));
  const way = paths.flatMap(({ points }) => points).filter(isNear);
  return withEnvironment([...seen.flatMap(cornersOf), ...way.map((each) => new THREE.Vector3(...each.slice(0, 3)))], bodies);
}

/** The points to look at, to see the bodies of an episode wherever they come; leaves the bodies at other moments. */
export function pointsOfEpisode(episode, bodies) {
  const all = episode.objects.filter((each) => each.type !== "ENVIRONMENT");
  const acting = all.filter((each) => each.type === "ROBOT" || each.poses.values.length > 1).flatMap(({ poses }) => sampleOf(poses.values, 100));
  const isPartOf = ({ poses }) => poses.values.length > 1 || acting.some((each) => Math.hypot(each[0] - poses.values[0][0], each[1] - poses.values[0][1]) < ACTION_M);
  const objects = acting.length > 0 ? all.filter(isPartOf) : all;
  const isNear = nearTo(objects.flatMap(({ poses }) => sampleOf(poses.values)));
  const points = objects.flatMap((object) => {
    const body = bodies.of(object);
    return momentsOf(object, isNear, episode).flatMap((event) => {
      body.update(event);
      return cornersOf(body);
    });
  });
  const present = bodies.at(episode.opens);
  return withEnvironment(points, present);
}

/** The events at which an object is outermost, and some between them, because its joints move too. */
function momentsOf({ poses, joints }, isNear, { first, opens }) {
  const { at, values } = poses;
  const outermost = OUTWARDS.map(() => [-Infinity, null]);
  values.forEach((each, index) => {
    if (!isNear(each)) return;
    OUTWARDS.forEach(([x, y, z], direction) => {
      const reach = each[0] * x + each[1] * y + each[2] * z;
      if (reach > outermost[direction][0]) outermost[direction] = [reach, at[index]];
    });
  });
  const moments = new Set(outermost.map(([, event]) => event).filter((event) => event !== null));
  if (joints.size === 0 || moments.size === 0) return [...moments];
  const between = Array.from({ length: MOMENTS }, (_, index) => Math.round(first + ((opens - first) * (index + 1)) / MOMENTS));
  for (const event of between) if (isNear(poses.valueAt(event))) moments.add(event);
  return [...moments];
}

/** Of bodies those that are near the robots, or near the middle of all if there is none; environments are left out. */
export function surroundings(bodies) {
  const objects = bodies.filter((each) => each.object.type !== "ENVIRONMENT");
  const robots = objects.filter((each) => each.object.type === "ROBOT");
  const places = (each) => each.map(({ group }) => group.position.toArray());
  const isNear = nearTo(places(objects), places(robots.length > 0 ? robots : objects));
  return objects.filter(({ group }) => isNear(group.position.toArray()));
}

/** A test whether a position is near the middle of others: within 10 m, or as far as six times the usual distance. */
function nearTo(positions, around = positions) {
  const sorted = (numbers) => numbers.sort((one, other) => one - other);
  const share = (numbers, part) => numbers[Math.floor((numbers.length - 1) * part)] ?? 0;
  const middle = [0, 1, 2].map((axis) => share(sorted(around.map((each) => each[axis])), 0.5));
  const distance = (each) => Math.hypot(each[0] - middle[0], each[1] - middle[1], each[2] - middle[2]);
  const far = Math.max(FAR_M, FAR_TIMES * share(sorted(positions.map(distance)), 0.75));
  return (each) => distance(each) <= far;
}

const sampleOf = (values, most = SAMPLES_MAX) => {
  const step = Math.ceil(values.length / most);
  return step <= 1 ? values : values.filter((_, index) => index % step === 0);
};

/** Add of each environment what surrounds the points. */
function withEnvironment(points, bodies) {
  const near = new THREE.Box3().setFromPoints(points).expandByScalar(SURROUNDINGS_M);
  for (const each of bodies) {
    if (each.object.type !== "ENVIRONMENT") continue;
    for (const corner of cornersOf(each)) points.push(near.isEmpty() ? corner : near.clampPoint(corner, corner));
  }
  return points;
}

/** The corners of the boxes around all that a body is made of, at its present pose. */
export function cornersOf({ group }) {
  const corners = [];
  group.traverse((each) => {
    if (!each.isMesh) return;
    if (each.geometry.boundingBox === null) each.geometry.computeBoundingBox();
    const { min, max } = each.geometry.boundingBox;
    for (const x of [min.x, max.x])
      for (const y of [min.y, max.y])
        for (const z of [min.z, max.z]) corners.push(new THREE.Vector3(x, y, z).applyMatrix4(each.matrixWorld));
  });
  return corners;
}
