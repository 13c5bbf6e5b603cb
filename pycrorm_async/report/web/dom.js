// Makes elements. Text is only ever set as text, never as markup, because everything shown was recorded by programs.

const READ = new Set(["title", "aria-label"]);

/** Text for a place that has no direction of its own, as a hint or a canvas: control characters are visible signs there, line ends apart. */
export const plain = (text) =>
  String(text).replace(/[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]/gu, (each) => {
    const code = each.codePointAt(0);
    return code < 0x20 ? String.fromCodePoint(0x2400 + code) : `<U+${code.toString(16).toUpperCase().padStart(4, "0")}>`;
  });

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== null && value !== undefined && value !== false) made.setAttribute(name, READ.has(name) ? plain(value) : value);
  }
  made.append(...children.filter((each) => each !== null && each !== undefined));
  return made;
}

/** Recorded text in an element of its own direction, so that right-to-left text does not reorder its surroundings. */
export const recorded = (text, attributes = {}) => element("bdi", attributes, plain(text));

/** Replace what is in a holder; a focused control keeps the focus if the new content has it too, else the holder gets it. */
export function replaceIn(holder, ...children) {
  const keyOf = (control) => control.dataset.key ?? control.textContent;
  const focused = holder.contains(document.activeElement) && holder !== document.activeElement ? keyOf(document.activeElement) : null;
  holder.replaceChildren(...children);
  if (focused === null) return;
  const same = [...holder.querySelectorAll("button, a, [data-key]")].find((each) => keyOf(each) === focused);
  (same ?? holder).focus({ preventScroll: true });
}

/** Offer values with their texts in a select; it is left alone if it offers them already, because it may be open. */
export function offer(select, values) {
  const key = JSON.stringify(values);
  if (select.dataset.offered === key) return;
  select.dataset.offered = key;
  select.replaceChildren(...values.map(([value, text]) => element("option", { value }, plain(text).slice(0, 60))));
}

const SVG = "http://www.w3.org/2000/svg";

export function svg(tag, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

/** The dashes of a line of SVG, from their lengths in widths of the line. */
export const strokeOf = (dash, width) => (dash === null ? "none" : dash.map((each) => each * width).join(" "));

export function duration(seconds) {
  if (seconds >= 100) return `${seconds.toFixed(0)} s`;
  if (seconds >= 1) return `${seconds.toFixed(2)} s`;
  if (seconds >= 1e-3) return `${(seconds * 1e3).toFixed(1)} ms`;
  return `${(seconds * 1e6).toFixed(0)} µs`;
}

/** The address of the overview with the settings that it had when it led to this page. */
export function backTo(overview) {
  const settings = new URLSearchParams(location.search).get("list");
  return settings ? `${overview}#${settings}` : overview;
}

/** The colours for robots and types; further ones have those of the first again. */
export const HUES = 6;

export const colorOf = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
