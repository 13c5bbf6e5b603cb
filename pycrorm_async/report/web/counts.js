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

/** The episodes that ended, and of which it is known how. */
export const ended = (episodes) => episodes.filter(({ status }) => status !== "RUNNING" && status !== "UNKNOWN");

/** Successes and tries of episodes; of the actions of one type in them, if it is given. */
export function triesOf(episodes, type = "") {
  if (type === "") {
    const all = ended(episodes);
    return [all.filter(({ status }) => status === "SUCCEEDED").length, all.length];
  }
  const sum = [0, 0];
  for (const { actions } of episodes) {
    for (const [name, [good, tries]] of actions) {
      if (name !== type) continue;
      sum[0] += good;
      sum[1] += tries;
    }
  }
  return sum;
}

/** The median duration of episodes in seconds, or the mean one of the actions of a type in them; null without any. */
export function secondsOf(episodes, type = "") {
  if (type === "") return shareOf(episodes.map(({ seconds }) => seconds), 0.5);
  const [count, seconds] = actionsOf(episodes).get(type)?.slice(2) ?? [0, 0];
  return count > 0 ? seconds / count : null;
}

/** The number below which a share of these numbers is; 0.5 is the median. */
export function shareOf(numbers, share) {
  const sorted = Float64Array.from(numbers.filter((each) => each !== null)).sort(); // four times as fast as of an array
  return sorted.length === 0 ? null : sorted[Math.floor((sorted.length - 1) * share + 0.5)];
}

/** Successes, tries, ended ones and their seconds of the actions, by type, the most frequent first. */
export function actionsOf(episodes) {
  const sums = new Map();
  for (const { actions } of episodes) {
    for (const [type, counts] of actions) {
      const sum = sums.get(type);
      if (sum === undefined) sums.set(type, [...counts]);
      else counts.forEach((count, index) => (sum[index] += count));
    }
  }
  return new Map([...sums].sort(([, one], [, other]) => other[1] - one[1]));
}

export const causeName = ([reason, type, object]) => [reason, type, object].filter(Boolean).join(CAUSE_SEPARATOR);

/** The causes of failures by name, the most frequent first: count, counts by outcome, and [episode, event] of each first one. */
export function causesOf(episodes) {
  const causes = new Map();
  for (const episode of episodes) {
    for (const cause of episode.causes) {
      const [reason, type, object, outcome, count, event] = cause;
      const name = causeName(cause);
      if (!causes.has(name)) causes.set(name, { name, reason, type, object, count: 0, outcomes: new Map(), at: [] });
      const sum = causes.get(name);
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
