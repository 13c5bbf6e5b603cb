// Groups episodes by robot, plan, week or software version, with the success of each group, and compares two of them.

import { actionsOf, causesOf, differenceOf, secondsOf, triesOf } from "./counts.js";
import { duration, element, offer, recorded, replaceIn, svg } from "./dom.js";
import { FACETS } from "./filters.js";
import { interval95, rateText } from "./success.js";

const GROUPS_MAX = 60;
const TYPES_MAX = 15;
const COMPARED_CAUSES_MAX = 12;
const DAY_MS = 86_400_000;

const dates = new Map();

/** The text of a day, by the number of days since 1970: made once, because making it takes longer than all else. */
function dateOf(day) {
  if (!dates.has(day)) dates.set(day, new Date(day * DAY_MS).toISOString().slice(0, 10));
  return dates.get(day);
}

const dayOf = ({ started }) => dateOf(Math.floor((started * 1000) / DAY_MS));

/** The Monday of the week of an episode, UTC; day 0 was a Thursday. */
function weekOf({ started }) {
  const day = Math.floor((started * 1000) / DAY_MS);
  return dateOf(day - ((day + 3) % 7));
}

const IN_TIME = { week: (each) => [weekOf(each)], day: (each) => [dayOf(each)], version: FACETS.version };
const GROUPINGS = { ...FACETS, ...IN_TIME };
const NO_VALUE = "none";

/** Episodes by group: those of time and of versions in the order of time, others the largest first. */
function groupsOf(episodes, by) {
  const groups = new Map();
  for (const each of episodes) {
    const names = GROUPINGS[by](each);
    for (const name of names.length > 0 ? names : [NO_VALUE]) {
      const group = groups.get(name);
      if (group === undefined) groups.set(name, [each]);
      else group.push(each);
    }
  }
  const sorted = [...groups];
  if (by === "version") return sorted;
  return by in IN_TIME ? sorted.sort(([one], [other]) => (one < other ? -1 : 1)) : sorted.sort(([, one], [, other]) => other.length - one.length);
}

/** A share of successes as a point on a line from 0 to 100 %, and its interval around it. */
export function intervalPicture(good, tries) {
  const [wide, middle, edge] = [120, 7, 4];
  const at = (share) => edge + share * (wide - 2 * edge);
  const picture = svg("svg", { viewBox: `0 0 ${wide} 14`, class: "interval-line", role: "img", "aria-label": tries > 0 ? rateText(good, tries) : "no try" });
  picture.append(svg("line", { x1: at(0), x2: at(1), y1: middle, y2: middle, class: "axis" }));
  if (tries === 0) return picture;
  const [low, high] = interval95(good, tries);
  picture.append(svg("line", { x1: at(low), x2: at(high), y1: middle, y2: middle, class: "spread" }));
  picture.append(svg("circle", { cx: at(good / tries), cy: middle, r: 3.5 }), svg("title", {}, rateText(good, tries)));
  return picture;
}

export class Groups {
  constructor(holder, settings) {
    this.settings = settings;
    this.by = element("select", { "aria-label": "group by", oninput: () => settings.set({ by: this.by.value, vs: [] }) });
    this.of = element("select", { "aria-label": "success of", oninput: () => settings.set({ of: this.of.value }) });
    this.measure = element("span", {}, " success of ", this.of);
    this.content = element("div", {});
    holder.append(element("h2", {}, "Groups ", this.by, this.measure), this.content);
  }

  show(episodes) {
    const { settings } = this;
    const by = Object.hasOwn(GROUPINGS, settings.get("by")) ? settings.get("by") : "";
    const kinds = Object.keys(GROUPINGS).filter((each) => each === by || each in IN_TIME || episodes.some((other) => GROUPINGS[each](other).length > 0));
    offer(this.by, [["", "no groups"], ...kinds.map((each) => [each, `by ${each}`])]);
    this.by.value = by;
    this.measure.hidden = by === "";
    if (by === "") return this.content.replaceChildren();
    const types = [...actionsOf(episodes).keys()];
    const type = settings.get("of");
    if (type && !types.includes(type)) types.push(type);
    offer(this.of, [["", "episodes"], ...types.map((each) => [each, each])]);
    this.of.value = type;
    const groups = groupsOf(episodes, by);
    const shown = by in IN_TIME ? groups.slice(-GROUPS_MAX) : groups.slice(0, GROUPS_MAX);
    const chosen = settings.values.getAll("vs");
    const rows = shown.map(([name, members]) => this.#row(by, name, members, type, chosen));
    const took = type === "" ? "median time" : "mean time";
    const titles = ["", by, "episodes", type === "" ? "succeeded" : "succeeded, of tries", took];
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...titles.map((each) => (each === "" ? element("td") : element("th", { scope: "col" }, each))))), element("tbody", {}, ...rows));
    const left = groups.length - shown.length;
    const notes = [left > 0 ? `${left} other groups. ` : "", chosen.length < 2 ? "Mark two groups to compare them." : ""].join("");
    const compared = chosen.length === 2 ? comparison(chosen.map((name) => [name, new Map(groups).get(name) ?? []])) : [];
    return replaceIn(this.content, table, element("p", { class: "quiet" }, notes), ...compared);
  }

  #row(by, name, members, type, chosen) {
    const [good, tries] = triesOf(members, type);
    const seconds = secondsOf(members, type);
    const mark = element("input", { type: "checkbox", "data-key": `compare ${name}`, "aria-label": `compare ${name}` });
    mark.checked = chosen.includes(name);
    mark.addEventListener("input", () => {
      const others = chosen.filter((each) => each !== name);
      this.settings.set({ vs: mark.checked ? [...others.slice(-1), name] : others });
    });
    const filter = by === "week" ? { from: name, to: lastDayOf(name) } : by === "day" ? { from: name, to: name } : { [by]: name };
    const only = element("button", { type: "button", class: "link", title: "show only these", onclick: () => this.settings.set({ ...filter, vs: [] }) }, recorded(name));
    return element(
      "tr",
      {},
      element("td", {}, mark),
      element("td", {}, name === NO_VALUE ? element("span", { class: "quiet" }, "none") : only),
      element("td", { class: "number" }, String(members.length)),
      element("td", { class: "fixed" }, tries > 0 ? rateText(good, tries) : "–", intervalPicture(good, tries)),
      element("td", { class: "number" }, seconds === null ? "" : duration(seconds)),
    );
  }
}

const lastDayOf = (monday) => new Date(Date.parse(`${monday}T00:00Z`) + 6 * DAY_MS).toISOString().slice(0, 10);

/** Two groups side by side: success and time of the episodes and of each type of action, and how often each cause was met. */
function comparison([[name, one], [otherName, other]]) {
  const sides = [new Set(one), new Set(other)];
  const all = [...new Set([...one, ...other])];
  const types = ["", ...[...actionsOf(all).keys()].slice(0, TYPES_MAX)];
  const rows = types.map((type) => {
    const tries = [one, other].map((each) => triesOf(each, type));
    const seconds = [one, other].map((each) => secondsOf(each, type));
    const cells = tries.map(([good, count], index) => element("td", { class: "fixed" }, count > 0 ? `${percentOf(good / count)} of ${count}` : "–", element("span", { class: "quiet" }, seconds[index] === null ? "" : `, ${duration(seconds[index])}`)));
    return element("tr", {}, element("td", {}, type === "" ? "episodes" : recorded(type)), ...cells, differenceCell(differenceOf(...tries)));
  });
  const causes = causesOf(all).slice(0, COMPARED_CAUSES_MAX).map((cause) => {
    const shares = sides.map((members) => [cause.at.filter(([episode]) => members.has(episode)).length, members.size]);
    const cells = shares.map(([count, size]) => element("td", { class: "fixed" }, size > 0 ? `${percentOf(count / size)} of ${size}` : "–"));
    return element("tr", {}, element("td", { class: "named" }, recorded(cause.name, { class: "reason" })), ...cells, differenceCell(differenceOf(...shares), -1));
  });
  const heads = (title) => element("thead", {}, element("tr", {}, ...[title, recorded(name), recorded(otherName), "difference"].map((each) => element("th", { scope: "col" }, each))));
  const note = "The difference is that of the second to the first, with its 95 % interval; it is bold where that leaves out 0. Times are the median of episodes and the mean of actions.";
  return [
    element("h3", {}, recorded(name), " beside ", recorded(otherName)),
    element("div", { class: "scrolled", tabindex: 0 }, element("table", {}, heads("succeeded"), element("tbody", {}, ...rows), causes.length > 0 ? heads("episodes that failed by") : null, element("tbody", {}, ...causes))),
    element("p", { class: "quiet" }, note),
  ];
}

const percentOf = (rate) => `${Math.round(rate * 100)} %`;

/** A difference in percentage points; `better` is -1 where less is better. */
function differenceCell(difference, better = 1) {
  if (difference === null) return element("td", {});
  const [value, low, high] = difference.map((each) => Math.round(each * 100));
  const clear = difference[1] > 0 || difference[2] < 0;
  const signed = (each) => (each > 0 ? `+${each}` : String(each));
  const classes = clear ? (value * better > 0 ? "fixed better" : "fixed worse") : "fixed quiet";
  return element("td", { class: classes }, `${signed(value)} (${signed(low)} to ${signed(high)})`);
}
