// Shows where runs of one plan part: their task trees as one, at each node how many runs ended in which way, and each run.

import { element, recorded, replaceIn } from "./dom.js";
import { signOf } from "./episode.js";

const COLUMNS_MAX = 24;
const LINKS_MAX = 12;
const LISTED_MAX = 1000;
const INDENT_PX = 14;
const INDENTS_MAX = 12;

const part = (name) => document.getElementById(name);
const NOT_STARTED = "not started";
const statusOf = (outcome) => outcome.split(" ", 1)[0];
const classOf = (outcome) => (outcome === NOT_STARTED ? "" : `is-${statusOf(outcome).toLowerCase()}`);
const signOfOutcome = (outcome) => (outcome === NOT_STARTED ? "–" : signOf(statusOf(outcome)));
const pathOf = (row) => (row.parent === null ? row.name : `${pathOf(row.parent)} > ${row.name}`);

class Runs {
  constructor({ runs, outcomes, nodes, left }) {
    Object.assign(this, { runs, left, all: false });
    const around = [];
    this.rows = nodes.map(([depth, name, first, ways], number) => {
      const row = { number, depth, name, first: first === 1, parent: around[depth - 1] ?? null, holds: false };
      row.ways = ways.map(([outcome, ...members]) => ({ outcome: outcomes[outcome], members: pairsOf(members) }));
      around[depth] = row;
      if (row.ways.length > 1) for (let each = row; each !== null && !each.holds; each = each.parent) each.holds = true;
      return row;
    });
    this.parted = this.rows.filter(({ ways }) => ways.length > 1);
    const good = runs.filter(({ status }) => status === "SUCCEEDED").length;
    const first = this.rows.find((each) => each.first);
    const facts = [element("span", {}, `${good} of ${runs.length} runs succeeded`)];
    if (first !== undefined) facts.push(element("span", {}, "they part first at ", recorded(pathOf(first))));
    part("facts").replaceChildren(...facts);
    this.#draw();
    this.#list();
  }

  #draw() {
    const listed = this.rows.filter(({ holds }) => holds || this.all);
    const shown = listed.slice(0, LISTED_MAX);
    const toggle = element("button", { type: "button", "data-key": "all", "aria-pressed": String(this.all), onclick: () => this.#toggle() }, this.all ? "only where they part" : "all nodes");
    this.columns = this.runs.length > COLUMNS_MAX ? [] : this.runs;
    const columns = this.columns.map((each) => element("th", { scope: "col", class: "run", title: `${each.status}, ${each.took}, ${each.description}` }, this.#link(each, 0, String(each.number))));
    const heads = ["node", "ended"].map((each) => element("th", { scope: "col" }, each));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads, ...columns)), element("tbody", {}, ...shown.map((each) => this.#row(each))));
    const count = this.rows.length + this.left;
    const hidden = listed.length - shown.length + (this.all ? this.left : 0);
    const content = shown.length > 0 ? table : element("p", { class: "quiet" }, "All runs ended alike at every node.");
    replaceIn(part("nodes"), element("h2", {}, `At ${this.parted.length} of ${count} nodes they part `, toggle), content, hidden > 0 ? element("p", { class: "quiet" }, `${hidden} more nodes`) : "");
  }

  #toggle() {
    this.all = !this.all;
    this.#draw();
  }

  /** A link to the page of a run, at a node if its start is not 0; the text alone where it has no page. */
  #link({ page, number }, start, text, label = null) {
    if (!page) return element("span", { title: label }, text);
    return element("a", { href: `${page}${start > 0 ? `#n${start}` : ""}`, title: label, "aria-label": label ?? `episode ${number}` }, text);
  }

  #row(row) {
    const node = element("td", { class: "node" }, recorded(row.name, { class: "name" }), row.first ? element("span", { class: "mark is-presence" }, "they part here first") : null);
    node.style.paddingInlineStart = `${Math.min(row.depth, INDENTS_MAX) * INDENT_PX}px`;
    const cells = this.columns.map((run, index) => this.#cell(row, run, index));
    return element("tr", { class: row.first ? "lit" : null }, node, element("td", { class: "ways" }, ...this.#ways(row)), ...cells);
  }

  /** How many runs ended in each way, as a bar and in words, and the runs of all ways but the most frequent one. */
  #ways({ ways }) {
    const bar = element("span", { class: "shares", "aria-hidden": "true" });
    const words = ways.map(({ outcome, members }, index) => {
      const share = element("span", { class: classOf(outcome) });
      share.style.flexGrow = members.length;
      bar.append(share);
      const links = index === 0 ? [] : members.slice(0, LINKS_MAX).flatMap(([run, start]) => [" ", this.#link(this.runs[run], start, String(this.runs[run].number))]);
      const left = index === 0 ? 0 : members.length - LINKS_MAX;
      return element("span", { class: `way ${classOf(outcome)}` }, element("span", { class: "sign" }, signOfOutcome(outcome)), `${members.length} `, recorded(outcome), ...links, left > 0 ? ` and ${left} more` : null);
    });
    return [bar, ...words];
  }

  /** How one run ended at a node; empty where it has not even the node around it. */
  #cell(row, run, index) {
    const number = row.ways.findIndex(({ members }) => members.some(([each]) => each === index));
    if (number < 0) return element("td", {});
    const { outcome, members } = row.ways[number];
    const [, start] = members.find(([each]) => each === index);
    const link = this.#link(run, start, signOfOutcome(outcome), `episode ${run.number}: ${outcome}`);
    return element("td", { class: `run ${classOf(outcome)} ${number > 0 ? "otherwise" : ""}` }, element("span", { class: "sign" }, link));
  }

  /** The first node at which a run ended otherwise than most, and below which it did nowhere. */
  #firstOf(run) {
    let first = null;
    let inside = true; // the nodes that follow are below it
    for (const row of this.parted) {
      if (!row.ways.slice(1).some(({ members }) => members.some(([each]) => each === run))) continue;
      let around = row.parent;
      while (around !== null && around !== first) around = around.parent;
      inside = first === null || around === first;
      if (!inside) break;
      first = row;
    }
    return first;
  }

  #list() {
    const rows = this.runs.map((run, index) => {
      const first = this.#firstOf(index);
      const otherwise = first === null ? element("span", { class: "quiet" }, "nowhere") : recorded(pathOf(first));
      const status = element("td", { class: `fixed is-${run.status.toLowerCase()}` }, element("span", { class: "sign" }, signOf(run.status)), ` ${run.status}`);
      const cells = [run.took, run.started].map((each) => element("td", { class: "fixed" }, each));
      return element("tr", {}, element("td", {}, this.#link(run, 0, String(run.number)), run.unreadable ? recorded(` ${run.unreadable}`, { class: "reason" }) : null), status, ...cells, element("td", {}, otherwise), element("td", {}, recorded(run.description)));
    });
    const heads = ["episode", "status", "took", "started (UTC)", "first otherwise than most", "description"].map((each) => element("th", { scope: "col" }, each));
    const table = element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows));
    part("runs").replaceChildren(element("h2", {}, "Runs"), table);
  }
}

const pairsOf = (flat) => Array.from({ length: flat.length / 2 }, (_, index) => [flat[2 * index], flat[2 * index + 1]]);

globalThis.pycrormRuns = new Runs(JSON.parse(part("document").textContent));
document.documentElement.dataset.ready = "yes";
