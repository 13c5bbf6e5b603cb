// Follows the server of a live page: gives its parts to the page, and shows it when the server or the database is away.

import { backTo, element, recorded } from "./dom.js";

const SILENCE_S = 8;
const RETRY_MS = 1000;
const holder = document.querySelector("header");
const shown = globalThis.pycrormPage ?? globalThis.pycrormOverview;
const { live } = JSON.parse(document.getElementById("document").textContent);

class Stream {
  constructor(address, view) {
    Object.assign(this, { address, view, version: null, last: view.episode?.last ?? 0, waiting: [] });
    this.badge = element("button", { type: "button", id: "live", "aria-live": "polite" });
    this.note = element("p", { class: "quiet", id: "stream" });
    holder.querySelector("h1").after(this.badge);
    holder.append(this.note);
    if (live.list) this.note.before(element("a", { href: backTo(live.list) }, "all episodes"));
    this.badge.addEventListener("click", () => this.view.follow?.(!this.view.following));
    this.view.onFollow = () => this.#show();
    this.connected = null; // until the server answers, or cannot be reached
    this.heard = performance.now();
    if (this.view.follow && !/^#e\d+$/.test(location.hash)) this.view.follow(true);
    setInterval(() => this.#watch(), RETRY_MS);
    this.#connect();
    this.#show();
  }

  /** Connect behind the last event that the page has; the browser itself connects again after a short break. */
  #connect() {
    this.source?.close();
    const address = new URL(this.address, location.href);
    address.searchParams.set("after", this.last);
    this.source = new EventSource(address);
    this.source.addEventListener("part", (message) => this.#take(JSON.parse(message.data)));
    this.source.addEventListener("state", (message) => this.#state(JSON.parse(message.data)));
    this.source.addEventListener("outcomes", (message) => {
      this.view.episode.judge(JSON.parse(message.data));
      this.view.show();
    });
    this.source.addEventListener("reload", () => location.reload());
    this.source.addEventListener("error", () => this.#lost());
  }

  /** Connect again if the browser has given up, or if the server is silent. */
  #watch() {
    const silent = performance.now() - this.heard > SILENCE_S * 1000;
    if (silent) this.#lost();
    if (silent || this.source.readyState === EventSource.CLOSED) {
      this.heard = performance.now();
      this.#connect();
    }
  }

  #lost() {
    this.connected = false;
    this.#show();
  }

  /** Keep a part until the next picture, because parts may arrive faster than the page draws. */
  #take(part) {
    this.heard = performance.now();
    if (part.after !== undefined && part.after !== this.last) return this.#connect();
    if (part.episode) this.last = part.episode.last;
    this.waiting.push(part);
    if (this.waiting.length === 1) setTimeout(() => this.#draw(), document.hidden ? RETRY_MS : 0);
    return undefined;
  }

  #draw() {
    const parts = this.waiting;
    this.waiting = [];
    this.view.extend(...parts);
    this.#show();
  }

  #state(state) {
    this.heard = performance.now();
    if (this.version !== null && this.version !== state.version) location.reload();
    Object.assign(this, { connected: true, version: state.version, fault: state.fault, began: state.began });
    this.#show();
  }

  #show() {
    const { episode, following } = this.view;
    const ended = episode !== undefined && episode.status !== "RUNNING";
    const words = this.connected === null ? "… connecting" : !this.connected ? "✗ no server" : this.fault ? "… waiting" : ended ? "■ ended" : following === false ? "○ follow" : "● live";
    if (this.badge.textContent !== words) this.badge.textContent = words;
    this.badge.className = this.connected === false || this.fault ? "is-failed" : "";
    this.badge.title = following ? "stay at this moment" : "follow the last moment";
    this.badge.disabled = this.view.follow === undefined;
    this.note.replaceChildren(...this.#notes(episode, ended));
  }

  #notes(episode, ended) {
    const notes = [];
    if (this.connected === false) notes.push(recorded("The server cannot be reached; this page continues when it is back."));
    if (this.fault) notes.push(recorded(this.fault));
    if (episode?.full && episode.head > episode.last) {
      const from = new URL(location.href);
      from.search = `?from=${episode.last + 1}`;
      from.hash = "";
      notes.push(element("a", { href: from }, `This page is full; a new page continues from event ${episode.last + 1}.`));
    }
    if (ended && this.began > episode.number) notes.push(element("a", { href: `${live.page}last` }, "A newer episode has begun."));
    if (episode === undefined && this.connected && !this.fault && this.view.episodes.length === 0) {
      notes.push(recorded(`No episode is recorded in ${live.database} yet; this page waits for the first.`));
    }
    return notes;
  }
}

globalThis.pycrormStream = new Stream(live.stream, shown);
