// Shows what was observed: pictures along the time axis, the latest of each camera beside the scene, one in full size.

import { lastUpTo } from "./episode.js";
import { element, recorded } from "./dom.js";

const ROWS_MAX = 2;
const THUMB_PX = 56;
const GAP_PX = 4;
const SHOWN_MAX = 4;

export class SeenView {
  /** `strip` is below the chart, `inset` beside the scene; `xOf` is the place of an event on the time axis, in pixels. */
  constructor({ strip, inset, dialog }, episode, { xOf, onSeek }) {
    Object.assign(this, { strip, inset, dialog, episode, xOf, onSeek });
    dialog.addEventListener("keydown", (pressed) => this.#press(pressed));
    dialog.addEventListener("click", (clicked) => clicked.target === dialog && dialog.close());
  }

  get #cameras() {
    return [...this.episode.cameras].filter(([, pictures]) => pictures.some((each) => each.kind !== "points"));
  }

  /** Place the pictures below the chart, as many as fit without covering each other. */
  drawStrip() {
    const width = this.strip.clientWidth;
    this.buttons = [];
    const rows = this.#cameras.slice(0, ROWS_MAX).map(([camera, pictures]) => {
      let free = 0;
      const row = element("div", { class: "seen-row" });
      for (const picture of pictures) {
        const left = this.xOf(picture.at) - THUMB_PX / 2;
        if (left < free || left + THUMB_PX > width || picture.source === null) continue;
        free = left + THUMB_PX + GAP_PX;
        const name = `${camera} at event ${picture.at}`;
        const button = element("button", { type: "button", title: name, "aria-label": name, onclick: () => this.#choose(picture) }, imageOf(picture));
        button.style.left = `${left}px`;
        this.buttons.push([picture, button]);
        row.append(button);
      }
      row.append(recorded(camera));
      return row;
    });
    const others = this.#cameras.length - rows.length;
    if (others > 0) rows.push(element("p", { class: "quiet" }, `${others} more cameras: see Observations`));
    const left = this.episode.unpictured;
    if (left > 0) rows.push(element("p", { class: "quiet" }, `${left} more pictures are not in this page`));
    this.strip.replaceChildren(...rows);
    this.#light();
  }

  /** Show the latest picture of each camera at a moment. */
  show(event) {
    this.event = event;
    this.#light();
    const latest = this.#latest();
    if (latest.length === this.latest?.length && latest.every((each, index) => each === this.latest[index])) return;
    this.latest = latest;
    const figures = latest.slice(0, SHOWN_MAX).map((picture) => {
      const title = `${picture.camera}, event ${picture.at}`;
      if (picture.source === null) return element("figure", {}, element("p", { class: "quiet" }, recorded(picture.fault ?? "no longer kept")), element("figcaption", {}, recorded(picture.camera)));
      const button = element("button", { type: "button", title, "aria-label": `${title}: full size`, onclick: () => this.#enlarge(picture) }, imageOf(picture));
      const range = picture.kind === "depth" ? element("span", { class: "quiet" }, ` ${picture.text.replace("whole, ", "")}`) : null;
      return element("figure", {}, button, element("figcaption", {}, recorded(picture.camera), range));
    });
    this.inset.replaceChildren(...figures);
  }

  #latest() {
    return this.#cameras.flatMap(([, pictures]) => {
      const index = lastUpTo(pictures.map((each) => each.at), this.event);
      return index < 0 ? [] : [pictures[index]];
    });
  }

  #light() {
    const latest = new Set(this.event === undefined ? [] : this.#latest());
    for (const [picture, button] of this.buttons ?? []) {
      button.classList.toggle("lit", latest.has(picture));
      button.classList.toggle("later", picture.at > this.event);
    }
  }

  #choose(picture) {
    this.onSeek(picture.at);
    this.#enlarge(picture);
  }

  /** Show one picture as large as there is room. */
  #enlarge(picture) {
    this.picture = picture;
    const { number } = this.episode;
    const facts = [`event ${picture.at}`, picture.text.replace("whole, ", "").replace("whole", ""), `${Math.ceil(picture.bytes / 1000)} kB`];
    const isWhole = picture.text.startsWith("whole");
    const hint = isWhole ? null : element("p", { class: "quiet" }, "This is a smaller one. The whole: ", element("code", {}, `pycrorm report ${number} --images full`));
    const step = (by, sign, name) => element("button", { type: "button", "aria-label": name, title: name, "data-key": name, onclick: () => this.#step(by) }, sign);
    const close = element("button", { type: "button", onclick: () => this.dialog.close() }, "close");
    const bar = element("div", { class: "bar" }, element("b", {}, recorded(picture.camera)), element("span", { class: "quiet" }, facts.filter(Boolean).join(" · ")), step(-1, "◀", "picture before"), step(1, "▶", "next picture"), close);
    this.dialog.setAttribute("aria-label", "picture");
    this.dialog.replaceChildren(bar, imageOf(picture), ...(hint === null ? [] : [hint]));
    if (!this.dialog.open) this.dialog.showModal();
    close.focus();
  }

  #step(by) {
    const pictures = this.episode.cameras.get(this.picture.camera).filter((each) => each.source !== null);
    const next = pictures[pictures.indexOf(this.picture) + by];
    if (next !== undefined) this.#choose(next);
  }

  #press(pressed) {
    pressed.stopPropagation();
    if (pressed.key === "Escape") this.dialog.close();
    const by = { ArrowLeft: -1, ArrowRight: 1 }[pressed.key];
    if (by === undefined) return;
    pressed.preventDefault();
    this.#step(by);
  }
}

/** The image of a picture, or a word in its place if the browser cannot decode it. */
const imageOf = (picture) => element("img", { src: picture.source, alt: "", decoding: "async", onerror: ({ target }) => target.replaceWith("not readable") });

/** The clouds of the moment: of each name the latest one. */
export function cloudsAt(episode, event) {
  return [...episode.cameras.values()].flatMap((pictures) => {
    const index = pictures.findLastIndex((each) => each.at <= event);
    return index >= 0 && pictures[index].kind === "points" && pictures[index].source !== null ? [pictures[index]] : [];
  });
}

/** The points of a cloud, as a mesh of the scene. */
export function pointsOf({ source: { low, high, points } }, color) {
  const scaled = new Uint16Array(Uint8Array.from(atob(points), (each) => each.charCodeAt(0)).buffer);
  const positions = Float32Array.from(scaled, (each, index) => low[index % 3] + (each / 65535) * (high[index % 3] - low[index % 3]));
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute(positions, 3));
  return new THREE.Points(geometry, new THREE.PointsMaterial({ color, size: 2, sizeAttenuation: false }));
}
