// Reads the columns of many episodes, and counts what the episodes of any choice have: outcomes, actions, causes of failures.

import { interval95 } from "./success.js";

const CAUSE_SEPARATOR = " · ";

/** The entries of a document, whose columns have numbers in place of texts, or of a part of a live page, which has none. */
export function entriesOf(episodes) {
  if (Array.isArray(episodes)) return episodes.map((each) => ({ ...each, actions: Array.isArray(each.actions) ? each.actions : Object.entries(each.actions ?? {}) }));
  const { texts, ...columns } = episodes;
  const text = (value) => (value === null ? null : texts[value]);
  const list = (values) => (values ?? []).map(text);
  const pairs = (values) => Array.from({ length: (values ?? []).length / 2 }, (_, index) => [texts[values[2 * index]], values[2 * index + 1]]);
  const causes = (values) => (values ?? []).map((each) => [...each.slice(0, 4).map(text), ...each.slice(4)]);
  const read = { description: text, status: text, plan: text, commit: text, page: text, unreadable: text, after: text };
  Object.assign(read, { robots: list, tags: list, objects: list, now: list, actions: pairs, causes });
  const names = Object.keys(columns);
  return (columns.number ?? []).map((_, index) =>
    Object.fromEntries(
      names
        .filter((name) => columns[name][index] !== null || name === "seconds")
        .map((name) => [name, read[name] === undefined ? columns[name][index] : read[name](columns[name][index])]),
    ),
  );
}

/** Successes and tries of episodes that ended, and of which it is known how; of the actions of one type in them, if it is given. */
export function triesOf(episodes, type = "") {
  let [succeeded, all] = [0, 0];
  for (const { status, actions } of episodes) {
    if (type === "") {
      succeeded += status === "SUCCEEDED";
      all += status !== "RUNNING" && status !== "UNKNOWN";
    } else {
      for (const [name, [good, tries]] of actions) {
        if (name !== type) continue;
        succeeded += good;
        all += tries;
      }
    }
  }
  return [succeeded, all];
}

/** The median duration of episodes in seconds, or the mean one of the actions of a type in them; null without any. */
export function secondsOf(episodes, type = "") {
  if (type === "") return shareOf(sortedSeconds(episodes), 0.5);
  let [count, seconds] = [0, 0];
  for (const { actions } of episodes) {
    for (const [name, counts] of actions) {
      if (name !== type) continue;
      count += counts[2];
      seconds += counts[3];
    }
  }
  return count > 0 ? seconds / count : null;
}

/** The known durations of episodes in ascending order. */
export function sortedSeconds(episodes) {
  const seconds = [];
  for (const each of episodes) if (each.seconds !== null) seconds.push(each.seconds);
  return Float64Array.from(seconds).sort(); // four times as fast as of an array
}

/** The number below which a share of these sorted numbers is; 0.5 is the median. */
export function shareOf(sorted, share) {
  return sorted.length === 0 ? null : sorted[Math.floor((sorted.length - 1) * share + 0.5)];
}

const sumsOf = new WeakMap();

/** Successes, tries, ended ones and their seconds of the actions, by type, the most frequent first; once for each list of episodes. */
export function actionsOf(episodes) {
  if (sumsOf.has(episodes)) return sumsOf.get(episodes);
  const sums = new Map();
  for (const { actions } of episodes) {
    for (const [type, counts] of actions) {
      const sum = sums.get(type);
      if (sum === undefined) sums.set(type, [...counts]);
      else for (let index = 0; index < sum.length; index++) sum[index] += counts[index];
    }
  }
  const sorted = new Map([...sums].sort(([, one], [, other]) => other[1] - one[1]));
  sumsOf.set(episodes, sorted);
  return sorted;
}

/** The name of a cause, which keeps it: causes are counted again at each choice of episodes. */
export const causeName = (cause) => (cause.name ??= cause.slice(0, 3).filter(Boolean).join(CAUSE_SEPARATOR));

/** The causes of failures by name, the most frequent first: count, counts by outcome, and [episode, event] of each first one. */
export function causesOf(episodes) {
  const causes = new Map();
  for (const episode of episodes) {
    for (const cause of episode.causes) {
      const [reason, type, object, outcome, count, event] = cause;
      const name = causeName(cause);
      let sum = causes.get(name);
      if (sum === undefined) causes.set(name, (sum = { name, reason, type, object, count: 0, outcomes: new Map(), at: [] }));
      sum.count += count;
      sum.outcomes.set(outcome, (sum.outcomes.get(outcome) ?? 0) + count);
      if (sum.at.at(-1)?.[0] !== episode) sum.at.push([episode, event]);
    }
  }
  return [...causes.values()].sort((one, other) => other.count - one.count);
}

/** How much greater the second share is than the first, with its 95 % interval by Newcombe's score; null without tries. */
export function differenceOf([good, tries], [otherGood, otherTries]) {
  if (tries === 0 || otherTries === 0) return null;
  const [rate, other] = [good / tries, otherGood / otherTries];
  const [low, high] = interval95(good, tries);
  const [otherLow, otherHigh] = interval95(otherGood, otherTries);
  const difference = other - rate;
  return [difference, difference - Math.hypot(other - otherLow, high - rate), difference + Math.hypot(otherHigh - other, rate - low)];
}
