// Reads the document of `episode_data.py` into nodes, objects and tracks, and answers questions about one event.

export const FAILED = new Set(["FAILED", "ERROR"]);
const END = { SUCCEEDED: "✓", FAILED: "✗", ERROR: "✗", RUNNING: "▶", LOST: "?", CANCELLED: "⊘", INTERRUPTED: "⊘" };

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

/** How one value changed: `valueAt(event)` is the value after that event. */
export class Track {
  constructor([at, values]) {
    this.at = sums(at);
    this.values = values;
  }

  valueAt(event) {
    return this.values[Math.max(0, lastUpTo(this.at, event))];
  }
}

const tracksOf = (columns) => new Map(Object.entries(columns).map(([name, each]) => [name, new Track(each)]));

export class Episode {
  constructor(document) {
    Object.assign(this, document.episode);
    this.times = sums(document.times);
    this.nodes = nodesOf(document);
    this.models = document.models;
    this.objects = document.objects.map((each) => ({
      ...each,
      poses: new Track(each.poses),
      joints: tracksOf(each.joints),
    }));
    this.objectById = new Map(this.objects.map((each) => [each.id, each]));
    this.attachments = document.attachments;
    this.detections = document.detections;
    this.observations = document.observations;
    this.locations = document.locations;
    this.series = tracksOf(document.series);
    this.samples = Object.entries(document.samples).map(([id, each]) => [Number(id), tracksOf(each)]);
    this.nodeAt = new Map(this.nodes.map((each) => [each.start, each]));
    this.rootFailures = this.nodes.filter((each) => each.isRootFailure);
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
    visit(this.nodes.filter((each) => each.parent === null));
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

  nameOf(id) {
    return this.objectById.get(id)?.name ?? `object ${id}`;
  }
}

function nodesOf({ nodes: columns, texts, episode }) {
  const [starts, ends, parents, kinds, types, parameters, statuses, reasons, messages] = columns;
  const byStart = new Map();
  const nodes = starts.map((start, index) => {
    const parent = byStart.get(parents[index]) ?? null;
    const node = {
      index,
      start,
      end: ends[index],
      lastEvent: ends[index] || episode.last,
      parent,
      depth: parent === null ? 0 : parent.depth + 1,
      children: [],
      kind: texts[kinds[index]],
      type: texts[types[index]],
      parameters: texts[parameters[index]],
      status: texts[statuses[index]],
      reason: texts[reasons[index]],
      message: texts[messages[index]],
    };
    node.name = node.type || (node.kind === "root" ? "plan" : node.kind);
    node.failed = FAILED.has(node.status) || node.status === "LOST";
    byStart.set(start, node);
    parent?.children.push(node);
    return node;
  });
  for (const node of nodes) {
    node.isRootFailure = node.failed && !node.children.some((each) => each.failed);
    node.holdsFailure = node.failed;
  }
  for (let index = nodes.length - 1; index >= 0; index--) {
    const { parent, holdsFailure } = nodes[index];
    if (parent !== null && holdsFailure) parent.holdsFailure = true;
  }
  return nodes;
}

/** Failures by reason, the most frequent first, and in each the messages that differ in more than their numbers. */
export function failureGroups(failures) {
  const groups = new Map();
  for (const each of failures) {
    const reason = each.reason || each.status;
    if (!groups.has(reason)) groups.set(reason, { reason, failures: [], messages: new Map() });
    const { failures: all, messages } = groups.get(reason);
    all.push(each);
    const pattern = each.message.slice(0, 500).replace(/-?\d+(\.\d+)?(e-?\d+)?/g, "…");
    if (!messages.has(pattern)) messages.set(pattern, []);
    messages.get(pattern).push(each);
  }
  const byCount = (one, other) => other.length - one.length;
  return [...groups.values()]
    .map((each) => ({ ...each, messages: [...each.messages.values()].sort(byCount) }))
    .sort((one, other) => byCount(one.failures, other.failures));
}
