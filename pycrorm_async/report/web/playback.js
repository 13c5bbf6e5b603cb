// Plays an episode: events at a constant rate, or in proportion to the time between them, as the axis of the chart has it.

const PLAYED_S = 20;
const EVENTS_PER_S_MIN = 4;
const PAUSE_MAX_S = 2;
const CALM_S = 1; // between two pictures, where less motion is preferred

export class Playback {
  /** When each event is played, in seconds from the first one; `shortened` is true if a pause is shorter than its share. */
  static schedule(times, byTime) {
    const events = times.length - 1;
    const whole = times[events] - times[0];
    const rate = Math.max(events / PLAYED_S, EVENTS_PER_S_MIN);
    if (!byTime || whole <= 0) return { at: times.map((_, index) => index / rate), shortened: false };
    const at = [0];
    let shortened = false;
    for (let index = 1; index <= events; index++) {
      const pause = ((times[index] - times[index - 1]) / whole) * PLAYED_S;
      shortened ||= pause > PAUSE_MAX_S;
      at.push(at[index - 1] + Math.min(pause, PAUSE_MAX_S));
    }
    return { at, shortened };
  }

  /** `onEvent` gets each event that is reached, `onEnd` is called after the last one. */
  constructor({ onEvent, onEnd }) {
    Object.assign(this, { onEvent, onEnd, waiting: null, shortened: false });
  }

  get running() {
    return this.waiting !== null;
  }

  /** Play the events from one to the last; `times` are those of the events from the first one on. */
  start(first, from, last, times, byTime) {
    this.stop();
    const { at, shortened } = Playback.schedule(times.slice(0, last - first + 1), byTime);
    this.shortened = shortened;
    const began = performance.now() - at[from - first] * 1000;
    let index = from - first;
    let shown = -Infinity;
    const calm_s = matchMedia("(prefers-reduced-motion: reduce)").matches ? CALM_S : 0;
    const step = () => {
      const now = (performance.now() - began) / 1000;
      if (now - shown < calm_s) {
        this.waiting = requestAnimationFrame(step);
        return;
      }
      const before = index;
      while (index < at.length - 1 && at[index + 1] <= now) index++;
      this.waiting = requestAnimationFrame(step);
      if (index > before) {
        shown = now;
        this.onEvent(first + index);
      }
      if (this.running && index === at.length - 1) {
        this.stop();
        this.onEnd();
      }
    };
    this.waiting = requestAnimationFrame(step);
  }

  stop() {
    cancelAnimationFrame(this.waiting);
    Object.assign(this, { waiting: null, shortened: false });
  }
}
