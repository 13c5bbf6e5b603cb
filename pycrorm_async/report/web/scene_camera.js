// Chooses from where the scene is seen: everything at once, one object, or along with an object that moves.

const AWAY = [-1.3, -1.1, 1.05];
const MARGIN = 1.08;
const SURROUNDINGS_M = 2.5; // of a large environment, as much is framed around the objects in it
const CLOSE_M = 4;

export class SceneCamera {
  constructor(canvas, onChange) {
    this.camera = new THREE.PerspectiveCamera(42, 1, 0.05, 500);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", onChange);
    this.controls.addEventListener("start", () => (this.touched = true));
    this.followed = null;
  }

  resize(width, height) {
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  /** Look at these bodies and points as closely as all of them are in sight; return their middle and their reach. */
  frame(bodies, points) {
    const corners = pointsOf(bodies, points);
    const box = new THREE.Box3().setFromPoints(corners);
    const size = box.getSize(new THREE.Vector3());
    const target = box.getCenter(new THREE.Vector3());
    const away = new THREE.Vector3(...AWAY).normalize();
    const across = new THREE.Vector3().crossVectors(this.camera.up, away).normalize();
    const upright = new THREE.Vector3().crossVectors(away, across);
    const tall = Math.tan((this.camera.fov * Math.PI) / 360);
    let distance = 0;
    for (let turn = 0; turn < 3; turn++) {
      const seen = corners.map((each) => each.clone().sub(target)).map((each) => [each.dot(across), each.dot(upright), each.dot(away)]);
      distance = Math.max(1.2, ...seen.map(([x, y, z]) => Math.max(Math.abs(x) / this.camera.aspect, Math.abs(y)) / tall + z));
      const middleOf = (axis) => {
        const places = seen.map((each) => each[axis] / (distance - each[2]));
        return ((Math.min(...places) + Math.max(...places)) / 2) * distance;
      };
      target.addScaledVector(across, middleOf(0)).addScaledVector(upright, middleOf(1));
    }
    this.#look(target, away.multiplyScalar(distance * MARGIN));
    return { middle: target, reach: size.length() / 2 };
  }

  #look(target, away) {
    this.controls.target.copy(target);
    this.camera.position.copy(target).add(away);
    this.camera.far = Math.max(500, away.length() * 4);
    this.camera.updateProjectionMatrix();
    this.controls.update();
  }

  /** Look at a body from the present side, from at most a few metres away. */
  lookAt(body) {
    const target = middleOf(body);
    const away = this.camera.position.clone().sub(this.controls.target).clampLength(0.5, CLOSE_M);
    this.touched = true;
    this.#look(target, away);
  }

  /** Keep a body in sight from now on, or no body. */
  follow(body) {
    this.followed = body;
    if (body === null) return;
    this.lookAt(body);
    this.from = body.group.position.clone();
  }

  /** Move as far as the followed body has moved. */
  update(bodies) {
    if (this.followed === null || !bodies.includes(this.followed)) return;
    const moved = this.followed.group.position.clone().sub(this.from);
    this.from.add(moved);
    this.camera.position.add(moved);
    this.controls.target.add(moved);
    this.controls.update();
  }
}

const boxOf = (body) => new THREE.Box3().setFromObject(body.group);
const middleOf = (body) => boxOf(body).getCenter(new THREE.Vector3());

/** The points to look at: corners of all that bodies are made of, but of an environment only what surrounds the others. */
function pointsOf(bodies, path) {
  const objects = bodies.filter((each) => each.object.type !== "ENVIRONMENT");
  const points = [...objects.flatMap(cornersOf), ...path.map((each) => new THREE.Vector3(...each.slice(0, 3)))];
  const near = new THREE.Box3().setFromPoints(points).expandByScalar(SURROUNDINGS_M);
  for (const each of bodies) {
    if (each.object.type !== "ENVIRONMENT") continue;
    for (const corner of cornersOf(each)) points.push(near.isEmpty() ? corner : near.clampPoint(corner, corner));
  }
  return points.length > 0 ? points : [new THREE.Vector3(-1, -1, 0), new THREE.Vector3(1, 1, 1)];
}

function cornersOf({ group }) {
  const corners = [];
  group.traverse((each) => {
    if (!each.isMesh) return;
    each.geometry.computeBoundingBox();
    const { min, max } = each.geometry.boundingBox;
    for (const x of [min.x, max.x])
      for (const y of [min.y, max.y])
        for (const z of [min.z, max.z]) corners.push(new THREE.Vector3(x, y, z).applyMatrix4(each.matrixWorld));
  });
  return corners;
}
