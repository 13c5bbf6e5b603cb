// Reads the document of `episode_fold.py` into nodes, objects and tracks, and answers questions about one event.
// A document is the part of an episode behind an event: a file has one, a stream more and more of them.

export const FAILED = new Set(["FAILED", "ERROR"]);
const END = { SUCCEEDED: "✓", FAILED: "✗", ERROR: "✗", RUNNING: "▶", LOST: "?", UNKNOWN: "?", CANCELLED: "⊘", INTERRUPTED: "⊘" };

/** The sign of a status, so that it is readable without colour. */
export const signOf = (status) => END[status] ?? "•";

/** Sums of differences: the columns of the document hold differences, which are shorter. */
export function sums(differences) {
  let sum = 0;
  return differences.map((each) => (sum += each));
}

/** The last index of a sorted array whose value is at most `value`; -1 if there is none. */
export function lastUpTo(sorted, value) {
  let low = 0;
  let high = sorted.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Append without the limit that a call has on its arguments. */
function append(target, values) {
  for (const each of values) target.push(each);
}

/** How one value changed: `valueAt(event)` is the value after that event. */
export class Track {
  constructor() {
    this.at = [];
    this.values = [];
  }

  extend([at, values], pointsMax = Infinity) {
    append(this.at, sums(at));
    append(this.values, values);
    if (this.at.length <= 2 * pointsMax) return;
    const kept = extremes(this.values, pointsMax);
    this.at = kept.map((index) => this.at[index]);
    this.values = kept.map((index) => this.values[index]);
  }

  valueAt(event) {
    return this.values[Math.max(0, lastUpTo(this.at, event))];
  }
}

/** The indices of the least and the greatest value of each bucket of neighbours, and of the last value, in order. */
export function extremes(values, pointsMax) {
  const size = Math.ceil((2 * values.length) / pointsMax);
  const kept = new Set();
  for (let begin = 0; begin < values.length; begin += size) {
    let [least, greatest] = [begin, begin];
    for (let index = begin; index < Math.min(begin + size, values.length); index += 1) {
      if (values[index] < values[least]) least = index;
      if (values[index] > values[greatest]) greatest = index;
    }
    kept.add(Math.min(least, greatest)).add(Math.max(least, greatest));
  }
  return [...kept.add(values.length - 1)].sort((one, other) => one - other);
}

const CURVE_POINTS_MAX = 2000;
const PICTURES_MAX = 400; // of one camera, whose contents a live page keeps

function extendTracks(tracks, columns, pointsMax) {
  for (const [name, each] of Object.entries(columns)) {
    if (!tracks.has(name)) tracks.set(name, new Track());
    tracks.get(name).extend(each, pointsMax);
  }
}

/** Keys of which the entries of a part follow those before it. */
const LISTS = ["detections", "observations", "locations"];

export class Episode {
  constructor(document) {
    Object.assign(this, { times: [], texts: [], models: {}, nodes: [], roots: [], robots: [], rootFailures: [], objects: [] });
    Object.assign(this, { attachments: [], detections: [], observations: [], locations: [] });
    Object.assign(this, { series: new Map(), samples: new Map(), cameras: new Map(), unpictured: 0, nodeAt: new Map(), objectById: new Map() });
    this.extend(document);
  }

  /** Add a part: what the events behind the last one added and changed. */
  extend(part) {
    Object.assign(this, part.episode);
    append(this.times, sums(part.times));
    append(this.texts, part.texts);
    Object.assign(this.models, part.models);
    this.#extendNodes(part);
    this.judge(part.outcomes ?? {});
    for (const each of part.objects) this.#extendObject(each);
    this.#extendAttachments(part.attachments);
    for (const each of LISTS) append(this[each], part[each]);
    this.#extendPictures(part);
    extendTracks(this.series, part.series, CURVE_POINTS_MAX);
    for (const [id, tracks] of Object.entries(part.samples)) {
      if (!this.samples.has(Number(id))) this.samples.set(Number(id), new Map());
      extendTracks(this.samples.get(Number(id)), tracks, CURVE_POINTS_MAX);
    }
  }

  #extendNodes({ nodes: columns, ended }) {
    const [starts, ends, parents, kinds, types, parameters, statuses, reasons, messages, robots, wholes, results] = columns;
    const { texts } = this;
    starts.forEach((start, index) => {
      const node = new Node(this, start, this.nodeAt.get(parents[index]) ?? null, texts[kinds[index]], texts[types[index]]);
      node.parameters = texts[parameters[index]];
      Object.assign(node, { robot: texts[robots[index]], whole: texts[wholes[index]] });
      if (node.robot && !this.robots.includes(node.robot)) this.robots.push(node.robot);
      node.became(ends[index], ...[statuses, reasons, messages, results].map((column) => texts[column[index]]));
      this.nodes.push(node);
      this.nodeAt.set(start, node);
      const siblings = node.parent?.children ?? this.roots;
      node.place = siblings.push(node);
    });
    ended[0].forEach((start, index) => {
      const [end, ...became] = ended.slice(1).map((column) => column[index]);
      this.nodeAt.get(start)?.became(end, ...became.map((each) => texts[each]));
    });
    this.#findRootFailures();
  }

  /** Judge all nodes again if a failure was added: it may be the cause of one above it. */
  #findRootFailures() {
    const failed = this.nodes.reduce((sum, each) => sum + each.failed, 0);
    if (failed === this.failedCount) return;
    this.failedCount = failed;
    this.rootFailures = this.nodes.filter((each) => each.failed && !each.children.some((child) => child.failed));
    for (const each of this.nodes) each.isRootFailure = false;
    for (const failure of this.rootFailures) {
      failure.isRootFailure = true;
      for (let each = failure; each !== null && !each.holdsFailure; each = each.parent) each.holdsFailure = true;
    }
  }

  /** Take in how the plan went on after failures: outcomes by the event of the failed node's start. */
  judge(outcomes) {
    for (const [start, outcome] of Object.entries(outcomes)) {
      this.nodeAt.get(Number(start))?.judge(outcome);
    }
  }

  #extendObject({ poses, joints, ...rest }) {
    let object = this.objectById.get(rest.id);
    if (object === undefined) {
      object = { poses: new Track(), joints: new Map() };
      this.objects.push(object);
      this.objectById.set(rest.id, object);
    }
    Object.assign(object, rest);
    object.poses.extend(poses);
    extendTracks(object.joints, joints);
  }

  /** Add pictures, and drop the contents of the oldest of many. */
  #extendPictures({ pictures, contents, unpictured }) {
    this.unpictured += unpictured;
    for (const each of pictures) {
      const picture = { text: "", ...each, source: each.content === undefined ? null : contents[each.content] };
      if (!this.cameras.has(each.camera)) this.cameras.set(each.camera, []);
      this.cameras.get(each.camera).push(picture);
    }
    for (const each of this.cameras.values()) for (const old of each.slice(0, -PICTURES_MAX)) old.source = null;
  }

  /** Add attachments, and replace those that ended; an attachment begins with an event of its own. */
  #extendAttachments(attachments) {
    for (const each of attachments) {
      const index = this.attachments.findLastIndex((other) => other[3] === each[3]);
      if (index < 0) this.attachments.push(each);
      else this.attachments[index] = each;
    }
  }

  /** Seconds from the episode's start to an event. */
  secondsAt(event) {
    const index = Math.min(Math.max(Math.round(event), this.first), this.last) - this.first;
    return (this.times[index] ?? 0) / 1e6;
  }

  /** The last event at or before a moment in seconds. */
  eventAt(seconds) {
    return this.first + Math.max(0, lastUpTo(this.times, seconds * 1e6 + 0.5));
  }

  /** The nodes that run after an event: the path from the root to the current ones. */
  runningAt(event) {
    const running = [];
    const visit = (nodes) => {
      for (const each of nodes) {
        if (each.start > event) break;
        if (each.lastEvent > event || each.end === 0) {
          running.push(each);
          visit(each.children);
        } else if (each.end === event) running.push(each);
      }
    };
    visit(this.roots);
    return running;
  }

  /** The innermost action that runs after an event; its movements are drawn as paths. */
  actionAt(event) {
    const running = this.runningAt(event).filter((each) => each.kind === "action");
    return running.at(-1) ?? null;
  }

  presentAt(event) {
    return this.objects.filter((each) => each.id <= event && (each.removed === 0 || each.removed > event));
  }

  attachedAt(event) {
    return this.attachments.filter(([, , , from, to]) => from <= event && (to === 0 || to > event));
  }

  /** The unit of a sampled value of an object: of its pose, of a joint; empty if it has none or is not known. */
  unitOf(id, name) {
    if (/^base\.[xyz]$/.test(name)) return "m";
    const joints = this.models[this.objectById.get(id)?.model]?.joints ?? [];
    const type = joints.find(([joint]) => joint === name)?.[1];
    return { revolute: "rad", continuous: "rad", prismatic: "m" }[type] ?? "";
  }

  /** The objects that robots hold after an event, and with what: `{ robot, object, by }`. */
  heldAt(event) {
    return this.attachedAt(event).flatMap(([parent, child, link]) => {
      const [robot, object] = [this.objectById.get(parent), this.objectById.get(child)];
      return robot?.type === "ROBOT" && object ? [{ robot, object, by: armOf(link) }] : [];
    });
  }

  nameOf(id) {
    return this.objectById.get(id)?.name ?? `object ${id}`;
  }
}

/** The arm to which a link belongs, as far as its name says so; else the link. */
export function armOf(link) {
  if (/(^|[_\-/ ])(l|left)([_\-/ ]|$)/i.test(link)) return "left arm";
  return /(^|[_\-/ ])(r|right)([_\-/ ]|$)/i.test(link) ? "right arm" : link;
}

export class Node {
  #outcome = null; // a part of the document has none, because the tables decide it

  constructor(episode, start, parent, kind, type) {
    Object.assign(this, { episode, start, parent, kind, type, children: [], isRootFailure: false, holdsFailure: false });
    this.depth = parent === null ? 0 : parent.depth + 1;
    this.place = 1;
    this.name = type || kind;
  }

  became(end, status, reason, message, result) {
    Object.assign(this, { end, status, reason, message, result });
  }

  /** Parameters as pairs of name and value, as far as the page has them. */
  get pairs() {
    const lines = this.whole ? this.whole.split("\n") : this.parameters.split(/ (?=[\w.-]+=)/);
    return lines.filter(Boolean).map((line) => [line.split("=", 1)[0], line.slice(line.indexOf("=") + 1)]);
  }

  judge(outcome) {
    this.#outcome = outcome;
  }

  /** How the plan went on after the node had failed; null as long as it is not decided. */
  get outcome() {
    return this.#outcome === "open" ? null : this.#outcome;
  }

  get failed() {
    return FAILED.has(this.status) || this.status === "LOST";
  }

  /** The event that ended the node, or the last one so far. */
  get lastEvent() {
    return this.end || this.episode.last;
  }
}

/** How often a plan went on in each way after failures, as `recovered 2, ignored 1`; of those that are decided. */
export function outcomesText(failures) {
  const counts = new Map();
  for (const { outcome } of failures) if (outcome) counts.set(outcome, (counts.get(outcome) ?? 0) + 1);
  return [...counts].sort(([, one], [, other]) => other - one).map(([outcome, count]) => `${count} ${outcome}`).join(", ");
}

/** What differs among nodes that failed alike: the names, and for each node its values; of the node and of the action around it. */
export function differencesOf(nodes) {
  const rows = nodes.map((node) => {
    let action = node;
    while (action !== null && action.kind !== "action") action = action.parent;
    const around = action === null || action === node ? [] : action.pairs.map(([name, value]) => [`${action.name} ${name}`, value]);
    const counted = [...node.message.slice(0, 500).matchAll(NUMBER)].map((each, index) => {
      const before = each.input.slice(0, each.index).match(/[^\s(),;:=\d.-]+(?=[^\w]*$)/)?.[0]; // the word before a number names it
      return [`${before ?? "number"} … ${index > 0 ? index + 1 : ""}`.trimEnd(), each[0]];
    });
    return new Map([["robot", node.robot], ...around, ...node.pairs, ...counted]);
  });
  const names = [...new Set(rows.flatMap((each) => [...each.keys()]))];
  const differing = names.filter((name) => new Set(rows.map((each) => each.get(name) ?? "")).size > 1);
  return { names: differing, rows: rows.map((each) => differing.map((name) => each.get(name) ?? "")) };
}

const NUMBER = /-?\d+(\.\d+)?(e-?\d+)?/g;

/** Failures by reason, the most frequent first, and in each the messages that differ in more than their numbers. */
export function failureGroups(failures) {
  const groups = new Map();
  for (const each of failures) {
    const reason = each.reason || each.status;
    if (!groups.has(reason)) groups.set(reason, { reason, failures: [], messages: new Map() });
    const { failures: all, messages } = groups.get(reason);
    all.push(each);
    const pattern = each.message.slice(0, 500).replace(NUMBER, "…");
    if (!messages.has(pattern)) messages.set(pattern, []);
    messages.get(pattern).push(each);
  }
  const byCount = (one, other) => other.length - one.length;
  return [...groups.values()]
    .map((each) => ({ ...each, messages: [...each.messages.values()].sort(byCount) }))
    .sort((one, other) => byCount(one.failures, other.failures));
}
