// Draws the world after an event with WebGL: bodies, the paths of the current action, names.

import { pathsOf } from "./bodies.js";
import { colorOf, element } from "./dom.js";

export class SceneView {
  /** Throws if the browser has no WebGL. */
  constructor(holder, episode, bodies) {
    this.holder = holder;
    this.episode = episode;
    this.bodies = bodies;
    const canvas = document.createElement("canvas");
    const context = canvas.getContext("webgl2", { antialias: true });
    if (context === null) throw new Error("this browser has no WebGL");
    this.renderer = new THREE.WebGLRenderer({ canvas, context });
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.domElement.setAttribute("aria-label", "the scene at the moment under the cursor");
    this.renderer.domElement.setAttribute("role", "img");
    this.names = element("div", { class: "names", "aria-hidden": "true" });
    holder.append(this.renderer.domElement, this.names);
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(42, 1, 0.05, 500);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, this.renderer.domElement);
    this.controls.addEventListener("change", () => this.#render());
    this.controls.addEventListener("start", () => (this.touched = true));
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9a9488, 2.1));
    const sun = new THREE.DirectionalLight(0xffffff, 1.9);
    sun.position.set(-4, -3, 8);
    this.scene.add(sun);
    this.world = new THREE.Group();
    this.paths = new THREE.Group();
    this.scene.add(this.world, this.paths);
    this.paint();
    new ResizeObserver(() => this.#resize()).observe(holder);
  }

  /** Use the colours of the page's theme. */
  paint() {
    this.scene.background = new THREE.Color(colorOf("--scene"));
    if (this.grid) this.scene.remove(this.grid);
    const line = colorOf("--grid");
    this.grid = new THREE.GridHelper(20, 20, line, line);
    this.grid.rotation.x = Math.PI / 2;
    this.grid.position.z = -0.002;
    this.scene.add(this.grid);
    this.drawnNode = undefined;
    if (this.event !== undefined) this.show(this.event, this.node, this.pathList);
  }

  /** Take in what the episode has by now; `show` draws it. */
  grow() {
    this.drawnNode = undefined;
    const { length } = this.episode.objects;
    if (length !== this.framedObjects && this.framed && !this.touched) this.#frame();
  }

  show(event, node, paths) {
    Object.assign(this, { event, node, pathList: paths });
    this.present = this.bodies.at(event);
    const groups = this.present.map((each) => each.group);
    for (const each of [...this.world.children]) if (!groups.includes(each)) this.world.remove(each);
    for (const each of groups) if (each.parent !== this.world) this.world.add(each);
    if (node !== this.drawnNode) this.#drawPaths(paths);
    this.drawnNode = node;
    this.#render();
  }

  #drawPaths(paths) {
    for (const each of [...this.paths.children]) {
      this.paths.remove(each);
      each.geometry.dispose();
    }
    for (const { points, color } of paths) {
      const flat = points.flatMap(([x, y, z]) => [x, y, z + 0.02]);
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.Float32BufferAttribute(flat, 3));
      this.paths.add(new THREE.Line(geometry, new THREE.LineBasicMaterial({ color: colorOf(color) })));
    }
  }

  /** Look at everything that is there when the page opens, from the side of the robot. */
  #frame() {
    this.framedObjects = this.episode.objects.length;
    const box = new THREE.Box3();
    for (const each of this.bodies.at(this.episode.opens)) box.expandByObject(each.group);
    if (this.event !== undefined) this.bodies.at(this.event);
    for (const { points } of pathsOf(this.episode, this.episode.actionAt(this.episode.opens))) {
      for (const [x, y, z] of points) box.expandByPoint(new THREE.Vector3(x, y, z));
    }
    if (box.isEmpty()) box.expandByPoint(new THREE.Vector3(-1, -1, 0)).expandByPoint(new THREE.Vector3(1, 1, 1));
    const middle = box.getCenter(new THREE.Vector3());
    const reach = Math.max(box.getSize(new THREE.Vector3()).length() / 2, 0.6);
    const upright = (this.camera.fov * Math.PI) / 360;
    const narrowest = Math.min(upright, Math.atan(Math.tan(upright) * this.camera.aspect));
    const away = new THREE.Vector3(-1.3, -1.1, 1.05).setLength(reach / Math.sin(narrowest));
    this.controls.target.copy(middle);
    this.camera.position.copy(middle).add(away);
    this.controls.update();
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.holder;
    if (width === 0 || height === 0) return;
    this.renderer.setSize(width, height);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (!this.framed) this.#frame();
    this.framed = true;
    this.#render();
  }

  #render() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      this.renderer.render(this.scene, this.camera);
      this.#placeNames();
    });
  }

  #placeNames() {
    const { clientWidth: width, clientHeight: height } = this.holder;
    const labels = [];
    for (const { object, group } of this.present ?? []) {
      if (object.type === "ENVIRONMENT") continue;
      const box = new THREE.Box3().setFromObject(group);
      const top = new THREE.Vector3((box.min.x + box.max.x) / 2, (box.min.y + box.max.y) / 2, box.max.z);
      top.project(this.camera);
      if (Math.abs(top.z) > 1) continue;
      const label = element("span", {}, element("bdi", {}, object.name));
      labels.push({ label, x: ((top.x + 1) / 2) * width, y: ((1 - top.y) / 2) * height - 4 });
    }
    this.names.replaceChildren(...labels.map((each) => each.label));
    stack(labels);
  }
}

/** Place labels, each above those that it would cover. */
function stack(labels) {
  const placed = [];
  for (const each of labels.sort((one, other) => other.y - one.y)) {
    const { offsetWidth: width, offsetHeight: height } = each.label;
    const covers = (other) => Math.abs(each.x - other.x) < (width + other.width) / 2 && Math.abs(each.y - other.y) < height;
    while (placed.some(covers)) each.y -= height / 2;
    each.label.style.left = `${each.x}px`;
    each.label.style.top = `${each.y}px`;
    placed.push({ ...each, width });
  }
}
