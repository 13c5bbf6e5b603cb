// Shows the task tree as a list of rows, of which only those in sight are elements: a tree may have 100,000 nodes.

import { signOf } from "./episode.js";
import { HUES, duration, element, plain, recorded } from "./dom.js";

const ROW_PX = 26;
const OPEN_MAX = 300;
const PRINTED_MAX = 2000;
const HINT_MAX = 600;

export class TreeView {
  constructor(holder, episode, { onSelect }) {
    this.holder = holder;
    this.episode = episode;
    this.onSelect = onSelect;
    this.open = new Set();
    this.passing = new Set();
    this.size = 0;
    this.selected = null;
    this.found = null; // the nodes that a search matches, and the way to each; null without a search
    this.event = episode.opens;
    this.spacer = element("div", { class: "rows", role: "presentation" });
    holder.append(this.spacer);
    holder.addEventListener("scroll", () => this.#draw());
    holder.addEventListener("keydown", (pressed) => this.#press(pressed));
    holder.addEventListener("focus", () => this.#bringIntoSight(this.#current()));
    new ResizeObserver(() => this.#draw()).observe(holder);
    this.#openAtFailures();
    this.#list();
  }

  /** Open all of a small tree; of a large one the ways to the first failures, or the first level. */
  #openAtFailures() {
    const { nodes, roots } = this.episode;
    this.size = nodes.length;
    if (nodes.length <= OPEN_MAX) {
      for (const each of nodes) this.open.add(each);
      return;
    }
    for (const each of roots) this.open.add(each);
    let rows = 0;
    for (const failure of this.episode.rootFailures) {
      for (let each = failure.parent; each !== null && !this.open.has(each); each = each.parent) {
        this.open.add(each);
        rows += each.children.length;
      }
      if (rows > OPEN_MAX) break;
    }
  }

  /** Take in the nodes that the episode has by now; `show` draws them. */
  grow() {
    const { nodes } = this.episode;
    if (this.found !== null) this.filter(this.found.test);
    if (nodes.length <= OPEN_MAX) for (const each of nodes.slice(this.size)) this.open.add(each);
    this.size = nodes.length;
    this.#list();
  }

  /** Open the running nodes of a large tree as long as they run; `show` draws them. */
  follow(running) {
    if (running.length === this.passing.size && running.every((each) => this.passing.has(each))) return;
    this.passing = new Set(running);
    if (this.size > OPEN_MAX) this.#list();
  }

  /** List the nodes that a test matches and the ways to them, or all with null; return the matches. */
  filter(test) {
    this.found = null;
    if (test !== null) {
      const matches = this.episode.nodes.filter(test);
      const ways = new Set();
      for (const each of matches) for (let above = each.parent; above !== null && !ways.has(above); above = above.parent) ways.add(above);
      this.found = { test, matches: new Set(matches), ways, open: new Set(ways) };
    }
    this.#list();
    this.#draw();
    return this.found?.matches ?? null;
  }

  /** The match that follows a node, or comes before it with a step of -1. */
  matchBeside(node, step) {
    const matches = [...(this.found?.matches ?? [])];
    const index = matches.findLastIndex((each) => each.start <= (node?.start ?? 0));
    const next = step > 0 ? index + 1 : index - (matches[index] === node ? 1 : 0);
    return matches.at(next < matches.length ? next : 0);
  }

  #isOpen(node) {
    return this.found === null ? this.open.has(node) || this.passing.has(node) : this.found.open.has(node);
  }

  #list() {
    this.rows = [];
    const { found } = this;
    const isListed = (node) => found === null || found.matches.has(node) || found.ways.has(node);
    const visit = (node, whole) => {
      if (!whole && !isListed(node)) return;
      this.rows.push({ node });
      if (node.isRootFailure && node.message) this.rows.push({ node, message: true });
      const all = whole || (found !== null && !found.ways.has(node)); // what is below a match, once it is opened
      if (this.#isOpen(node)) for (const each of node.children) visit(each, all);
    };
    for (const each of this.episode.roots) visit(each, false);
    this.rowOf = new Map();
    this.rows.forEach(({ node, message }, index) => message || this.rowOf.set(node, index));
  }

  /** Light the nodes of the moment after an event, and bring the innermost into sight. */
  show(event, running, { selected = null } = {}) {
    Object.assign(this, { event, selected });
    this.printing = false;
    this.running = new Set(running);
    this.innermost = running.filter((each) => this.rowOf.has(each)).at(-1) ?? null;
    if (selected === null && this.innermost !== null) this.#bringIntoSight(this.innermost);
    this.#draw();
  }

  /** The node that the keys start from: the selected one, the innermost of the moment, or the first. */
  #current() {
    return [this.selected, this.innermost].find((each) => this.rowOf.has(each)) ?? this.rows[0]?.node ?? null;
  }

  reveal(node) {
    for (let each = node.parent; each !== null; each = each.parent) (this.found ?? this).open.add(each);
    this.#list();
    this.#bringIntoSight(node);
    this.#draw();
  }

  #bringIntoSight(node) {
    if (node === null || !this.rowOf.has(node)) return;
    const top = this.rowOf.get(node) * ROW_PX;
    const { scrollTop, clientHeight } = this.holder;
    if (top < scrollTop || top + 2 * ROW_PX > scrollTop + clientHeight) {
      this.holder.scrollTop = top - clientHeight / 3;
    }
  }

  #press(pressed) {
    const node = this.#current();
    if (node === null || pressed.ctrlKey || pressed.metaKey || pressed.altKey) return;
    const actions = {
      ArrowDown: () => this.#beside(node, 1),
      ArrowUp: () => this.#beside(node, -1),
      ArrowRight: () => (this.#isOpen(node) ? node.children[0] : node.children.length > 0 && this.#toggle(node, true)),
      ArrowLeft: () => (this.#isOpen(node) && node.children.length > 0 ? this.#toggle(node, false) : node.parent),
      Enter: () => node,
    };
    const action = actions[pressed.key];
    if (action === undefined) return;
    const next = action();
    if (next) this.#choose(next);
    pressed.preventDefault();
    pressed.stopPropagation();
  }

  /** The node of the row below or above; undefined at the ends. */
  #beside(node, step) {
    let next = this.rowOf.get(node) + step;
    while (this.rows[next]?.message) next += step;
    return this.rows[next]?.node;
  }

  #choose(node) {
    this.#bringIntoSight(node);
    this.onSelect(node);
  }

  #toggle(node, open = !this.#isOpen(node)) {
    this.passing.delete(node);
    const listed = (this.found ?? this).open;
    if (open) listed.add(node);
    else listed.delete(node);
    this.#list();
    this.#draw();
  }

  /** Make all rows elements for print, up to a bound. */
  drawForPrint() {
    this.printing = true;
    this.spacer.replaceChildren(...this.rows.slice(0, PRINTED_MAX).map((row) => this.#rowOf(row)));
    const left = this.rows.length - PRINTED_MAX;
    if (left > 0) this.spacer.append(element("div", { class: "row" }, `… ${left} more rows`));
    this.spacer.style.height = "auto";
  }

  #draw() {
    if (this.printing) return;
    const { scrollTop, clientHeight } = this.holder;
    const from = Math.max(0, Math.floor(scrollTop / ROW_PX) - 4);
    const to = Math.min(this.rows.length, from + Math.ceil(clientHeight / ROW_PX) + 8);
    this.spacer.style.height = `${this.rows.length * ROW_PX}px`;
    const drawn = this.rows.slice(from, to).map((row, index) => {
      const made = this.#rowOf(row);
      made.style.position = "absolute";
      made.style.top = `${(from + index) * ROW_PX}px`;
      return made;
    });
    this.spacer.replaceChildren(...drawn);
    const current = this.#current();
    if (current !== null) this.holder.setAttribute("aria-activedescendant", `n${current.start}`);
  }

  #rowOf({ node, message }) {
    const made = message ? this.#messageOf(node) : this.#nodeRow(node);
    made.style.paddingInlineStart = `${8 + Math.min(node.depth, 12) * 14 + (message ? 34 : 0)}px`;
    made.addEventListener("click", () => this.onSelect(node));
    return made;
  }

  /** The robot that acts, where there are several: a spot of its colour, and its name where it begins to act. */
  #robotOf(node) {
    const { robots } = this.episode;
    if (robots.length < 2 || !node.robot) return null;
    const name = node.robot === node.parent?.robot ? null : recorded(node.robot);
    return element("span", { class: `robot hue-${robots.indexOf(node.robot) % HUES}` }, name);
  }

  #messageOf(node) {
    const classes = node.start > this.event ? "row message later" : "row message";
    const made = element("div", { class: classes, "aria-hidden": "true", title: node.message.slice(0, HINT_MAX) });
    made.append(recorded(node.message.slice(0, 300)));
    return made;
  }

  #nodeRow(node) {
    const open = this.#isOpen(node);
    const classes = ["row", `is-${node.status.toLowerCase()}`];
    if (this.running?.has(node)) classes.push("lit");
    if (node.start > this.event) classes.push("later");
    if (node === this.selected) classes.push("selected");
    if (this.found?.matches.has(node)) classes.push("match");
    const toggle = element("span", { class: "toggle", "aria-hidden": "true" }, node.children.length === 0 ? "" : open ? "▾" : "▸");
    if (node.children.length > 0) {
      toggle.addEventListener("click", (clicked) => {
        clicked.stopPropagation();
        this.#toggle(node);
      });
    }
    const hidden = !open && node.children.length > 0 ? element("span", { class: "count" }, `${node.children.length}`) : null;
    const inside = !open && node.holdsFailure && !node.failed ? element("span", { class: "count bad" }, "✗ inside") : null;
    const took = node.end ? duration(this.episode.secondsAt(node.end) - this.episode.secondsAt(node.start)) : "";
    const spoken = (text) => (text ? element("span", { class: "spoken" }, `, ${plain(text.slice(0, HINT_MAX))} `) : null);
    return element(
      "div",
      {
        class: classes.join(" "),
        role: "treeitem",
        id: `n${node.start}`,
        title: [node.name, node.robot && `by ${node.robot}`, node.parameters].filter(Boolean).join(" ").slice(0, HINT_MAX),
        "aria-posinset": node.place,
        "aria-setsize": (node.parent?.children ?? this.episode.roots).length,
        "aria-level": node.depth + 1,
        "aria-expanded": node.children.length > 0 ? String(open) : null,
        "aria-selected": String(node === this.selected),
      },
      toggle,
      element("span", { class: "sign", title: node.status, "aria-hidden": "true" }, signOf(node.status)),
      recorded(node.name, { class: "name" }),
      spoken(node.status),
      this.#robotOf(node),
      hidden,
      inside,
      node.reason ? recorded(node.reason, { class: "reason" }) : null,
      element("span", { class: "parameters" }, recorded(node.parameters.slice(0, 200))),
      spoken(node.isRootFailure && node.message),
      spoken(took && "took"),
      element("span", { class: "took" }, took),
    );
  }
}
