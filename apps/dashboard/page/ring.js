// The slices of one unit, oldest first. Rule: memory is taken once. In a full ring, a new slice replaces the oldest.
//
// A slice is {begin, end, frame, kind, wait}. `begin` and `end`: ms since the run's first step. `kind`: index of the
// stage or idle cause in a table of the ring's owner. `wait`: ms from ready to begin.

export class SliceRing {
  constructor(capacity) {
    this.capacity = capacity;
    this.begins = new Float64Array(capacity);
    this.ends = new Float64Array(capacity);
    this.frames = new Uint32Array(capacity);
    this.kinds = new Uint8Array(capacity);
    this.waits = new Float32Array(capacity);
    this.clear();
  }

  clear() {
    this.first = 0;
    this.count = 0;
  }

  // Adds a slice, and keeps the slices sorted by end. A slice that is older than all slices of a full ring is ignored.
  add(begin, end, frame, kind, wait) {
    if (this.count === this.capacity) {
      if (end < this.ends[this.first]) return;
      this.first = (this.first + 1) % this.capacity;
      this.count -= 1;
    }
    let place = this.count;
    this.count += 1;
    while (place > 0 && this.ends[this.at(place - 1)] > end) {
      this.#move(this.at(place - 1), this.at(place));
      place -= 1;
    }
    const slot = this.at(place);
    this.begins[slot] = begin;
    this.ends[slot] = end;
    this.frames[slot] = frame;
    this.kinds[slot] = kind;
    this.waits[slot] = wait;
  }

  #move(from, to) {
    for (const column of [this.begins, this.ends, this.frames, this.kinds, this.waits]) column[to] = column[from];
  }

  // Returns the place in the columns of slice number `index`, counted from the oldest.
  at(index) {
    return (this.first + index) % this.capacity;
  }

  // Returns the number of the first slice that ends after `time`; `count` if there is none.
  firstAfter(time) {
    let low = 0;
    let high = this.count;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (this.ends[this.at(middle)] > time) high = middle;
      else low = middle + 1;
    }
    return low;
  }

  get lastEnd() {
    return this.count ? this.ends[this.at(this.count - 1)] : -Infinity;
  }

  slice(index) {
    const slot = this.at(index);
    return {
      begin: this.begins[slot],
      end: this.ends[slot],
      frame: this.frames[slot],
      kind: this.kinds[slot],
      wait: this.waits[slot],
    };
  }
}
