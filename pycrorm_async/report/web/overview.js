// Shows many episodes: how often they succeed and for how long, why they fail, and a table that leads to their pages.

import { actionsOf, causesOf, entriesOf, shareOf, sortedSeconds, triesOf } from "./counts.js";
import { duration, element, recorded, replaceIn, svg } from "./dom.js";
import { signOf } from "./episode.js";
import { Filters, Settings } from "./filters.js";
import { Groups, intervalPicture } from "./groups.js";
import { interval95, rateText, successMap } from "./success.js";

const BINS_MAX = 12;
const CAUSES_MAX = 15;
const ACTIONS_MAX = 20;
const ROWS_AT_ONCE = 100; // with them a filter is drawn in 0.1 s
const LINKS_MAX = 3;
const PAUSE = 4; // times the time of the last drawing
const PAUSE_MAX_MS = 2000;
const SPREAD = 30; // from so many times the shortest duration on, the bars of durations grow by a factor

const part = (name) => document.getElementById(name);
const percent = (rate) => `${(rate * 100).toFixed(0)} %`;

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
    const entries = entriesOf(episodes);
    this.settings = new Settings(() => this.#draw());
    this.filters = new Filters(part("filters"), this.settings);
    this.groups = new Groups(part("groups"), this.settings);
    Object.assign(this, { title, total, episodes: entries, rows: ROWS_AT_ONCE });
    this.filters.offer(entries);
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
    for (const { episodes } of parts) for (const each of entriesOf(episodes)) entries.set(each.number, each);
    this.total += entries.size - this.episodes.length;
    this.episodes = [...entries.values()].sort((one, other) => one.number - other.number);
    this.filters.offer(this.episodes);
    if (this.waiting) return;
    this.waiting = true; // a long list must not keep the browser busy, whatever the rate of parts
    setTimeout(() => this.#draw(), Math.min(PAUSE * this.took, PAUSE_MAX_MS));
  }

  #draw() {
    const began = performance.now();
    this.waiting = false;
    const { episodes, total } = this;
    for (const name of ["filters", "groups"]) part(name).hidden = episodes.length === 0;
    this.filters.show();
    this.chosen = this.filters.chosen(episodes);
    const { chosen } = this;
    const [good, tries] = triesOf(chosen);
    this.seconds = sortedSeconds(chosen);
    const middle = shareOf(this.seconds, 0.5);
    const count = `${chosen.length} episode${chosen.length === 1 ? "" : "s"}`;
    const facts = [
      chosen.length < episodes.length ? `${count} of ${episodes.length}` : count,
      tries > 0 ? `${rateText(good, tries)} succeeded` : null,
      middle === null ? null : `median ${duration(middle)}`,
      total > episodes.length ? `the newest ${episodes.length} of ${total}` : null,
    ];
    part("facts").replaceChildren(...facts.filter((each) => each !== null).map((each) => recorded(each)));
    part("success").classList.toggle("later", chosen.length < episodes.length);
    this.bins = binsOf(chosen);
    this.#running();
    this.groups.show(chosen);
    this.#trend();
    this.#durations();
    this.#actions();
    this.#causes();
    this.#table();
    this.took = performance.now() - began;
  }

  /** What each running episode does now; a file has none, because it cannot follow them. */
  #running() {
    const running = this.chosen.filter((each) => each.status === "RUNNING" && each.now != null);
    const rows = running.map((each) =>
      element(
        "li",
        {},
        element("a", { href: this.settings.addressOf(each.page) }, recorded(each.robots.join(", ") || `episode ${each.number}`)),
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
    const counts = this.bins.map((bin) => triesOf(bin));
    const rates = counts.map(([good, tries]) => (tries > 0 ? good / tries : null));
    if (rates.length < 2 || rates.every((each) => each === null)) return part("trend").replaceChildren();
    const picture = bars(rates, 1, "share of successful episodes, the oldest first", percent, counts);
    return part("trend").replaceChildren(element("h2", {}, "Success, the oldest episodes first"), picture);
  }

  /** How many episodes took how long. */
  #durations() {
    const { seconds } = this;
    const [least, most] = [shareOf(seconds, 0), shareOf(seconds, 1)];
    if (seconds.length < 2 || least === most) return part("durations").replaceChildren();
    const scale = least > 0 && most > SPREAD * least ? Math.log : (each) => each;
    const bins = Array.from({ length: BINS_MAX }, () => 0);
    const width = (scale(most) - scale(least)) / BINS_MAX;
    for (const each of seconds) bins[Math.min(Math.floor((scale(each) - scale(least)) / width), BINS_MAX - 1)] += 1;
    const picture = bars(bins, Math.max(...bins), "number of episodes by duration, the shortest first", String);
    const text = `From ${duration(least)} to ${duration(most)}${scale === Math.log ? ", in equal factors" : ""}; nine of ten within ${duration(shareOf(seconds, 0.9))}.`;
    return part("durations").replaceChildren(element("h2", {}, "Durations"), picture, element("p", { class: "quiet" }, text));
  }

  /** How often the actions of each type succeeded; an episode may succeed although some of them failed. */
  #actions() {
    const types = [...actionsOf(this.chosen)].filter(([, [, tries]]) => tries > 0).slice(0, ACTIONS_MAX);
    const rows = types.map(([type, [good, tries, count, seconds]]) => {
      const name = element("button", { type: "button", class: "link", title: "group by its success", onclick: () => this.settings.set({ of: type, by: this.settings.get("by") || "week" }) }, recorded(type));
      const cells = [element("td", { class: "named" }, name), element("td", { class: "fixed" }, rateText(good, tries), intervalPicture(good, tries))];
      return element("tr", {}, ...cells, element("td", { class: "number", title: "mean time" }, count > 0 ? duration(seconds / count) : ""));
    });
    replaceIn(part("actions"), ...(rows.length > 0 ? [element("h2", {}, "Success of actions"), element("table", {}, ...rows)] : []));
  }

  /** Why actions failed, with links to the newest episodes in which they did. */
  #causes() {
    const causes = causesOf(this.chosen);
    this.bins.forEach((bin, index) => bin.forEach((each) => (each.bin = index)));
    const rows = causes.slice(0, CAUSES_MAX).map((cause) => {
      const trend = this.bins.map(() => 0);
      for (const [episode] of cause.at) trend[episode.bin] += 1;
      const picture = this.bins.length > 1 ? bars(trend, Math.max(...trend), `${cause.name}: episodes over time`, String) : "";
      const outcomes = [...cause.outcomes].filter(([name]) => name !== "open" && name !== "").sort(([, one], [, other]) => other - one);
      const after = element("span", { class: "quiet" }, outcomes.map(([name, number]) => ` ${number} ${name}`).join(","));
      const only = () => this.settings.set({ cause: cause.name });
      const name = element("button", { type: "button", class: "link reason", title: "show only these episodes", onclick: only }, recorded(cause.reason));
      const where = [cause.type && ` in ${cause.type}`, cause.object && ` with ${cause.object}`].filter(Boolean).map((each) => recorded(each));
      const newest = cause.at.filter(([{ page }]) => page).slice(-LINKS_MAX).reverse();
      const links = newest.flatMap(([{ number, page }, event]) => [" ", element("a", { href: this.settings.addressOf(page, event) }, `${number}`)]);
      const cells = [element("td", { class: "number" }, String(cause.count)), element("td", { class: "named" }, name, ...where, after, ...links)];
      return element("tr", {}, ...cells, element("td", {}, picture));
    });
    const left = causes.length - rows.length;
    const content = rows.length > 0 ? element("table", {}, ...rows) : element("p", { class: "quiet" }, "Nothing failed.");
    replaceIn(part("reasons"), element("h2", {}, "Failures by cause"), content, left > 0 ? element("p", { class: "quiet" }, `${left} other causes`) : "");
  }

  #table() {
    const by = this.settings.get("sort") || "number";
    const down = this.settings.get("up") === "";
    const robots = this.episodes.some((each) => each.robots?.length > 0) ? { robots: "robots" } : {};
    const columns = { number: "episode", started: "started (UTC)", status: "status", seconds: "took", nodes: "nodes", failed: "failed", ...robots, description: "description" };
    this.named = "robots" in columns;
    const heads = Object.entries(columns).map(([key, title]) => {
      const sign = by === key ? (down ? " ▾" : " ▴") : "";
      const sort = { type: "button", "data-key": key, onclick: () => this.settings.set({ sort: key, up: by === key && down ? "1" : "" }) };
      const order = by === key ? (down ? "descending" : "ascending") : null;
      return element("th", { scope: "col", "aria-sort": order }, element("button", sort, `${title}${sign}`));
    });
    const sorted = this.#sorted(by, down);
    const rows = sorted.slice(0, this.rows).map((each) => this.#row(each));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows));
    const left = sorted.length - rows.length;
    const more = element("button", { type: "button", onclick: () => this.#listMore() }, `list ${Math.min(left, this.rows)} more of ${left}`);
    const missing = this.chosen.filter((each) => !each.page && !each.unreadable).map((each) => each.number);
    const command = element("code", {}, `pycrorm report ${missing.length > 0 ? Math.max(...missing) : ""}`);
    const text = `${missing.length} older episodes have no page here. One of them gets a page of its own by `;
    const none = rows.length === 0 ? element("p", { class: "quiet" }, this.episodes.length > 0 ? "No episode fulfils all conditions." : "There is no episode yet.") : "";
    replaceIn(part("episodes"), element("h2", {}, "Episodes"), rows.length > 0 ? table : none, left > 0 ? more : "", missing.length > 0 ? element("p", { class: "quiet" }, text, command) : "");
  }

  /** The chosen episodes in the order of a column; they are in that of their numbers. */
  #sorted(by, down) {
    const { chosen } = this;
    if (by === "number") return down ? [...chosen].reverse() : chosen;
    const order = down ? -1 : 1;
    const valueOf = (each) => (Array.isArray(each[by]) ? each[by].join() : each[by] ?? -1);
    const keyed = chosen.map((each) => [valueOf(each), each]).sort(([one], [other]) => (one < other ? -1 : one > other ? 1 : 0) * order);
    return keyed.map(([, each]) => each);
  }

  #listMore() {
    this.rows *= 2;
    this.#table();
  }

  #row(each) {
    const name = String(each.number);
    const started = new Date(each.started * 1000).toISOString().replace("T", " ").slice(0, 19);
    const tags = (each.tags ?? []).map((tag) => recorded(tag, { class: "count" }));
    return element(
      "tr",
      {},
      element("td", { class: "number" }, each.page ? element("a", { href: this.settings.addressOf(each.page) }, name) : name, this.#missing(each)),
      element("td", { class: "fixed" }, started),
      element("td", { class: `fixed is-${each.status.toLowerCase()}` }, element("span", { class: "sign" }, signOf(each.status)), ` ${each.status}`, failedActions(each)),
      element("td", { class: "number" }, each.seconds === null ? "" : duration(each.seconds)),
      element("td", { class: "number", "data-name": "nodes" }, String(each.nodes)),
      element("td", { class: "number", "data-name": "failed" }, String(each.failed)),
      this.named ? element("td", {}, recorded((each.robots ?? []).join(", "))) : null,
      element("td", { class: "wide" }, recorded(each.description), ...tags, each.unreadable ? unreadable(each.unreadable) : null),
    );
  }

  #missing({ page, unreadable: fault }) {
    return page || fault ? null : element("span", { class: "quiet" }, " no page");
  }
}

globalThis.pycrormOverview = new Overview(JSON.parse(part("document").textContent));
document.documentElement.dataset.ready = "yes";
