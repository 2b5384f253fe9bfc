// Plots over the last minutes, by uPlot.
import { DASHES, LINES, paper, theme } from "./colours.js";

/** Without the library, which is not in the repository, there is no plot. */
export const HAS_PLOTS = typeof globalThis.uPlot === "function";
/** Noise below zero has this share of the height. */
const BELOW = 0.06;
const FONT = "11px system-ui, sans-serif";
const STEP_PX = 8;

export function lineColour(i) { return LINES[theme()][i % DASHES.length]; }

/** One plot: lines of [time in ms, value], seen from `seconds` before a time to that time. */
export class Plot {
  /** `point` is told where the cursor is, in ms before the end, or null; `label` is read aloud. */
  constructor(box, { unit, least, point }) {
    this.box = box;
    this.unit = unit;
    this.least = least;
    this.point = point;
    this.key = "";
    this.plot = null;
    this.top = least;
    this.seconds = 60;
    box.addEventListener("keydown", (event) => this.walk(event));
    // A finger that moves sideways over the plot moves the cursor.
    box.addEventListener("pointermove", (event) => {
      if (event.pointerType !== "mouse" && this.plot) this.move(event.clientX - this.plot.over.getBoundingClientRect().left);
    });
  }

  show(lines, endMs, seconds) {
    if (!HAS_PLOTS) return;
    this.seconds = seconds;
    let peak = 0;
    for (const { course } of lines) for (const [, value] of course) if (value > peak) peak = value;
    this.top = nice(Math.max(peak * 1.05, this.least));
    const tables = lines.map(({ course }) => [
      Float64Array.from(course, ([t]) => (t - endMs) / 1000),
      course.map(([, value]) => value),
    ]);
    const data = tables.length ? uPlot.join(tables) : [[]];
    const { clientWidth: width, clientHeight: height } = this.box;
    const key = JSON.stringify([theme(), width, height, lines.map(({ colour, dash }) => [colour, dash])]);
    if (key === this.key) { this.plot.setData(data); return; }
    this.key = key;
    const at = this.plot?.cursor.left ?? -1;
    this.plot?.destroy();
    this.plot = new uPlot(this.options(lines, width, height), data, this.box);
    if (at >= 0) this.move(at);
  }

  options(lines, width, height) {
    const look = paper();
    const axis = { stroke: look.dim, font: FONT, labelFont: FONT, ticks: { show: false }, grid: { stroke: look.line, width: 1 } };
    return {
      width, height,
      padding: [8, 8, 0, 0],
      legend: { show: false },
      cursor: { sync: { key: "skin" }, drag: { x: false, y: false }, y: false, points: { show: false } },
      scales: {
        x: { time: false, range: () => [-this.seconds, 0] },
        y: { range: () => [-BELOW * this.top, this.top] },
      },
      axes: [
        { ...axis, size: 22, gap: 2, splits: () => this.times(), values: (_, splits) => splits.map((s) => this.timeText(s)) },
        { ...axis, size: 60, gap: 4, splits: () => [0, this.top / 2, this.top], values: (_, splits) => splits.map((value) => `${+value.toPrecision(3)}${value === this.top ? ` ${this.unit}` : ""}`) },
      ],
      series: [{}, ...lines.map(({ colour, dash }) => ({ stroke: colour, dash, width: 2, points: { show: false } }))],
      hooks: { setCursor: [(plot) => this.point(plot.cursor.left >= 0 ? -1000 * plot.posToVal(plot.cursor.left, "x") : null)] },
    };
  }

  times() { return [-1, -2 / 3, -1 / 3, 0].map((share) => share * this.seconds); }

  timeText(s) {
    if (s === 0) return "0";
    return this.seconds > 60 ? `−${+(-s / 60).toFixed(1)} min` : `−${Math.round(-s)} s`;
  }

  move(left) {
    const { width, height } = this.plot.over.getBoundingClientRect();
    this.plot.setCursor({ left: Math.min(width, Math.max(0, left)), top: height / 2 });
  }

  walk(event) {
    if (!this.plot || event.ctrlKey || event.metaKey || event.altKey) return;
    const wide = this.plot.over.clientWidth;
    const at = this.plot.cursor.left >= 0 ? this.plot.cursor.left : wide;
    const to = { ArrowLeft: at - STEP_PX, ArrowRight: at + STEP_PX, Home: 0, End: wide }[event.key];
    if (to !== undefined) this.move(to);
    else if (event.key === "Escape" && this.plot.cursor.left >= 0) this.plot.setCursor({ left: -10, top: -10 });
    else return;
    event.preventDefault();
    event.stopPropagation();
  }
}

/** The point of a line that is nearest to a time and has a value, null where none is near. */
export function nearest(course, t, reachMs) {
  let best = null;
  for (const point of course) {
    if (point[1] !== null && (best === null || Math.abs(point[0] - t) <= Math.abs(best[0] - t))) best = point;
  }
  return best && Math.abs(best[0] - t) <= reachMs ? best : null;
}

/** The next round number, whose half is round too. */
export function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 4, 6, 8, 10].map((step) => step * power).find((step) => step >= value * 0.999);
}

/** Round numbers of a scale from 0 to `top` that lie at least `apart` (a share of it) from each other. */
export function roundTicks(top, share, apart) {
  const ticks = [0, top];
  const decade = 10 ** Math.floor(Math.log10(top));
  for (const power of [decade, decade / 10, decade / 100]) {
    for (const step of [5, 2, 1]) {
      const value = step * power;
      if (value < top && ticks.every((other) => Math.abs(share(other) - share(value)) >= apart)) ticks.push(value);
    }
  }
  return ticks.sort((a, b) => a - b);
}
