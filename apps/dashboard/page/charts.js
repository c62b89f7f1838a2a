// Figures over time. Rule: a chart has at most POINTS moments. A chart that nobody sees is not drawn again. It is drawn
// once, so that the page below it does not move when the chart comes into view.
/* global uPlot */

import { colour, onThemeChange } from "./theme.js";
import { isNumber, number } from "./text.js";

const POINTS = 480; // two minutes, at four a second
const HEIGHT = 130;
const DASHES = [[], [6, 3], [2, 3], [8, 3, 2, 3], [4, 4], [1, 2]];

// One chart in the element `home`. `read(figures)` returns {name: number or null}; each new name adds a series.
export class Chart {
  constructor(home, unit, digits, read) {
    this.home = home;
    this.unit = unit;
    this.digits = digits;
    this.read = read;
    this.isSeen = false;
    this.clear();
    new ResizeObserver(() => this.plot?.setSize(this.#size())).observe(home);
    new IntersectionObserver((entries) => {
      this.isSeen = entries.at(-1).isIntersecting;
      this.isDirty = true;
    }).observe(home);
    onThemeChange(() => {
      this.#drop();
      this.isDirty = true;
    });
  }

  clear() {
    this.times = [];
    this.rows = [];
    this.names = [];
    this.marked = null;
    this.#drop();
    this.isDirty = true;
  }

  #drop() {
    this.plot?.destroy();
    this.plot = null;
  }

  // Keeps the figures sorted by time, whatever the order of the calls. If there are too many, the oldest are dropped.
  add(figures) {
    const row = this.read(figures);
    const time = figures.t_ms / 1000;
    let place = this.times.length;
    while (place > 0 && this.times[place - 1] >= time) place -= 1;
    const isThere = this.times[place] === time;
    this.times.splice(place, isThere ? 1 : 0, time);
    this.rows.splice(place, isThere ? 1 : 0, row);
    if (this.times.length > POINTS) {
      this.times.shift();
      this.rows.shift();
    }
    const added = Object.keys(row).filter((name) => !this.names.includes(name));
    if (added.length) {
      this.names.push(...added);
      this.#drop();
    }
    this.isDirty = true;
  }

  // Marks the moment `time`, in ms, of a finished run.
  mark(time) {
    this.marked = time / 1000;
    this.isDirty = true;
  }

  tick() {
    if (!this.isDirty || (this.plot && !this.isSeen)) return;
    this.isDirty = false;
    this.home.classList.toggle("empty", this.names.length === 0);
    if (this.names.length === 0) return;
    const columns = this.names.map((name) => this.rows.map((row) => (isNumber(row[name]) ? row[name] : null)));
    if (this.plot) this.plot.setData([this.times, ...columns]);
    else {
      this.plot = new uPlot(this.#options(), [this.times, ...columns], this.home);
      this.isDirty = true; // the cursor needs the plot's scales, which exist only after a drawing
    }
    this.#point();
  }

  // While nobody points at the chart, its legend shows the values at the marked moment, or else the newest values.
  #point() {
    const { plot } = this;
    if (plot.over.matches(":hover")) return;
    if (this.marked === null) plot.setLegend({ idx: this.times.length - 1 });
    else plot.setCursor({ left: plot.valToPos(this.marked, "x"), top: -10 });
  }

  #size() {
    return { width: Math.max(120, this.home.clientWidth), height: HEIGHT };
  }

  #options() {
    const axis = { stroke: colour("muted"), grid: { stroke: colour("grid"), width: 1 }, ticks: { show: false } };
    const value = (_, raw) => `${number(raw, raw < 100 ? this.digits : 0)} ${this.unit}`;
    return {
      ...this.#size(),
      scales: { x: { time: false }, y: { range: (_, low, high) => [Math.min(0, low), high > 0 ? high * 1.08 : 1] } },
      cursor: { drag: { x: false, y: false }, points: { size: 6 } },
      axes: [
        { ...axis, size: 26, values: (_, ticks) => ticks.map((time) => `${time} s`) },
        { ...axis, size: 46, values: (_, ticks) => ticks.map((tick) => `${tick}`) },
      ],
      series: [
        { label: "time", value: (_, raw) => (isNumber(raw) ? `${raw.toFixed(1)} s` : "–") },
        ...this.names.map((label, index) => ({
          label,
          value,
          stroke: colour(`series-${index % 6}`),
          width: 1.6,
          dash: DASHES[index % DASHES.length],
          points: { show: false },
        })),
      ],
    };
  }
}
