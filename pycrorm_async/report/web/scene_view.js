// Draws the world after an event with WebGL: bodies, the paths of the current action, names; and shows what is pointed at.

import { heldName, namedOf } from "./bodies.js";
import { colorOf, element, recorded } from "./dom.js";
import { pointsOfEpisode, pointsOfMoment } from "./extent.js";
import { rodAlong } from "./path_lines.js";
import { SceneCamera } from "./scene_camera.js";
import { cloudsAt, pointsOf } from "./seen_view.js";

const CLICK_PX = 4;
const GRID_MAX = 200;
const GRID_PARTS = 40;
const SUN = [-5, 3.5, 8];
const PATH_WIDTH = 0.0055; // of the reach of what is framed
const LABELS_PX = 400; // labels are moved down by so much at most
const CUT_MAX = 1.15; // an arm may leave the picture so far, before the picture changes

export class SceneView {
  /** Throws if the browser has no WebGL. `onPick` gets the object that is clicked, or null. */
  constructor(holder, episode, bodies, { onPick }) {
    Object.assign(this, { holder, episode, bodies, onPick, chosen: null });
    const canvas = document.createElement("canvas");
    const context = canvas.getContext("webgl2", { antialias: true });
    if (context === null) throw new Error("this browser has no WebGL");
    this.renderer = new THREE.WebGLRenderer({ canvas, context });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.shadowMap.enabled = !isSoftware(context);
    this.renderer.shadowMap.autoUpdate = false; // a turn of the camera needs none
    canvas.setAttribute("aria-label", "the scene at the moment under the cursor; the panel Objects lists what is in it");
    canvas.setAttribute("role", "img");
    this.names = element("div", { class: "names", "aria-hidden": "true" });
    this.hint = element("div", { class: "hint", "aria-hidden": "true" });
    holder.append(canvas, this.names, this.hint);
    this.scene = new THREE.Scene();
    this.camera = new SceneCamera(canvas, () => this.#render());
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9a9488, 1.9));
    this.sun = new THREE.DirectionalLight(0xffffff, 2.1);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(2048, 2048);
    this.sun.shadow.normalBias = 0.02;
    this.floor = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), new THREE.ShadowMaterial({ opacity: 0.16 }));
    this.floor.receiveShadow = true;
    this.floor.position.z = -0.004;
    this.world = new THREE.Group();
    this.paths = new THREE.Group();
    this.clouds = new THREE.Group();
    this.scene.add(this.clouds, this.sun, this.sun.target, this.floor, this.world, this.paths);
    this.#light(new THREE.Vector3(), 5);
    this.#listen(canvas);
    this.paint();
    new ResizeObserver(() => this.#resize()).observe(holder);
  }

  #listen(canvas) {
    let pressed = null;
    canvas.addEventListener("pointerdown", ({ clientX, clientY }) => (pressed = [clientX, clientY]));
    canvas.addEventListener("pointerup", (released) => {
      const moved = pressed === null ? Infinity : Math.hypot(released.clientX - pressed[0], released.clientY - pressed[1]);
      pressed = null;
      if (moved < CLICK_PX && released.button === 0) this.onPick(this.#bodyAt(released)?.object ?? null);
    });
    canvas.addEventListener("pointermove", (pointed) => this.#point(pointed));
    canvas.addEventListener("pointerleave", () => (this.hint.textContent = ""));
    canvas.addEventListener("dblclick", (pointed) => {
      const body = this.#bodyAt(pointed);
      if (body !== undefined) this.camera.lookAt(body);
    });
  }

  /** The body that is drawn at the place of a pointer. */
  #bodyAt({ offsetX, offsetY }) {
    const { clientWidth, clientHeight } = this.holder;
    const place = new THREE.Vector2((offsetX / clientWidth) * 2 - 1, 1 - (offsetY / clientHeight) * 2);
    const ray = new THREE.Raycaster();
    ray.setFromCamera(place, this.camera.camera);
    let [drawn] = ray.intersectObjects(this.world.children, true).map((each) => each.object);
    while (drawn && drawn.parent !== this.world) drawn = drawn.parent;
    return this.present?.find((each) => each.group === drawn);
  }

  /** Name the object under the pointer, once in a picture. */
  #point(pointed) {
    const waits = this.pointed;
    this.pointed = pointed.buttons === 0 ? pointed : null;
    if (waits) return;
    requestAnimationFrame(() => {
      const body = this.pointed ? this.#bodyAt(this.pointed) : undefined;
      const { offsetX, offsetY } = this.pointed ?? {};
      this.pointed = null;
      this.hint.replaceChildren(...(body === undefined ? [] : [recorded(body.object.name), ` ${body.object.type}`]));
      if (body !== undefined) Object.assign(this.hint.style, { left: `${offsetX + 14}px`, top: `${offsetY + 14}px` });
      this.renderer.domElement.style.cursor = body === undefined ? "grab" : "pointer";
    });
  }

  /** Use the colours of the page's theme. */
  paint() {
    this.scene.background = new THREE.Color(colorOf("--scene"));
    this.#drawGrid();
    this.drawnNode = this.drawnClouds = undefined;
    if (this.event !== undefined) this.show(this.event, this.node, this.pathList);
  }

  /** A grid of metres around the middle of the scene. */
  #drawGrid() {
    if (this.grid) {
      this.scene.remove(this.grid);
      this.grid.geometry.dispose();
    }
    const size = Math.min(GRID_MAX, 2 * Math.ceil(Math.max(10, 2.5 * this.reach)));
    const line = colorOf("--grid");
    this.grid = new THREE.GridHelper(size, size, line, line);
    divideLines(this.grid.geometry, Math.min(size, GRID_PARTS));
    this.grid.rotation.x = Math.PI / 2;
    this.grid.position.set(Math.round(this.middle.x), Math.round(this.middle.y), -0.002);
    this.scene.add(this.grid);
  }

  /** Let the sun shine and throw shadows on all that is within reach. */
  #light(middle, reach) {
    Object.assign(this, { middle, reach });
    const far = 2 * reach + 4;
    const { camera } = this.sun.shadow;
    this.sun.target.position.copy(middle);
    this.sun.position.set(...SUN).setLength(far).add(middle);
    Object.assign(camera, { left: -far / 2, right: far / 2, top: far / 2, bottom: -far / 2, near: 0.1, far: 2 * far });
    camera.updateProjectionMatrix();
    this.renderer.shadowMap.needsUpdate = true;
    this.floor.position.setX(middle.x).setY(middle.y);
    this.floor.scale.set(2 * far, 2 * far, 1);
  }

  /** Take in what the episode has by now; `show` draws it. */
  grow() {
    this.drawnNode = undefined;
    const { length } = this.episode.objects;
    if (length !== this.framedObjects && this.framed && !this.camera.touched) this.#frameEpisode();
  }

  show(event, node, paths) {
    Object.assign(this, { event, node, pathList: paths });
    this.present = this.bodies.at(event);
    const groups = this.present.map((each) => each.group);
    for (const each of [...this.world.children]) if (!groups.includes(each)) this.world.remove(each);
    for (const each of groups) if (each.parent !== this.world) this.world.add(each);
    this.camera.update(this.present);
    if (this.framed) this.#keepInSight();
    if (node !== this.drawnNode) this.#drawPaths(paths);
    this.drawnNode = node;
    this.#drawClouds(cloudsAt(this.episode, event));
    this.renderer.shadowMap.needsUpdate = true;
    this.#render();
  }

  /** Let an object shine, or none. */
  choose(object) {
    for (const [each, power] of [[this.chosen, 0], [object, 0.45]]) {
      if (each === null) continue;
      this.bodies.of(each).group.traverse((part) => {
        if (part.isMesh) part.material.emissive.set(colorOf("--link")).multiplyScalar(power);
      });
    }
    this.chosen = object;
    this.#render();
  }

  /** Keep an object in sight, or none. */
  follow(object) {
    this.camera.follow(object === null ? null : this.bodies.of(object));
  }

  #drawClouds(clouds) {
    if (clouds.length === this.drawnClouds?.length && clouds.every((each, index) => each === this.drawnClouds[index])) return;
    for (const each of this.clouds.children) each.geometry.dispose();
    this.clouds.clear();
    for (const each of clouds) this.clouds.add(pointsOf(each, new THREE.Color(colorOf("--path-3"))));
    this.drawnClouds = clouds;
  }

  #drawPaths(paths) {
    for (const each of [...this.paths.children]) {
      this.paths.remove(each);
      each.geometry.dispose();
    }
    for (const { points, color, dash } of paths) {
      const material = new THREE.MeshStandardMaterial({ color: 0, emissive: new THREE.Color(colorOf(color)), roughness: 1 });
      this.paths.add(new THREE.Mesh(rodAlong(points, PATH_WIDTH * this.reach, dash), material));
    }
  }

  /** Look at every place to which a body comes in the episode. */
  #frameEpisode() {
    const { episode } = this;
    this.framedObjects = episode.objects.length;
    if (this.extentLast !== episode.last) this.extent = pointsOfEpisode(episode, this.bodies);
    this.extentLast = episode.last;
    if (this.event !== undefined) this.bodies.at(this.event);
    this.#frame(this.extent);
    this.framing = "episode";
  }

  /** Look at what is there at the moment, and at the paths that are drawn. */
  frameMoment() {
    this.#frame(pointsOfMoment(this.present, this.pathList));
    this.framing = "moment";
  }

  #frame(points) {
    const { middle, reach } = this.camera.frame(points);
    this.#light(middle.clone().setZ(0), reach);
    this.#drawGrid();
    this.drawnNode = undefined;
    this.#render();
  }

  /** Look at the episode again if a body has left the picture, or at the moment as long as one is beyond that too. */
  #keepInSight() {
    const { camera, present } = this;
    if (camera.touched || camera.followed !== null || (this.framing !== "away" && camera.sees(present, 1))) return;
    if (this.framing !== "episode" || this.extentLast !== this.episode.last) this.#frameEpisode();
    if (camera.sees(present, CUT_MAX)) return;
    this.frameMoment();
    this.framing = "away";
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    this.camera.resize(width, height);
    if (!this.framed || !this.camera.touched) this.#frameEpisode();
    this.framed = true;
    if (this.event !== undefined) this.show(this.event, this.node, this.pathList);
    this.#render();
  }

  #render() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.renderer.render(this.scene, this.camera.camera);
      this.#placeNames();
    });
  }

  #placeNames() {
    const { clientWidth: width, clientHeight: height } = this.holder;
    const labels = [];
    const held = this.episode.heldAt(this.event);
    for (const { object, group } of namedOf(this.present ?? [], this.chosen)) {
      const box = new THREE.Box3().setFromObject(group);
      const top = new THREE.Vector3((box.min.x + box.max.x) / 2, (box.min.y + box.max.y) / 2, box.max.z);
      top.project(this.camera.camera);
      const middle = box.getCenter(new THREE.Vector3()).project(this.camera.camera);
      if (Math.max(Math.abs(middle.x), Math.abs(middle.y), Math.abs(middle.z)) > 1) continue;
      const label = element("span", { class: object === this.chosen ? "chosen" : null }, recorded(heldName(object, held)));
      labels.push({ label, x: ((top.x + 1) / 2) * width, y: ((1 - top.y) / 2) * height - 4 });
    }
    this.names.replaceChildren(...labels.map((each) => each.label));
    const around = this.holder.getBoundingClientRect();
    const taken = [...this.holder.parentElement.querySelectorAll("#views button, #legend > *, #seen figure")].map((each) => each.getBoundingClientRect());
    stack(labels, width, taken.map((each) => ({
      x: (each.left + each.right) / 2 - around.left, y: each.bottom - around.top, width: each.width + 8, height: each.height + 4,
    })));
  }
}

/** True if a processor draws, for which shadows cost more than all the rest. */
function isSoftware(context) {
  let name = context.getParameter(context.RENDERER);
  if (/WebKit/.test(name)) {
    const names = context.getExtension("WEBGL_debug_renderer_info");
    if (names !== null) name = context.getParameter(names.UNMASKED_RENDERER_WEBGL);
  }
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

/** Divide lines into parts, because some drivers leave out a line that ends behind the camera. */
function divideLines(geometry, parts) {
  for (const name of ["position", "color"]) {
    const { array } = geometry.attributes[name];
    const divided = [];
    for (let at = 0; at < array.length; at += 6) {
      const pointAt = (share) => [0, 1, 2].map((axis) => array[at + axis] * (1 - share) + array[at + 3 + axis] * share);
      for (let part = 0; part < parts; part++) divided.push(...pointAt(part / parts), ...pointAt((part + 1) / parts));
    }
    geometry.setAttribute(name, new THREE.Float32BufferAttribute(divided, 3));
  }
}

/** Place labels inside the picture, each above those that it would cover, or below them where there is no room above. */
function stack(labels, across, taken) {
  const placed = [...taken];
  for (const each of labels.sort((one, other) => other.y - one.y)) {
    const { offsetWidth: width, offsetHeight: height } = each.label;
    each.x = Math.min(Math.max(each.x, width / 2 + 2), across - width / 2 - 2);
    const free = (y) => !placed.some((other) => Math.abs(each.x - other.x) < (width + other.width) / 2 && y > other.y - other.height && other.y > y - height);
    const from = Math.max(each.y, height + 2);
    let y = from;
    while (y >= height + 2 && !free(y)) y -= height / 2;
    if (y < height + 2) for (y = from; !free(y) && y < from + LABELS_PX; y += height / 2);
    each.label.style.left = `${each.x}px`;
    each.label.style.top = `${y}px`;
    placed.push({ x: each.x, y, width, height });
  }
}
