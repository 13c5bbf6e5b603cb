// Chooses from where the scene is seen: everything at once, one object, or along with an object that moves.

import { cornersOf, surroundings } from "./extent.js";

const AWAY = [-1.3, -1.1, 0.95];
const ANGLE_OF_VIEW = 28; // narrow, so that what stands upright leans little
const MARGIN = 1.07;
const LEGEND_PX = 30; // at the lower edge, kept free
const NEAREST_M = 3;
const CLOSE_M = 6;

export class SceneCamera {
  constructor(canvas, onChange) {
    this.camera = new THREE.PerspectiveCamera(ANGLE_OF_VIEW, 1, 0.05, 500);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", onChange);
    this.controls.addEventListener("start", () => (this.touched = true));
    this.followed = null;
    this.covered = 0;
  }

  resize(width, height) {
    this.camera.aspect = width / height;
    this.covered = Math.min(LEGEND_PX / height, 0.25);
    this.camera.updateProjectionMatrix();
  }

  /** Look at points as closely as all of them are in sight; return their middle and their reach. */
  frame(points) {
    const corners = points.length > 0 ? points : [new THREE.Vector3(-1, -1, 0), new THREE.Vector3(1, 1, 1)];
    const box = new THREE.Box3().setFromPoints(corners);
    const size = box.getSize(new THREE.Vector3());
    const target = box.getCenter(new THREE.Vector3());
    const away = new THREE.Vector3(...AWAY).normalize();
    const across = new THREE.Vector3().crossVectors(this.camera.up, away).normalize();
    const upright = new THREE.Vector3().crossVectors(away, across);
    const tall = Math.tan((this.camera.fov * Math.PI) / 360);
    let distance = 0;
    for (let turn = 0; turn < 3; turn++) {
      const ends = [Infinity, -Infinity, Infinity, -Infinity];
      const seen = corners.map((each) => each.clone().sub(target)).map((each) => [each.dot(across), each.dot(upright), each.dot(away)]);
      distance = NEAREST_M;
      for (const [x, y, z] of seen) {
        const widest = Math.max(Math.abs(x) / this.camera.aspect, Math.abs(y) / (1 - this.covered));
        distance = Math.max(distance, widest / tall + z);
      }
      for (const [x, y, z] of seen) {
        const near = distance / (distance - z);
        for (const [end, place] of [[0, x * near], [2, y * near]]) {
          ends[end] = Math.min(ends[end], place);
          ends[end + 1] = Math.max(ends[end + 1], place);
        }
      }
      target.addScaledVector(across, (ends[0] + ends[1]) / 2).addScaledVector(upright, (ends[2] + ends[3]) / 2);
    }
    target.addScaledVector(upright, -this.covered * tall * distance);
    this.touched = false;
    this.#look(target, away.multiplyScalar(distance * MARGIN));
    return { middle: target, reach: size.length() / 2 };
  }

  /** True if all that bodies are made of is in the picture, or little beyond its edges; 1 is at an edge. */
  sees(bodies, edge) {
    this.camera.updateMatrixWorld();
    return surroundings(bodies).every((body) =>
      cornersOf(body).every((each) => {
        const { x, y, z } = each.project(this.camera);
        return Math.abs(x) <= edge && Math.abs(y) <= edge && Math.abs(z) <= 1;
      }),
    );
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
    const target = new THREE.Box3().setFromObject(body.group).getCenter(new THREE.Vector3());
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
