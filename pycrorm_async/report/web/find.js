// Finds nodes by what is typed: words in any of their texts, or `type:`, `object:`, `robot:`, `status:`, `reason:` and `text:`.

import { element, recorded } from "./dom.js";

const TEXTS = {
  type: (node) => node.name,
  object: (node) => node.parameters.replace(/(^| )\S+?=/g, " "), // the values, without the names of the parameters
  robot: (node) => node.robot,
  status: (node) => node.status,
  reason: (node) => node.reason,
  text: (node) => [node.parameters, node.whole, node.message, node.result].join("\n"),
};
const ALL = Object.values(TEXTS);
const TERM = /(?:(\w+):)?(?:"([^"]*)"?|(\S+))/g;

/** A test of a node: every term must be in one of the node's texts, in the one of its field if it names one. */
export function testOf(query) {
  const terms = [...query.toLowerCase().matchAll(TERM)].map(([whole, field, quoted, word]) => {
    const known = Object.hasOwn(TEXTS, field ?? "");
    return { texts: known ? [TEXTS[field]] : ALL, wanted: known || field === undefined ? (quoted ?? word) : whole };
  });
  return (node) => terms.every(({ texts, wanted }) => texts.some((text) => text(node).toLowerCase().includes(wanted)));
}

/** The field above the tree. `onQuery` gets the query as it is typed, `onStep` 1 or -1 for the next or the last match. */
export class Find {
  constructor(holder, { onQuery, onStep, onLeave }) {
    const hint = "words, or type: object: robot: status: reason: text:";
    this.field = element("input", { type: "search", placeholder: "find (/)", title: hint, "aria-label": `find nodes: ${hint}`, spellcheck: "false" });
    this.count = element("output", { class: "quiet", "aria-live": "polite" });
    this.field.addEventListener("input", () => onQuery(this.field.value));
    this.field.addEventListener("keydown", (pressed) => {
      pressed.stopPropagation();
      if (pressed.key === "Enter") onStep(pressed.shiftKey ? -1 : 1);
      else if (pressed.key === "ArrowDown" || (pressed.key === "Escape" && this.field.value === "")) onLeave();
      else return;
      pressed.preventDefault();
    });
    holder.append(this.field, this.count);
  }

  /** Show a query and how many nodes match it; null without a query. */
  show(query, matches) {
    if (this.field.value !== query) this.field.value = query;
    this.count.replaceChildren(...(matches === null ? [] : [recorded(matches === 1 ? "1 node" : `${matches} nodes`)]));
  }

  focus() {
    this.field.focus();
    this.field.select();
  }
}
