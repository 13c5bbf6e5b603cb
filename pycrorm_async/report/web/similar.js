// Shows the past actions most like one of the episode's: how they ended, what is alike, what differs.

import { signOf } from "./episode.js";
import { element, recorded } from "./dom.js";

/** The elements of a node, for the nearest action around it; `link` makes a button that leads to a node, or null. */
export function similarTo(inner, similar, link) {
  let node = inner;
  while (node !== null && node.kind !== "action") node = node.parent;
  if (node === null || similar === null) return [];
  const title = element("h2", {}, "Earlier actions most like ", node === inner ? "it" : recorded(node.name));
  if (similar.fault) return [title, element("p", { class: "quiet" }, `The cases cannot be read: ${similar.fault}`)];
  const entry = similar.nodes[node.start];
  if (entry !== undefined) return [title, summaryOf(entry), ...entry.cases.map((each) => caseOf(each, similar, node.episode.number, link))];
  const compared = Object.keys(similar.nodes).length;
  if (compared === similar.actions) return [];
  const text = `This page compares ${compared} of its ${similar.actions} actions. For this one:`;
  const command = `pycrorm recall --like ${node.episode.number}/${node.start} --why`;
  return [title, element("p", { class: "quiet" }, text, " ", element("code", {}, command))];
}

function summaryOf({ success, reasons, cases }) {
  if (cases.length === 0) return element("p", { class: "quiet" }, "No action like it ended earlier.");
  if (!success) return element("p", { class: "quiet" }, "None of them ran to its end.");
  return element("p", { class: "quiet" }, recorded(`Among the most alike, ${success}${reasons && `; reasons: ${reasons}`}.`));
}

function caseOf([episode, event, score, status, reason, started, alike, differs], similar, number, link) {
  const name = episode === number ? `e${event}` : `episode ${episode}, e${event}`;
  const page = similar.pages[episode];
  const place = episode === number ? link(event) ?? name : page ? element("a", { href: `${page}#e${event}` }, name) : name;
  const listed = (texts) => recorded(texts.map((each) => similar.texts[each]).join("; "));
  return element(
    "div",
    { class: `similar is-${status.toLowerCase()}` },
    element("p", {}, element("span", { class: "sign" }, signOf(status)), ` ${status} `, reason && recorded(reason, { class: "reason" }),
      ` ${Math.round(score * 100)} % alike · `, place, ` · ${started}`),
    differs.length > 0 ? element("p", {}, "differs: ", listed(differs)) : null,
    alike.length > 0 ? element("p", { class: "quiet" }, "alike: ", listed(alike)) : null,
  );
}
