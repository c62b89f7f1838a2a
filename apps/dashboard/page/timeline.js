// The timeline of the units. Rule: it is drawn only if somebody sees it and something has changed. Slices within one
// pixel are drawn once.

import { CAUSES } from "./slices.js";
import { causePattern, frameColours } from "./patterns.js";
import { colour, onThemeChange, wantsCalm } from "./theme.js";

const AXIS = 22;
const LANE = 40;
const GAP = 6;
const LABEL = 44;
const SHORTEST_SPAN_MS = 2;
const LONGEST_SPAN_MS = 60_000;
// One answer about a finished run has the slices of three views, and its size is bounded.
const LONGEST_FINISHED_SPAN_MS = 5000;
const FIRST_SPAN_MS = 400; // on a canvas at least WIDE pixels wide
const WIDE = 1200;
// Live slices come a few times a second. The view moves evenly if it stays so far behind the newest slice.
const LAG_MS = 300;
const CALM_STEP_MS = 1000;
const FRAME_LOOK_MS = 2000;
const TICKS = [1, 2, 5];

export class Timeline {
  // say(text) gets a text about the selected slice. changed(view) is called if the person has moved the shown time.
  constructor(canvas, { say, changed }) {
    this.canvas = canvas;
    this.pen = canvas.getContext("2d");
    this.say = say;
    this.changed = changed;
    this.slices = null;
    this.isLive = true;
    this.isRunning = true;
    this.isDirty = true;
    this.isSeen = true;
    this.reset();
    this.#listen();
    new ResizeObserver(() => this.#resize()).observe(canvas.parentElement);
    new IntersectionObserver((entries) => {
      this.isSeen = entries.at(-1).isIntersecting;
      this.isDirty = true;
    }).observe(canvas);
    onThemeChange(() => this.#restyle());
  }

  reset() {
    this.span = FIRST_SPAN_MS;
    this.right = 0;
    this.isFollowing = true;
    this.hovered = null;
    this.selected = null;
    this.offset = null;
    this.flow = [];
    this.isDirty = true;
  }

  show(slices, isLive) {
    const isFirst = this.slices === null;
    const { span } = this;
    this.slices = slices;
    this.isLive = isLive;
    this.reset();
    this.#resize();
    this.span = isFirst ? FIRST_SPAN_MS * Math.min(1, this.width / WIDE) : span;
  }

  // Call it after new slices: the newest slice gives the offset of the run's clock from the page's clock.
  fed() {
    const offset = this.slices.lastEnd - performance.now();
    if (Number.isFinite(offset)) {
      const isFar = this.offset === null || Math.abs(offset - this.offset) > 2000;
      this.offset = isFar ? offset : Math.max(offset, this.offset + 0.05 * (offset - this.offset));
    }
    this.isDirty = true;
  }

  get left() {
    return this.right - this.span;
  }

  #resize() {
    const ratio = devicePixelRatio || 1;
    const width = Math.max(100, this.canvas.parentElement.clientWidth);
    const height = AXIS + (LANE + GAP) * (this.slices?.units.length ?? 3);
    this.width = width;
    this.height = height;
    this.ratio = ratio;
    this.canvas.width = Math.round(width * ratio);
    this.canvas.height = Math.round(height * ratio);
    this.canvas.style.height = `${height}px`;
    this.#restyle();
  }

  #restyle() {
    this.frameFills = frameColours();
    this.causeFills = CAUSES.map((cause) => causePattern(this.pen, cause, this.ratio ?? 1));
    this.isDirty = true;
  }

  // Call it once for each picture of the browser. `now`: time as in performance.now().
  tick(now) {
    if (!this.slices || !this.isSeen) return;
    if (this.isFollowing && this.isLive) this.#follow(now);
    if (this.isDirty) this.#draw();
    this.isDirty = false;
  }

  #follow(now) {
    if (this.offset === null) return;
    const last = this.slices.lastEnd;
    let right = this.isRunning ? Math.min(now + this.offset - LAG_MS, last) : last;
    if (wantsCalm()) right = Math.floor(right / CALM_STEP_MS) * CALM_STEP_MS;
    if (right === this.right) return;
    this.right = right;
    this.isDirty = true;
  }

  x(time) {
    return LABEL + ((time - this.left) / this.span) * (this.width - LABEL);
  }

  time(x) {
    return this.left + ((x - LABEL) / (this.width - LABEL)) * this.span;
  }

  #draw() {
    const { pen, ratio } = this;
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, this.width, this.height);
    pen.font = "11px system-ui, sans-serif";
    pen.textBaseline = "middle";
    this.#drawAxis();
    const focus = this.selected ?? this.hovered;
    this.flow = focus?.isJob
      ? this.slices.jobsOf(focus.frame, focus.begin - FRAME_LOOK_MS, focus.end + FRAME_LOOK_MS)
      : [];
    pen.save();
    pen.beginPath();
    pen.rect(LABEL, 0, this.width - LABEL, this.height);
    pen.clip();
    this.slices.units.forEach((_, unit) => this.#drawLane(unit, focus));
    this.#drawFlow(focus);
    if (!this.isLive) this.#drawMoment();
    pen.restore();
    this.#drawLabels();
  }

  #drawMoment() {
    const { pen } = this;
    pen.strokeStyle = colour("accent");
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(this.x(this.middle), 0);
    pen.lineTo(this.x(this.middle), this.height);
    pen.stroke();
  }

  #top(unit) {
    return AXIS + GAP / 2 + unit * (LANE + GAP);
  }

  #drawAxis() {
    const { pen } = this;
    const step = tickStep(this.span, (this.width - LABEL) / 90);
    pen.fillStyle = colour("muted");
    pen.strokeStyle = colour("grid");
    pen.lineWidth = 1;
    pen.beginPath();
    for (let time = Math.ceil(this.left / step) * step; time <= this.right; time += step) {
      const x = Math.round(this.x(time)) + 0.5;
      pen.moveTo(x, AXIS - 6);
      pen.lineTo(x, this.height);
      if (x + 60 < this.width) pen.fillText(tickText(time, step), x + 3, AXIS / 2);
    }
    pen.stroke();
  }

  #drawLane(unit, focus) {
    const top = this.#top(unit);
    this.#drawIdle(this.slices.idle[unit], top);
    this.#drawJobs(this.slices.jobs[unit], top, focus?.isJob ? focus.frame : null);
  }

  // Calls draw(x, width, slot) for each visible slice, except slices within a pixel that is drawn already.
  #each(ring, draw) {
    let drawnTo = -Infinity;
    for (let index = ring.firstAfter(this.left); index < ring.count; index += 1) {
      const slot = ring.at(index);
      if (ring.begins[slot] > this.right) break;
      const begin = Math.max(this.x(ring.begins[slot]), LABEL);
      const end = Math.min(this.x(ring.ends[slot]), this.width);
      if (end <= drawnTo) continue;
      draw(begin, Math.max(end - begin, 1), slot);
      drawnTo = Math.max(end, begin + 1);
    }
  }

  #drawIdle(ring, top) {
    const { pen } = this;
    this.#each(ring, (x, width, slot) => {
      pen.fillStyle = this.causeFills[ring.kinds[slot]];
      pen.fillRect(x, top + LANE * 0.4, width, LANE * 0.6);
    });
  }

  #drawJobs(ring, top, onlyFrame) {
    const { pen } = this;
    const inks = colour("on-frame");
    this.#each(ring, (x, width, slot) => {
      const frame = ring.frames[slot];
      pen.globalAlpha = onlyFrame === null || onlyFrame === frame ? 1 : 0.3;
      pen.fillStyle = this.frameFills[frame % this.frameFills.length];
      pen.fillRect(x, top, width > 3 ? width - 0.7 : width, LANE);
      if (width > 24) {
        pen.fillStyle = inks;
        this.#write(this.slices.stages[ring.kinds[slot]]?.name ?? "", frame, x + 4, width - 8, top);
      }
    });
    pen.globalAlpha = 1;
  }

  #write(stage, frame, x, width, top) {
    const { pen } = this;
    const number = String(frame);
    if (pen.measureText(number).width <= width) pen.fillText(number, x, top + LANE * 0.68);
    if (pen.measureText(stage).width <= width) pen.fillText(stage, x, top + LANE * 0.3);
  }

  // Joins the jobs of the frame in focus by lines, in the order in which they ran.
  #drawFlow(focus) {
    if (!focus) return;
    const { pen } = this;
    pen.strokeStyle = colour("text");
    pen.lineWidth = 1.5;
    pen.beginPath();
    this.flow.forEach((job, index) => {
      const before = this.flow[index - 1];
      if (!before) return;
      pen.moveTo(this.x(before.end), this.#top(before.unit) + LANE / 2);
      pen.lineTo(this.x(job.begin), this.#top(job.unit) + LANE / 2);
    });
    pen.stroke();
    const [x, end] = [this.x(focus.begin), this.x(focus.end)];
    pen.lineWidth = 2;
    pen.strokeRect(x, this.#top(focus.unit) + 1, Math.max(end - x, 2), LANE - 2);
  }

  #drawLabels() {
    const { pen } = this;
    pen.fillStyle = colour("text");
    pen.font = "600 12px system-ui, sans-serif";
    this.slices.units.forEach((unit, index) => pen.fillText(unit, 2, this.#top(index) + LANE / 2, LABEL - 6));
  }

  #at(event) {
    const box = this.canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  #sliceAt(x, y) {
    const unit = Math.floor((y - AXIS) / (LANE + GAP));
    if (!this.slices || unit < 0 || unit >= this.slices.units.length || x < LABEL) return null;
    return this.slices.find(unit, this.time(x), (2 * this.span) / this.width);
  }

  #point(slice) {
    this.hovered = slice;
    this.isDirty = true;
    const told = slice ?? this.selected; // a finger that is lifted also leaves the canvas
    this.say(told ? this.slices.describe(told) : "");
  }

  follow() {
    this.isFollowing = true;
    this.selected = null;
    this.isDirty = true;
    this.changed(this);
  }

  #moved() {
    this.isFollowing = false;
    this.isDirty = true;
    this.changed(this);
  }

  pan(deltaMs) {
    const last = Number.isFinite(this.slices?.lastEnd) ? this.slices.lastEnd : 0;
    this.right = Math.min(Math.max(this.right + deltaMs, this.span * 0.1), this.isLive ? last + this.span / 2 : Infinity);
    this.#moved();
  }

  // The middle is the shown moment of a finished run.
  get middle() {
    return this.right - this.span / 2;
  }

  showMoment(time) {
    this.right = time + this.span / 2;
    this.isDirty = true;
  }

  // `factor` above 1 shows more time. One time stays at its place: in a finished run the middle; in a live run the time
  // at `x` or, if the view follows the run, the right end.
  zoom(factor, x = this.width) {
    const isFollowing = this.isFollowing;
    const fixed = this.isLive ? (isFollowing ? this.right : this.time(x)) : this.middle;
    const longest = this.isLive ? LONGEST_SPAN_MS : LONGEST_FINISHED_SPAN_MS;
    const span = Math.min(Math.max(this.span * factor, SHORTEST_SPAN_MS), longest);
    this.right = fixed + ((this.right - fixed) * span) / this.span;
    this.span = span;
    this.#moved();
    this.isFollowing = isFollowing;
    this.changed(this);
  }

  // Selects the next (1) or previous (-1) job in the lane of the selected job.
  select(step) {
    const from = this.selected ?? this.hovered;
    const unit = from?.isJob ? from.unit : 0;
    const ring = this.slices?.jobs[unit];
    if (!ring?.count) return;
    const here = from?.isJob ? ring.firstAfter(from.end - 1e-6) : ring.firstAfter((this.left + this.right) / 2);
    this.#choose(unit, Math.min(Math.max(here + step, 0), ring.count - 1));
  }

  // Selects the job at the same time in the lane above (-1) or below (1).
  selectLane(step) {
    const from = this.selected;
    if (!from) return this.select(0);
    const unit = Math.min(Math.max(from.unit + step, 0), this.slices.units.length - 1);
    const ring = this.slices.jobs[unit];
    if (ring.count) this.#choose(unit, Math.min(ring.firstAfter(from.begin), ring.count - 1));
  }

  #choose(unit, index) {
    this.selected = { unit, isJob: true, index, ...this.slices.jobs[unit].slice(index) };
    if (this.selected.begin < this.left || this.selected.end > this.right) {
      this.right = (this.selected.begin + this.selected.end + this.span) / 2;
    }
    this.say(this.slices.describe(this.selected));
    this.#moved();
  }

  #listen() {
    const { canvas } = this;
    const pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, this.#at(event));
      this.dragged = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const [x, y] = this.#at(event);
      if (!pointers.has(event.pointerId)) return this.#point(this.#sliceAt(x, y));
      this.#drag(pointers, event.pointerId, x, y);
    });
    const released = (event) => {
      if (!pointers.delete(event.pointerId) || this.dragged > 4) return;
      const [x, y] = this.#at(event);
      this.selected = this.#sliceAt(x, y);
      this.#point(this.selected);
    };
    canvas.addEventListener("pointerup", released);
    canvas.addEventListener("pointercancel", (event) => pointers.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => this.#point(null));
    canvas.addEventListener("dblclick", () => this.follow());
    canvas.addEventListener("wheel", (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.#key(event));
  }

  #drag(pointers, id, x, y) {
    const [oldX] = pointers.get(id);
    const others = [...pointers].filter(([other]) => other !== id).map(([, place]) => place);
    this.dragged += Math.abs(x - oldX);
    pointers.set(id, [x, y]);
    if (others.length) {
      const [before, after] = [Math.abs(oldX - others[0][0]), Math.abs(x - others[0][0])];
      if (before > 8 && after > 8) this.zoom(before / after, (x + others[0][0]) / 2);
    } else if (this.dragged > 4) this.pan(((oldX - x) * this.span) / (this.width - LABEL));
  }

  // The wheel zooms with Ctrl (which a pinch sends too) or while the canvas has the focus; if not, it scrolls the page.
  #wheel(event) {
    const isSideways = Math.abs(event.deltaX) > Math.abs(event.deltaY);
    if (isSideways) this.pan((event.deltaX * this.span) / this.width);
    else if (event.ctrlKey || event.metaKey || document.activeElement === this.canvas) {
      this.zoom(Math.exp(event.deltaY * (event.ctrlKey ? 0.01 : 0.002)), this.#at(event)[0]);
    } else return;
    event.preventDefault();
  }

  #key(event) {
    const quarter = this.span / 4;
    const actions = {
      ArrowLeft: () => this.pan(-quarter),
      ArrowRight: () => this.pan(quarter),
      a: () => this.pan(-quarter),
      d: () => this.pan(quarter),
      "+": () => this.zoom(0.7, this.width / 2),
      "-": () => this.zoom(1 / 0.7, this.width / 2),
      w: () => this.zoom(0.7, this.width / 2),
      s: () => this.zoom(1 / 0.7, this.width / 2),
      "[": () => this.select(-1),
      "]": () => this.select(1),
      ArrowUp: () => this.selectLane(-1),
      ArrowDown: () => this.selectLane(1),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !actions[event.key]) return;
    actions[event.key]();
    event.preventDefault();
    event.stopPropagation();
  }
}

// Returns a round length of time that fits into `span` at most `most` times.
function tickStep(span, most) {
  let unit = 0.1;
  for (;;) {
    for (const times of TICKS) if (span / (unit * times) <= Math.max(most, 1)) return unit * times;
    unit *= 10;
  }
}

function tickText(time, step) {
  if (step >= 1000) return `${(time / 1000).toFixed(0)} s`;
  if (time >= 10_000) return `${(time / 1000).toFixed(step >= 100 ? 1 : step >= 10 ? 2 : 3)} s`;
  return `${time.toFixed(step < 1 ? 1 : 0)} ms`;
}
