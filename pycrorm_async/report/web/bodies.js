// Builds each object as nested groups, one for each link, so that setting joints and a pose is forward kinematics.

import { lastUpTo } from "./episode.js";

const DOUBLE_SIDE = 2; // THREE.DoubleSide, for meshes whose triangles do not all turn the same way
const GREY = [0.62, 0.64, 0.68, 1];

export class Body {
  constructor(object, model) {
    this.object = object;
    this.group = new THREE.Group();
    this.links = new Map([[model.root, new THREE.Group()]]);
    this.group.add(this.links.get(model.root));
    this.joints = model.joints.filter((each) => this.#addJoint(each)).map(([name, type, , child, , , axis, mimic]) => ({
      name,
      type,
      mimic,
      axis: new THREE.Vector3(...axis).normalize(),
      moved: this.links.get(child),
    }));
    this.movable = this.joints.filter((each) => each.type !== "fixed");
    for (const [link, shapes] of Object.entries(model.shapes)) {
      for (const each of shapes) this.links.get(link)?.add(meshOf(each, object.color, model));
    }
    this.base = object.base_link ? this.links.get(object.base_link) : null;
  }

  #addJoint([, , parent, child, xyz, rpy]) {
    const holder = this.links.get(parent);
    if (holder === undefined || this.links.has(child)) return false;
    const origin = new THREE.Group();
    place(origin, xyz, rpy);
    const link = new THREE.Group();
    origin.add(link);
    holder.add(origin);
    this.links.set(child, link);
    return true;
  }

  /** Put the object at its pose and its joints at their positions after an event. */
  update(event) {
    const { joints, poses } = this.object;
    for (const each of this.movable) {
      const follows = each.mimic && (joints.has(each.mimic[0]) || !joints.has(each.name));
      const [source, multiplier, offset] = follows ? each.mimic : [each.name, 1, 0];
      const track = joints.get(source);
      const position = (track === undefined ? 0 : track.valueAt(event)) * multiplier + offset;
      if (each.type === "prismatic") each.moved.position.copy(each.axis).multiplyScalar(position);
      else each.moved.quaternion.setFromAxisAngle(each.axis, position);
    }
    const [x, y, z, ...orientation] = poses.valueAt(event);
    const root = this.group;
    root.position.set(x, y, z);
    root.quaternion.set(...orientation);
    if (this.base) {
      root.updateMatrixWorld(true);
      const inRoot = root.matrixWorld.clone().invert().multiply(this.base.matrixWorld);
      root.matrixWorld.clone().multiply(inRoot.invert()).decompose(root.position, root.quaternion, root.scale);
    }
    root.updateMatrixWorld(true);
  }
}

function place(group, xyz, [roll, pitch, yaw]) {
  group.position.set(...xyz);
  group.rotation.set(roll, pitch, yaw, "ZYX");
}

function meshOf([kind, sizes, xyz, rpy, color], override, model) {
  const [red, green, blue, opacity] = override ?? color ?? GREY;
  const material = new THREE.MeshStandardMaterial({ roughness: 0.75, metalness: 0.05 });
  material.color.setRGB(red, green, blue, "srgb");
  if (opacity < 1) Object.assign(material, { transparent: true, opacity });
  if (kind === "mesh") Object.assign(material, { flatShading: true, side: DOUBLE_SIDE });
  const geometry = kind === "mesh" ? trianglesOf(model, sizes[0]) : geometryOf(kind, sizes);
  const mesh = new THREE.Mesh(geometry, material);
  if (kind === "mesh") mesh.scale.set(...sizes.slice(1));
  mesh.castShadow = mesh.receiveShadow = true;
  const group = new THREE.Group();
  place(group, xyz, rpy);
  group.add(mesh);
  return group;
}

/** The geometry of a recorded mesh file, made once for all links that have it. */
function trianglesOf(model, reference) {
  const mesh = model.meshes[reference];
  if (mesh.geometry === undefined) {
    const bytes = (text) => Uint8Array.from(atob(text), (each) => each.charCodeAt(0)).buffer;
    mesh.geometry = new THREE.BufferGeometry();
    mesh.geometry.setAttribute("position", new THREE.Float32BufferAttribute(new Float32Array(bytes(mesh.vertices)), 3));
    mesh.geometry.setIndex([...new Uint32Array(bytes(mesh.faces))]);
    mesh.geometry.computeVertexNormals();
  }
  return mesh.geometry;
}

function geometryOf(kind, sizes) {
  if (kind === "box") return new THREE.BoxGeometry(...sizes);
  if (kind === "sphere") return new THREE.SphereGeometry(sizes[0], 20, 14);
  if (kind === "capsule") return capsuleOf(...sizes);
  return new THREE.CylinderGeometry(sizes[0], sizes[0], sizes[1], 24).rotateX(Math.PI / 2);
}

/** A sphere whose halves are drawn apart by the length; an odd number of rings leaves none at the equator. */
function capsuleOf(radius, length) {
  const geometry = new THREE.SphereGeometry(radius, 24, 15).rotateX(Math.PI / 2);
  const { position } = geometry.attributes;
  for (let at = 0; at < position.count; at++) position.setZ(at, position.getZ(at) + (Math.sign(position.getZ(at)) * length) / 2);
  return geometry;
}

/** The bodies of an episode, made when they are first needed. */
export class Bodies {
  constructor(episode) {
    this.episode = episode;
    this.made = new Map();
  }

  of(object) {
    if (!this.made.has(object.id)) {
      const model = this.episode.models[object.model] ?? this.episode.models[""];
      this.made.set(object.id, new Body(object, model));
    }
    return this.made.get(object.id);
  }

  /** The bodies that are in the world after an event, in their state then. */
  at(event) {
    const present = this.episode.presentAt(event).map((each) => this.of(each));
    for (const each of present) each.update(event);
    return present;
  }
}

const NAMES_MAX = 60;

/** The bodies whose names are drawn, so many that names can be read: the chosen one, robots, then the others. */
export function namedOf(present, chosen) {
  const rankOf = ({ object }) => (object === chosen ? 0 : object.type === "ROBOT" ? 1 : 2);
  const named = present.filter(({ object }) => object.type !== "ENVIRONMENT");
  if (named.length <= NAMES_MAX) return named;
  return named.sort((one, other) => rankOf(one) - rankOf(other)).slice(0, NAMES_MAX);
}

/** The name of an object, and which arm holds it. */
export function heldName(object, held) {
  const holder = held.find((each) => each.object === object);
  return holder === undefined || !holder.by ? object.name : `${object.name} in the ${holder.by}`;
}

const COLORS = ["--path-1", "--path-2", "--path-3", "--path-4"];
const DASHES = [null, [3, 2], [1, 1.5], [7, 2]];

/** The ways of the objects that moved during a node: name, variable of the colour, dash in widths, and positions. */
export function pathsOf(episode, node) {
  if (node === null) return [];
  const paths = [];
  for (const object of episode.objects) {
    const { at, values } = object.poses;
    const points = values.slice(Math.max(0, lastUpTo(at, node.start)), lastUpTo(at, node.lastEvent) + 1);
    const moved = points.filter((each, index) => index === 0 || distance(each, points[index - 1]) > 1e-3);
    const style = paths.length % COLORS.length;
    if (moved.length > 1) paths.push({ object, color: COLORS[style], dash: DASHES[style], points: moved.slice(-400) });
  }
  return paths;
}

const distance = ([x, y, z], [u, v, w]) => Math.hypot(x - u, y - v, z - w);
