// Shows many episodes: how often they succeed and for how long, why they fail, and a table that leads to their pages.

import { duration, element, recorded, replaceIn, svg } from "./dom.js";
import { signOf } from "./episode.js";
import { interval95, rateText, successMap } from "./success.js";

const BINS_MAX = 12;
const REASONS_MAX = 20;
const ACTIONS_MAX = 20;
const ROWS_MAX = 2000;

const part = (name) => document.getElementById(name);
/** The episodes that ended, and of which it is known how. */
const ended = (episodes) => episodes.filter((each) => each.status !== "RUNNING" && each.status !== "UNKNOWN");
const succeeded = (episodes) => ended(episodes).filter((each) => each.status === "SUCCEEDED").length;
const rateOf = (episodes) => (ended(episodes).length === 0 ? null : succeeded(episodes) / ended(episodes).length);
const percent = (rate) => `${(rate * 100).toFixed(0)} %`;

/** Add up counts by name, the greatest first. */
function sumsOf(maps) {
  const sums = new Map();
  for (const map of maps) for (const [name, count] of Object.entries(map)) sums.set(name, (sums.get(name) ?? 0) + count);
  return [...sums].sort(([, one], [, other]) => other - one);
}

function median(numbers) {
  const sorted = numbers.filter((each) => each !== null).sort((one, other) => one - other);
  return sorted.length === 0 ? null : sorted[Math.floor(sorted.length / 2)];
}

/** The episodes in their order, in parts of equal size. */
function binsOf(episodes) {
  const count = Math.min(BINS_MAX, episodes.length);
  const edge = (index) => Math.round((index * episodes.length) / count);
  return Array.from({ length: count }, (_, index) => episodes.slice(edge(index), edge(index + 1)));
}

/** Bars from 0 to `most`, each with the text of its value below it; a rate of [good, tries] has its interval. */
function bars(values, most, label, textOf, rates = []) {
  const [wide, high] = [40, 60];
  const picture = svg("svg", { viewBox: `0 0 ${values.length * wide} ${high + 16}`, class: "bars", role: "img", "aria-label": label });
  values.forEach((value, index) => {
    const height = most > 0 ? ((value ?? 0) / most) * high : 0;
    picture.append(svg("rect", { x: index * wide + 3, y: high - height, width: wide - 6, height: Math.max(height, 0.5) }));
    const text = svg("text", { x: index * wide + wide / 2, y: high + 12, "text-anchor": "middle", "font-size": 11 });
    text.textContent = value === null ? "–" : textOf(value);
    picture.append(text);
    if (rates[index]?.[1] > 0) {
      const [low, up] = interval95(...rates[index]).map((each) => high - each * high);
      const middle = index * wide + wide / 2;
      picture.append(svg("line", { x1: middle, x2: middle, y1: low, y2: up, class: "interval" }, svg("title", {}, rateText(...rates[index]))));
    }
  });
  return picture;
}

/** The heading of a view, and the maps over its columns. */
function mapsOf(of, tables) {
  const { succeeded, rows } = tables[0];
  const name = of === "PickUpWithContextView" ? "Pick-ups" : of;
  const axes = tables.map(({ x, y }) => `${x.name} and ${y.name}`).join(", and by ");
  const title = element("h2", {}, recorded(name), `: ${rateText(succeeded, rows)} succeeded`);
  const note = element("p", { class: "quiet" }, "The share of successes in per cent, by ", recorded(axes), ".");
  return [title, note, element("div", { class: "maps" }, ...tables.map(successMap))];
}

/** Says why an episode has no page. */
const unreadable = (reason) => element("p", { class: "reason" }, "✗ No page: ", recorded(reason));

/** How many actions failed in an episode that succeeded. */
function failedActions({ status, failed_actions: failed = 0 }) {
  if (status !== "SUCCEEDED" || failed === 0) return null;
  return element("span", { class: "quiet" }, `, ${failed} action${failed === 1 ? "" : "s"} failed`);
}

class Overview {
  constructor({ title, total, episodes, successes = [] }) {
    Object.assign(this, { title, total, episodes, by: "number", down: true });
    if (successes.length > 0) {
      const sources = [...new Set(successes.map(({ of }) => of))];
      const parts = sources.map((of) => mapsOf(of, successes.filter((each) => each.of === of)));
      part("success").replaceChildren(...parts.flat());
    }
    this.#draw();
  }

  /** Take in the entries of episodes that are new or have changed. */
  extend(...parts) {
    const entries = new Map(this.episodes.map((each) => [each.number, each]));
    for (const { episodes } of parts) for (const each of episodes) entries.set(each.number, each);
    this.total += entries.size - this.episodes.length;
    this.episodes = [...entries.values()].sort((one, other) => one.number - other.number);
    this.#draw();
  }

  #draw() {
    const { episodes, total } = this;
    const middle = median(episodes.map((each) => each.seconds));
    const facts = [
      `${episodes.length} episode${episodes.length === 1 ? "" : "s"}`,
      ended(episodes).length > 0 ? `${rateText(succeeded(episodes), ended(episodes).length)} succeeded` : null,
      middle === null ? null : `median ${duration(middle)}`,
      total > episodes.length ? `the newest of ${total}` : null,
    ];
    part("facts").replaceChildren(...facts.filter((each) => each !== null).map((each) => recorded(each)));
    this.bins = binsOf(episodes);
    this.#running();
    this.#trend();
    this.#actions();
    this.#reasons();
    this.#table();
  }

  /** What each running episode does now; a file has none, because it cannot follow them. */
  #running() {
    const running = this.episodes.filter((each) => each.status === "RUNNING" && each.now !== undefined);
    const rows = running.map((each) =>
      element(
        "li",
        {},
        element("a", { href: each.page }, recorded(each.robots.join(", ") || `episode ${each.number}`)),
        " ",
        recorded(each.description, { class: "quiet" }),
        element("ol", { class: "now" }, ...each.now.map((node) => element("li", {}, recorded(node)))),
        each.after ? element("p", { class: "after" }, "after ", recorded(each.after)) : null,
        element("span", { class: "quiet" }, `${each.nodes} nodes${each.failed ? `, ${each.failed} failed` : ""}`),
        each.unreadable ? element("p", { class: "reason" }, recorded(each.unreadable)) : null,
      ),
    );
    const content = rows.length > 0 ? [element("h2", {}, "Running now"), element("ul", { class: "running" }, ...rows)] : [];
    replaceIn(part("running"), ...content);
  }

  #trend() {
    const rates = this.bins.map(rateOf);
    if (rates.length < 2 || rates.every((each) => each === null)) return part("trend").replaceChildren();
    const counts = this.bins.map((bin) => [succeeded(bin), ended(bin).length]);
    const picture = bars(rates, 1, "share of successful episodes, the oldest first", percent, counts);
    return part("trend").replaceChildren(element("h2", {}, "Success, the oldest episodes first"), picture);
  }

  /** How often the actions of each type succeeded; an episode may succeed although some of them failed. */
  #actions() {
    const all = this.episodes.map(({ actions = {} }) => Object.entries(actions));
    const good = new Map(sumsOf(all.map((each) => Object.fromEntries(each.map(([type, [count]]) => [type, count])))));
    const tries = sumsOf(all.map((each) => Object.fromEntries(each.map(([type, [, count]]) => [type, count]))));
    const rows = tries.filter(([, count]) => count > 0).slice(0, ACTIONS_MAX).map(([type, count]) => {
      const failed = count - good.get(type);
      const cells = [element("td", { class: "named" }, recorded(type)), element("td", { class: "fixed" }, rateText(good.get(type), count))];
      return element("tr", {}, ...cells, element("td", { class: "number" }, failed > 0 ? `${failed} failed` : ""));
    });
    part("actions").replaceChildren(...(rows.length > 0 ? [element("h2", {}, "Success of actions"), element("table", {}, ...rows)] : []));
  }

  #reasons() {
    const sorted = sumsOf(this.episodes.map(({ reasons }) => reasons));
    const rows = sorted.slice(0, REASONS_MAX).map(([reason, count]) => {
      const trend = this.bins.map((bin) => bin.reduce((sum, each) => sum + (each.reasons[reason] ?? 0), 0));
      const picture = this.bins.length > 1 ? bars(trend, Math.max(...trend), `${reason} over time`, String) : "";
      const outcomes = sumsOf(this.episodes.map((each) => each.outcomes?.[reason] ?? {})).filter(([name]) => name !== "open");
      const after = element("span", { class: "quiet" }, outcomes.map(([name, number]) => ` ${number} ${name}`).join(","));
      const named = element("td", { class: "named" }, recorded(reason, { class: "reason" }), after);
      const cells = [element("td", { class: "number" }, String(count)), named];
      return element("tr", {}, ...cells, element("td", {}, picture));
    });
    const left = sorted.length - rows.length;
    const content = rows.length > 0 ? element("table", {}, ...rows) : element("p", { class: "quiet" }, "Nothing failed.");
    part("reasons").replaceChildren(element("h2", {}, "Failures by reason"), content);
    if (left > 0) part("reasons").append(element("p", { class: "quiet" }, `${left} other reasons`));
  }

  #table() {
    const robots = this.episodes.some((each) => each.robots?.length > 0) ? { robots: "robots" } : {};
    const columns = { number: "episode", started: "started (UTC)", status: "status", seconds: "took", nodes: "nodes", failed: "failed", ...robots, description: "description" };
    this.named = "robots" in columns;
    const heads = Object.entries(columns).map(([key, title]) => {
      const sign = this.by === key ? (this.down ? " ▾" : " ▴") : "";
      const sort = { type: "button", "data-key": key, onclick: () => this.#sortBy(key) };
      const order = this.by === key ? (this.down ? "descending" : "ascending") : null;
      return element("th", { scope: "col", "aria-sort": order }, element("button", sort, `${title}${sign}`));
    });
    const order = this.down ? -1 : 1;
    const sorted = this.episodes.slice().sort((one, other) => {
      const [a, b] = [one, other].map((each) => (Array.isArray(each[this.by]) ? each[this.by].join() : each[this.by] ?? -1));
      return (a < b ? -1 : a > b ? 1 : 0) * order;
    });
    const rows = sorted.slice(0, ROWS_MAX).map((each) => this.#row(each));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows));
    const left = sorted.length - rows.length;
    const note = left > 0 ? element("p", { class: "quiet" }, `${left} more episodes are counted above and not listed.`) : "";
    const missing = this.episodes.filter((each) => !each.page && !each.unreadable).map((each) => each.number);
    const command = element("code", {}, `pycrorm report ${missing.length > 0 ? Math.max(...missing) : ""}`);
    const text = `${missing.length} older episodes have no page here. One of them gets a page of its own by `;
    replaceIn(part("episodes"), element("h2", {}, "Episodes"), table, note, missing.length > 0 ? element("p", { class: "quiet" }, text, command) : "");
  }

  #row(each) {
    const name = String(each.number);
    return element(
      "tr",
      {},
      element("td", { class: "number" }, each.page ? element("a", { href: each.page }, name) : name, this.#missing(each)),
      element("td", { class: "fixed" }, each.started),
      element("td", { class: `fixed is-${each.status.toLowerCase()}` }, element("span", { class: "sign" }, signOf(each.status)), ` ${each.status}`, failedActions(each)),
      element("td", { class: "number" }, each.seconds === null ? "" : duration(each.seconds)),
      element("td", { class: "number", "data-name": "nodes" }, String(each.nodes)),
      element("td", { class: "number", "data-name": "failed" }, String(each.failed)),
      this.named ? element("td", {}, recorded((each.robots ?? []).join(", "))) : null,
      element("td", { class: "wide" }, recorded(each.description), each.unreadable ? unreadable(each.unreadable) : null),
    );
  }

  #missing({ page, unreadable: fault }) {
    return page || fault ? null : element("span", { class: "quiet" }, " no page");
  }

  #sortBy(key) {
    this.down = this.by === key ? !this.down : true;
    this.by = key;
    this.#table();
  }
}

globalThis.pycrormOverview = new Overview(JSON.parse(part("document").textContent));
document.documentElement.dataset.ready = "yes";
