// What the timeline shows: the jobs and the idle time of each unit. Rule: memory is bounded, however long the run is.

import { SliceRing } from "./ring.js";

// A unit with two stages at 60 frames a second has so many jobs in more than two minutes.
const SLICES_PER_UNIT = 16384;
export const CAUSE_MEANINGS = {
  starved: "no input",
  blocked: "no free slot behind, or as many frames in flight as may be",
  throttled: "held by its duty",
  preempted: "it has a job, but another thread has its core",
  overhead: "a job is assigned but does not run yet, or the process is down",
  join: "some inputs of a frame are there, others not",
  unexplained: "no cause was noted",
};
export const CAUSES = Object.keys(CAUSE_MEANINGS);

export class Slices {
  constructor(stages, units) {
    this.stages = stages;
    this.units = units;
    this.jobs = units.map(() => new SliceRing(SLICES_PER_UNIT));
    this.idle = units.map(() => new SliceRing(SLICES_PER_UNIT));
  }

  clear() {
    for (const ring of [...this.jobs, ...this.idle]) ring.clear();
  }

  // Adds the jobs and idle slices of a message `slices`.
  add({ jobs = [], idle = [] }) {
    for (const [unit, stage, frame, begin, end, wait] of jobs) this.jobs[unit]?.add(begin, end, frame, stage, wait);
    for (const [unit, cause, begin, end] of idle) {
      const kind = CAUSES.indexOf(cause);
      this.idle[unit]?.add(begin, end, 0, kind < 0 ? CAUSES.length - 1 : kind, 0);
    }
  }

  get lastEnd() {
    return Math.max(...this.jobs.map((ring) => ring.lastEnd), ...this.idle.map((ring) => ring.lastEnd));
  }

  // Returns what `unit` did at `time`, as {unit, isJob, index, …slice}; null if unknown.
  find(unit, time, toleranceMs = 0) {
    for (const [ring, isJob] of [
      [this.jobs[unit], true],
      [this.idle[unit], false],
    ]) {
      const index = ring.firstAfter(time - toleranceMs);
      if (index < ring.count) {
        const slice = ring.slice(index);
        if (slice.begin <= time + toleranceMs) return { unit, isJob, index, ...slice };
      }
    }
    return null;
  }

  // Returns the jobs of `frame` that ended after `from` and began before `to`, sorted by begin.
  jobsOf(frame, from, to) {
    const found = [];
    this.jobs.forEach((ring, unit) => {
      for (let index = ring.firstAfter(from); index < ring.count; index += 1) {
        const slot = ring.at(index);
        if (ring.begins[slot] > to) break;
        if (ring.frames[slot] === frame) found.push({ unit, isJob: true, index, ...ring.slice(index) });
      }
    });
    return found.sort((a, b) => a.begin - b.begin);
  }

  // Returns a sentence about a slice.
  describe(slice) {
    const unit = this.units[slice.unit];
    const length = `${(slice.end - slice.begin).toFixed(2)} ms`;
    if (!slice.isJob) return `${unit} idle, ${CAUSES[slice.kind]} (${CAUSE_MEANINGS[CAUSES[slice.kind]]}) for ${length}`;
    const stage = this.stages[slice.kind]?.name ?? "?";
    return `frame ${slice.frame}: ${stage} on ${unit} for ${length}, after a wait of ${slice.wait.toFixed(2)} ms`;
  }
}
