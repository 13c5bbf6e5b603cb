// Shows what belongs to a node or to the moment: details, failures by reason, percepts, observations, states.

import { armOf, differencesOf, failureGroups, lastUpTo, outcomesText, signOf } from "./episode.js";
import { duration, element, recorded, replaceIn } from "./dom.js";
import { similarTo } from "./similar.js";

const LISTED_MAX = 200;
const MESSAGES_MAX = 5;
const LINKS_MAX = 12;
const VALUE_MAX = 60;
const [LONG, LINES_OF_LONG] = [400, 10];
const CONTENT = /\{"\$blob":"[^"]*","media_type":"([^"]*)","size":(\d+)[^{}]*\}/g;

const listOf = (facts) => element("dl", {}, ...facts.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));

/** A text that may be long; the keys reach one that may scroll. */
const long = (text) => ({ class: "long", tabindex: text.length > LONG || text.split("\n").length > LINES_OF_LONG ? 0 : null });

const unsigned = (text) => (Number(text) === 0 ? text.replace("-", "") : text);

/** The angle about the vertical axis of an orientation, in degrees. */
const yawOf = ([x, y, z, w]) => (Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) * 180) / Math.PI;

export class Panels {
  constructor(holder, episode, { onSeek, onSelect, onChoose, similar, curves }) {
    Object.assign(this, { holder, episode, onSeek, onSelect, onChoose, similar, curves, chosen: null });
    this.bar = element("div", { class: "tabs", role: "tablist" });
    this.body = element("div", { class: "panel", id: "panel", role: "tabpanel", tabindex: 0 });
    this.bar.addEventListener("keydown", (pressed) => this.#press(pressed));
    holder.append(this.bar, this.body);
    this.current = episode.rootFailures.length > 0 ? "failures" : "details";
    this.#drawBar();
  }

  get tabs() {
    const { rootFailures, objects, detections, observations, attachments, samples, series } = this.episode;
    const curves = [...samples.values()].reduce((sum, each) => sum + each.size, series.size);
    return [
      ["details", "Details", null, () => this.#details()],
      ["failures", "Failures", rootFailures.length, () => this.#failures()],
      ["objects", "Objects", objects.length, () => this.#objects()],
      ["detections", "Percepts", detections.length, () => this.#detections()],
      ["attachments", "Attachments", attachments.length, () => this.#attachments()],
      ["observations", "Observations", observations.length, () => this.#observations()],
      ["states", "Curves", curves, () => this.curves.figures()],
    ].filter(([name, , count]) => count === null || count > 0 || name === "failures");
  }

  /** Show the counts of what the episode has by now; `show` draws the panel. */
  grow() {
    const counts = this.tabs.map(([name, , count]) => `${name} ${count}`).join();
    if (counts !== this.counts) this.#drawBar();
    this.counts = counts;
  }

  #drawBar() {
    const tabs = this.tabs.map(([name, title, count]) => {
      const selected = name === this.current;
      const attributes = { type: "button", role: "tab", id: `tab-${name}`, "data-key": name, "aria-selected": String(selected) };
      const behaviour = { tabindex: selected ? 0 : -1, "aria-controls": "panel", onclick: () => this.open(name) };
      const number = count === null ? null : element("span", { class: "count" }, String(count));
      return element("button", { ...attributes, ...behaviour }, title, number);
    });
    replaceIn(this.bar, ...tabs);
    this.body.setAttribute("aria-labelledby", `tab-${this.current}`);
  }

  /** Open the tab beside the focused one. */
  #press(pressed) {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[pressed.key];
    if (step === undefined) return;
    const names = this.tabs.map(([name]) => name);
    this.open(names[(names.indexOf(this.current) + step + names.length) % names.length]);
    this.bar.querySelector("[aria-selected=true]").focus();
    pressed.preventDefault();
    pressed.stopPropagation();
  }

  open(name) {
    this.current = name;
    this.#drawBar();
    this.body.scrollTop = 0;
    this.#draw();
  }

  /** Mark an object in the list of objects, or none. */
  choose(object) {
    this.chosen = object;
  }

  show(event, selected, running) {
    Object.assign(this, { event, selected, running });
    this.#draw();
  }

  /** Draw the curves again, if they are shown: other ones are chosen, or another part of the axis is drawn. */
  redrawCurves() {
    cancelAnimationFrame(this.drawing);
    if (this.current === "states") this.drawing = requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    cancelAnimationFrame(this.drawing);
    if (this.event === undefined) return;
    const [, , , content] = this.tabs.find(([name]) => name === this.current);
    replaceIn(this.body, ...content());
  }

  /** Draw all panels below one another, for print. */
  drawForPrint() {
    const parts = this.tabs.flatMap(([, title, , content]) => [element("h2", { class: "printed" }, title), ...content()]);
    this.body.replaceChildren(...parts);
  }

  #moment(event) {
    return element("button", { type: "button", class: "moment", onclick: () => this.onSeek(event) }, `e${event}`);
  }

  #node(start) {
    const node = this.episode.nodeAt.get(start);
    if (node === undefined) return null;
    return element("button", { type: "button", class: "moment", onclick: () => this.onSelect(node) }, recorded(node.name));
  }

  #details() {
    const node = this.selected ?? this.running.at(-1);
    const { episode } = this;
    if (node === undefined) return [element("p", { class: "quiet" }, "No node runs at this moment."), ...this.#episodeFacts()];
    const facts = [
      ["status", element("span", {}, `${signOf(node.status)} ${node.status}`)],
      ["events", element("span", {}, this.#moment(node.start), node.end ? " to " : " on", node.end ? this.#moment(node.end) : null)],
      ["took", this.#took(node)],
      ["robot", node.robot ? recorded(node.robot) : null],
      ["parameters", node.parameters ? this.#parameters(node) : null],
      ["result", node.result ? recorded(node.result, long(node.result)) : null],
      ["reason", node.reason ? recorded(node.reason) : null],
      ["then", node.outcome],
      ["message", node.message ? recorded(node.message, long(node.message)) : null],
      ["part of", node.parent ? this.#node(node.parent.start) : null],
    ].filter(([, value]) => value !== null);
    const list = listOf(facts);
    const places = episode.locations.filter((each) => each.node === node.start).slice(0, LISTED_MAX);
    const chosen = places.map((each) => {
      const counted = (title, counts) => {
        const listed = Object.entries(counts).map(([reason, count]) => `${count} ${reason}`).join(", ");
        return listed ? `; ${title}: ${listed}` : "";
      };
      const offered = `${each.location}: ${each.offered} of ${each.considered} places offered`;
      const text = offered + counted("refused", each.refused) + counted("not considered", each.excluded);
      return element("p", {}, this.#moment(each.at), " ", recorded(text));
    });
    const whole = node.parent === null ? this.#episodeFacts() : [];
    const alike = similarTo(node, this.similar, (start) => this.#node(start));
    const copy = element("button", { type: "button", class: "copy", onclick: () => this.#copy(node, copy) }, "copy link");
    return [element("h2", {}, recorded(node.name), " ", copy), list, ...chosen, ...alike, ...whole];
  }

  #parameters(node) {
    const rows = node.pairs.map(([name, value]) => element("tr", {}, element("th", { scope: "row" }, recorded(name)), element("td", {}, recorded(value, long(value)))));
    return element("table", {}, element("tbody", {}, ...rows));
  }

  /** Put the address of a node on the clipboard; a browser that does not let a page do so shows it instead. */
  async #copy(node, button) {
    const address = `${location.href.split("#")[0]}#n${node.start}`;
    try {
      await navigator.clipboard.writeText(address);
      button.textContent = "copied";
    } catch {
      button.replaceWith(element("input", { class: "copy", readonly: "", value: address, "aria-label": "link to this node" }));
    }
  }

  /** What was recorded about the episode as a whole. */
  #episodeFacts() {
    const { id, plan, created_by, host, software, metadata } = this.episode;
    const recordedBy = [created_by, host].filter(Boolean).join(" on ");
    const facts = Object.entries({ id, plan, "recorded by": recordedBy, software, ...metadata });
    const shown = facts.filter(([, value]) => value).map(([name, value]) => [recorded(name), recorded(value)]);
    return [element("h2", {}, "Episode"), listOf(shown)];
  }

  #took({ start, end, status }) {
    const { episode } = this;
    if (!end && status !== "RUNNING") return "unknown";
    const seconds = episode.secondsAt(end || episode.last) - episode.secondsAt(start);
    return end ? duration(seconds) : `${duration(seconds)} so far`;
  }

  #failures() {
    const { rootFailures, failure } = this.episode;
    if (rootFailures.length === 0) {
      return [element("p", { class: "quiet" }, failure ? `${failure.reason}: ${failure.message}` : "Nothing failed.")];
    }
    return failureGroups(rootFailures).map(({ reason, failures, messages }) => {
      const shown = messages.slice(0, MESSAGES_MAX).flatMap((alike) => {
        const links = alike.slice(0, LINKS_MAX).map((each) => this.#nodeMoment(each));
        const left = alike.length > LINKS_MAX ? ` and ${alike.length - LINKS_MAX} like it` : "";
        const text = element("p", long(alike[0].message), recorded(alike[0].message));
        if (alike.length === 1) return [text, element("p", {}, ...links)];
        return [text, this.#compared(alike.slice(0, LINKS_MAX), links), left ? element("p", {}, left) : null];
      });
      const others = messages.length - MESSAGES_MAX;
      const then = outcomesText(failures);
      return element(
        "div",
        { class: "failure" },
        element("p", {}, element("strong", {}, `✗ ${failures.length} × `), recorded(reason, { class: "reason" })),
        then ? element("p", { class: "quiet" }, then) : null,
        ...shown,
        others > 0 ? element("p", { class: "quiet" }, `${others} other messages`) : null,
      );
    });
  }

  /** Failures that are alike, each with what differs among them. */
  #compared(nodes, links) {
    const { names, rows } = differencesOf(nodes);
    if (names.length === 0) return element("p", {}, ...links, element("span", { class: "quiet" }, " no parameter differs"));
    const cell = (value) => element("td", {}, recorded(value.length > VALUE_MAX ? `${value.slice(0, VALUE_MAX)}…` : value));
    const heads = ["failed", ...names].map((each) => element("th", { scope: "col" }, recorded(each)));
    const listed = rows.map((row, index) => element("tr", {}, element("td", {}, links[index]), ...row.map(cell)));
    return element("table", { class: "compared" }, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...listed));
  }

  #nodeMoment(node) {
    const made = element("button", { type: "button", class: "moment", onclick: () => this.onSelect(node) });
    made.append(recorded(node.name), ` e${node.end || node.start}`);
    return made;
  }

  /** The entries around the moment, at most `LISTED_MAX`; those after it are pale. */
  #around(entries, row, unlisted = 0) {
    const here = lastUpTo(entries.map((each) => each.at), this.event);
    const from = Math.max(0, Math.min(here - LISTED_MAX / 2, entries.length - LISTED_MAX));
    const listed = entries.slice(from, from + LISTED_MAX);
    const rows = listed.map((each) => {
      const made = row(each);
      if (each.at > this.event) made.classList.add("later");
      return made;
    });
    const left = entries.length - listed.length + unlisted;
    return left > 0 ? [...rows, element("p", { class: "quiet" }, `${left} others are not listed here.`)] : rows;
  }

  #detections() {
    return this.#around(this.episode.detections, ({ at, source, type, seen, node }) => {
      const percepts = seen.map(([name, kind, [x, y, z], visible]) => {
        const share = visible === null ? "" : `, ${Math.round(visible * 100)} % visible`;
        return `${name} (${kind}) at (${x}, ${y}, ${z})${share}`;
      });
      const what = percepts.length > 0 ? percepts.join("; ") : "nothing seen";
      return element("p", {}, this.#moment(at), ` ${source.replace("_", " ")} `, type ? `looked for ${type}: ` : "", recorded(what), " ", this.#node(node));
    }, this.episode.unlisted.detections);
  }

  /** The objects of the moment: where each is, which way it looks, and what it moves with. */
  #objects() {
    const { episode, event } = this;
    const present = episode.presentAt(event);
    if (present.length === 0) return [element("p", { class: "quiet" }, "No object is in the world at this moment.")];
    const attached = episode.attachedAt(event);
    const heads = ["object", "type", "x (m)", "y (m)", "z (m)", "heading (°)", "attached to"].map((each) => element("th", { scope: "col" }, each));
    const rows = present.slice(0, LISTED_MAX).map((object) => {
      const [x, y, z, ...orientation] = object.poses.valueAt(event);
      const numbers = [x.toFixed(3), y.toFixed(3), z.toFixed(3), yawOf(orientation).toFixed(0)].map((each) => element("td", { class: "number" }, unsigned(each)));
      const parents = attached.filter(([, child]) => child === object.id).map(([parent, , link]) => episode.nameOf(parent) + (link ? `, ${armOf(link)}` : ""));
      const chosen = object === this.chosen;
      const name = element("button", { type: "button", class: "moment", "aria-pressed": String(chosen), onclick: () => this.onChoose(chosen ? null : object) }, recorded(object.name));
      return element("tr", { class: chosen ? "lit" : null }, element("td", {}, name), element("td", {}, object.type), ...numbers, element("td", {}, recorded(parents.join(", "))));
    });
    const left = present.length - rows.length;
    const note = left > 0 ? [element("p", { class: "quiet" }, `${left} more objects are not listed.`)] : [];
    return [element("table", {}, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows)), ...note];
  }

  #attachments() {
    const { episode } = this;
    const entries = episode.attachments.map(([parent, child, link, at, to]) => ({ parent, child, link, at, to }));
    return this.#around(entries, ({ parent, child, link, at, to }) => {
      const held = at <= this.event && (to === 0 || to > this.event);
      const text = ` ${episode.nameOf(child)} moved with ${episode.nameOf(parent)}${[armOf(link), link].filter((each, index, both) => each && both.indexOf(each) === index).map((each) => `, ${each}`).join("")}`;
      const until = to ? element("span", {}, " until ", this.#moment(to)) : " to the end";
      return element("p", { class: held ? "lit" : "" }, this.#moment(at), recorded(text), until, held ? " ◂ now" : "");
    });
  }

  #observations() {
    const row = ({ at, name, values, node }) =>
      element("p", {}, this.#moment(at), " ", recorded(name, { class: "name" }), " ", recorded(values.replace(CONTENT, "$1 of $2 bytes")), " ", this.#node(node));
    return this.#around(this.episode.observations, row, this.episode.unlisted.observations);
  }
}
