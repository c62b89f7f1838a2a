// A finished run. Rule: one request at a time is on its way to the server, and it always asks for the newest moment.

import { byId, clock, setText } from "./text.js";

const ANSWER_LIMIT_MS = 2000;
const ASK_EVERY_MS = 40;
const BEFORE_END_MS = 200;
const SURVEY_MOMENTS = 120;
const BAR_STEP_MS = 10;
const LEAST_SPAN_MS = 1;
// Time to request on each side of a moment, in views of the timeline. The view stays within it while the run plays on.
const MARGIN_VIEWS = 1.5;

export class Seek {
  // send(t_ms, span_ms) requests the run from span_ms before to span_ms after t_ms. moved(t_ms) gets each new moment.
  // At first, `isSurveying`: the figures of moments all over the run are requested for the charts, one by one.
  constructor(send, moved) {
    this.send = send;
    this.moved = moved;
    this.isOn = false;
    this.bar = byId("seek");
    this.bar.addEventListener("input", () => this.go(Number(this.bar.value)));
    byId("seek-play").addEventListener("click", () => this.toggle());
    byId("seek-rate").addEventListener("change", () => {
      this.rate = Number(byId("seek-rate").value);
    });
  }

  begin([from, to]) {
    this.isOn = true;
    this.from = from;
    this.to = to;
    this.rate = Number(byId("seek-rate").value);
    this.isPlaying = false;
    this.asked = null;
    this.sentAt = -Infinity;
    this.loaded = [Infinity, -Infinity];
    this.bar.min = from;
    this.bar.max = to;
    this.bar.step = BAR_STEP_MS;
    const step = Math.max((to - from) / SURVEY_MOMENTS, 1000);
    this.moments = Array.from({ length: Math.floor((to - from) / step) }, (_, place) => from + (place + 1) * step);
    this.go(Math.max(to - BEFORE_END_MS, from));
  }

  get isSurveying() {
    return this.isOn && (this.moments.length > 0 || Boolean(this.asked?.isSurvey));
  }

  end() {
    this.isOn = false;
  }

  go(time) {
    if (!this.isOn) return;
    this.time = Math.min(Math.max(time, this.from), this.to);
    this.wanted = this.time;
    this.#show();
    this.moved(this.time);
  }

  toggle() {
    if (!this.isOn) return;
    this.isPlaying = !this.isPlaying;
    this.playedAt = performance.now();
    if (this.isPlaying && this.time >= this.to) this.go(this.from);
    this.#show();
  }

  // Whether the answer that comes now has the slices of a new stretch, which replace the old slices.
  get isNewStretch() {
    return Boolean(this.asked?.stretch);
  }

  // Takes note that the server has answered the last request.
  answered() {
    if (this.asked?.stretch) this.loaded = this.asked.stretch;
    if (this.asked?.isSurvey) this.moments.shift();
    this.asked = null;
  }

  #show() {
    this.bar.value = this.time;
    const text = `${clock(this.time - this.from)} of ${clock(this.to - this.from)}`;
    this.bar.setAttribute("aria-valuetext", text);
    setText(byId("seek-time"), text);
    setText(byId("seek-play"), this.isPlaying ? "Pause" : "Play");
  }

  // `viewMs`: time that the timeline shows; the moment is in its middle.
  tick(now, viewMs) {
    if (!this.isOn) return;
    if (this.isPlaying) this.#play(now);
    const isFree = this.asked === null || now - this.sentAt > ANSWER_LIMIT_MS;
    if (this.moments.length) {
      if (isFree && this.send(this.moments[0], LEAST_SPAN_MS)) this.#sent(now, { isSurvey: true });
      return;
    }
    if (this.#needs(this.time, viewMs)) this.wanted = this.time;
    if (this.wanted === null || !isFree || now - this.sentAt < ASK_EVERY_MS) return;
    const span = this.#needs(this.wanted, viewMs) ? MARGIN_VIEWS * viewMs : LEAST_SPAN_MS;
    if (!this.send(this.wanted, span)) return;
    this.#sent(now, { stretch: span > LEAST_SPAN_MS ? [this.wanted - span, this.wanted + span] : null });
    this.wanted = null;
  }

  #sent(now, asked) {
    this.asked = asked;
    this.sentAt = now;
  }

  // Returns whether a view around `time` reaches beyond the loaded slices.
  #needs(time, viewMs) {
    return time - viewMs / 2 < this.loaded[0] || time + viewMs / 2 > this.loaded[1];
  }

  #play(now) {
    const time = this.time + (now - this.playedAt) * this.rate;
    this.playedAt = now;
    if (time >= this.to) this.isPlaying = false;
    this.go(time);
  }
}
