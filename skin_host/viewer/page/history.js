// What has been: every value of the last minute, and the extremes of each half second before it.
export const FINE_S = 60;
export const LONGEST_S = 600;
const FINE_SLOTS = FINE_S * 26;
const COARSE_MS = 500;
const COARSE_SLOTS = (LONGEST_S * 1000) / COARSE_MS;
/** Points farther apart than this, or two periods of what comes more slowly, are not joined: nothing came between. */
const GAP_MS = 700;

/** Rows of values with their times, of which only the newest stay. */
class Ring {
  constructor(slots, n) {
    this.slots = slots;
    this.n = n;
    this.times = new Float64Array(slots);
    this.values = new Float32Array(slots * n);
    this.next = 0;
    this.filled = 0;
  }

  /** Begin a row; its values are written at the offset that is returned. */
  add(nowMs) {
    const row = this.next * this.n;
    this.times[this.next] = nowMs;
    this.next = (this.next + 1) % this.slots;
    this.filled = Math.min(this.filled + 1, this.slots);
    return row;
  }

  slot(k) { return (this.next - this.filled + k + this.slots) % this.slots; }

  get oldest() { return this.filled ? this.times[this.slot(0)] : Infinity; }
}

/** The past of some taxels; NaN where there is no value. */
export class History {
  constructor(n, periodMs) {
    this.n = n;
    this.gapMs = Math.max(GAP_MS, 2 * periodMs);
    this.fine = new Ring(FINE_SLOTS, n);
    this.low = new Ring(COARSE_SLOTS, n);
    this.high = new Ring(COARSE_SLOTS, n);
    this.bucket = null;
    this.row = 0;
  }

  /** Take a value of each taxel. */
  add(nowMs, values) {
    this.fine.values.set(values, this.fine.add(nowMs));
    const bucket = Math.floor(nowMs / COARSE_MS);
    if (bucket !== this.bucket) {
      this.bucket = bucket;
      this.row = this.low.add(bucket * COARSE_MS);
      this.high.add((bucket + 0.5) * COARSE_MS);
      this.low.values.set(values, this.row);
      this.high.values.set(values, this.row);
      return;
    }
    const [low, high] = [this.low.values, this.high.values];
    for (let i = 0; i < this.n; i++) {
      const at = this.row + i;
      const value = values[i];
      // A comparison with NaN is false, so the first value in a half second is taken as it is.
      if (!(low[at] <= value)) low[at] = Number.isNaN(value) ? low[at] : value;
      if (!(high[at] >= value)) high[at] = Number.isNaN(value) ? high[at] : value;
    }
  }

  /** [time, value] of a taxel between two times, oldest first; null where lines end. */
  course(taxel, fromMs, toMs) {
    const points = [];
    let last = null;
    const put = (t, value, gapMs) => {
      if (t < fromMs || t > toMs) return;
      if (Number.isNaN(value)) { if (last !== null) points.push([t, null]); last = null; return; }
      if (last !== null && t - last > gapMs) points.push([(t + last) / 2, null]);
      points.push([t, value]);
      last = t;
    };
    const { fine, low, high, gapMs } = this;
    const start = fine.oldest;
    for (let k = 0; k < low.filled && fromMs < start; k++) {
      const slot = low.slot(k);
      if (high.times[slot] >= start) break;
      put(low.times[slot], low.values[slot * this.n + taxel], gapMs + COARSE_MS);
      put(high.times[slot], high.values[slot * this.n + taxel], gapMs + COARSE_MS);
    }
    for (let k = 0; k < fine.filled; k++) {
      const slot = fine.slot(k);
      put(fine.times[slot], fine.values[slot * this.n + taxel], gapMs);
    }
    return points;
  }
}

/** One value over time, and whether it is a bound from below, such as a force: what does not change takes two points. It is known for `knownMs` after it came, and null from then on. */
export class Course {
  constructor(knownMs) {
    this.points = [];
    this.knownMs = knownMs;
  }

  get last() { return this.points.at(-1)?.[0] ?? -Infinity; }

  add(nowMs, value, isLeast) {
    const points = this.points;
    points.push(...this.ended(nowMs));
    // Two pictures of one moment are one; but the first may end a line, from where it steps.
    if (nowMs - this.last < 5 && !this.isLevel(1)) points.pop();
    const atMs = Math.max(nowMs, this.last + 0.01);
    points.push([atMs, value, isLeast]);
    if (this.isLevel(1) && this.isLevel(2)) points.splice(-2, 1);
    const n = points.length;
    if (n > 1000 && points[n >> 1][0] < nowMs - LONGEST_S * 1000) this.points = points.slice(n >> 1);
  }

  /** Whether the point that is `k` from the end continues the one before it. */
  isLevel(k) {
    const [before, point] = this.points.slice(-k - 1);
    return this.points.length > k && before[1] === point[1] && before[2] === point[2];
  }

  /** The point at which the last value ceases to be known before a time, if it does. */
  ended(nowMs) {
    const isKnown = this.points.length > 0 && this.points.at(-1)[1] !== null;
    return isKnown && nowMs - this.last > this.knownMs ? [[this.last + this.knownMs, null, true]] : [];
  }

  between(fromMs, toMs) {
    const points = [...this.points, ...this.ended(toMs)];
    // The point before the first goes along, so that a line comes in from the edge.
    const first = points.findIndex(([t]) => t >= fromMs);
    if (first < 0) return points.slice(-1);
    return points.slice(Math.max(0, first - 1)).filter(([t]) => t <= toMs);
  }
}
