// Keeps in the address of the page which episodes are chosen, and shows it as a row of controls above them.

import { causeName } from "./counts.js";
import { element, offer, plain, recorded } from "./dom.js";

const OPTIONS_MAX = 200;
const DAY_S = 86_400;
const SINCE = "since:";

/** The values of an episode by which it can be chosen or grouped, by the name of the control. */
export const FACETS = {
  status: ({ status }) => [status],
  robot: ({ robots }) => robots ?? [],
  plan: ({ plan }) => (plan ? [plan] : []),
  tag: ({ tags }) => tags ?? [],
  object: ({ objects }) => objects ?? [],
  version: ({ commit }) => (commit ? [commit] : []),
};

/** The settings in the part of the address behind `#`; the page is drawn again when they change, also by going back. */
export class Settings {
  constructor(onChange) {
    this.onChange = onChange;
    this.read = () => (this.values = new URLSearchParams(location.hash.slice(1)));
    this.read();
    addEventListener("hashchange", () => {
      this.read();
      onChange();
    });
  }

  get(name) {
    return this.values.get(name) ?? "";
  }

  /** Change settings; an empty one is left out, a list is kept as several of one name. */
  set(changes) {
    for (const [name, value] of Object.entries(changes)) {
      this.values.delete(name);
      for (const each of [value].flat()) if (each !== "" && each !== null) this.values.append(name, each);
    }
    history.replaceState(null, "", this.text === "" ? `${location.pathname}${location.search}` : `#${this.text}`);
    this.onChange();
  }

  get text() {
    return this.values.toString();
  }

  /** The address of an episode's page at an event; the page links back to the same settings. */
  addressOf(page, event = null) {
    const back = this.text === "" ? "" : `?list=${encodeURIComponent(this.text)}`;
    return `${page}${back}${event === null ? "" : `#e${event}`}`;
  }
}

export class Filters {
  constructor(holder, settings) {
    Object.assign(this, { holder, settings, controls: new Map() });
    this.#add("text", element("input", { type: "search", placeholder: "text", "aria-label": "words in description, plan or tag" }));
    for (const name of Object.keys(FACETS)) this.#add(name, element("select", { "aria-label": name }));
    for (const name of ["from", "to"]) this.#add(name, element("input", { type: "date", "aria-label": `started ${name} this day on (UTC)` }), name);
    this.cause = element("button", { type: "button", class: "chip", onclick: () => settings.set({ cause: "" }) });
    this.clear = element("button", { type: "button", onclick: () => settings.set(Object.fromEntries([...this.controls.keys(), "cause"].map((each) => [each, ""]))) }, "show all");
    holder.append(this.cause, this.clear);
  }

  #add(name, control, label = "") {
    control.addEventListener("input", () => this.settings.set({ [name]: control.value }));
    this.controls.set(name, control);
    this.holder.append(label ? element("label", {}, `${label} `, control) : control);
  }

  /** Offer the values that the episodes have; `show` chooses one. */
  offer(episodes) {
    for (const [name, valuesOf] of Object.entries(FACETS)) {
      const counts = new Map();
      for (const each of episodes) for (const value of valuesOf(each)) counts.set(value, (counts.get(value) ?? 0) + 1);
      const sorted = name === "version" ? [...counts].reverse() : [...counts].sort(([, one], [, other]) => other - one);
      const values = sorted.slice(0, OPTIONS_MAX).map(([value]) => [value, value]);
      if (name === "version") values.push(...values.map(([value]) => [`${SINCE}${value}`, `since ${value}`]));
      const control = this.controls.get(name);
      offer(control, [["", `any ${name}`], ...values]);
      control.hidden = values.length === 0;
    }
  }

  /** Put the settings into the controls; a value that no episode has is offered too, so that it can be seen and left. */
  show() {
    let chosen = this.settings.get("cause") !== "";
    for (const [name, control] of this.controls) {
      const value = this.settings.get(name);
      chosen ||= value !== "";
      if (control.tagName === "SELECT") {
        if (![...control.options].some((each) => each.value === value)) control.append(element("option", { value }, plain(value)));
        control.hidden &&= value === "";
        control.classList.toggle("chosen", value !== "");
      }
      if (control.value !== value) control.value = value;
    }
    this.clear.hidden = !chosen;
    this.cause.hidden = this.settings.get("cause") === "";
    this.cause.replaceChildren("failed by ", recorded(this.settings.get("cause")), " ✕");
  }

  /** The episodes that fulfil all conditions. */
  chosen(episodes) {
    const { settings } = this;
    const words = settings.get("text").toLowerCase().split(/\s+/).filter(Boolean);
    const [from, to] = ["from", "to"].map((name) => Date.parse(`${settings.get(name)}T00:00Z`) / 1000);
    const version = settings.get("version");
    const since = version.startsWith(SINCE) ? episodes.find(({ commit }) => commit === version.slice(SINCE.length))?.started ?? Infinity : null;
    const facets = Object.entries(FACETS).map(([name, valuesOf]) => [settings.get(name), valuesOf]).filter(([value]) => value !== "" && (since === null || value !== version));
    const cause = settings.get("cause");
    return episodes.filter(
      (each) =>
        facets.every(([value, valuesOf]) => valuesOf(each).includes(value)) &&
        (since === null || each.started >= since) &&
        !(each.started < from) && !(each.started >= to + DAY_S) &&
        (cause === "" || each.causes.some((other) => causeName(other) === cause)) &&
        (words.length === 0 || words.every((word) => searchedText(each).includes(word))),
    );
  }
}

function searchedText(episode) {
  episode.searched ??= [episode.number, episode.description, episode.plan ?? "", ...(episode.tags ?? [])].join(" ").toLowerCase();
  return episode.searched;
}
