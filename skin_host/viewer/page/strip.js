// Courses over the last minute: of chosen taxels, and of the contacts' force.
import { DASHES, LINES, paper, theme } from "./colours.js";
import { HISTORY_S } from "./store.js";

const LEFT = 34;
const BOTTOM = 22;
/** Noise below zero has this much room, and stays clear of the labels. */
const BELOW = 5;
/** Points farther apart than this are not joined: nothing was heard between. */
const GAP_MS = 700;

export function lineColour(i) { return LINES[theme()][i % DASHES.length]; }

/** The chosen taxels: kPa, or raw values less those of untouched skin. */
export function drawStrip(canvas, store, chosen, raw, nowMs) {
  const lines = chosen.map(({ part, taxel }, i) => {
    const of = store.part(part);
    const course = [...(of?.course(taxel, raw) ?? [])].map(([t, value]) => [t, raw ? of.noLoad[taxel] - value : value]);
    return { course, colour: lineColour(i), dash: DASHES[i % DASHES.length] };
  });
  drawPlot(canvas, lines, nowMs, raw ? { unit: "units", least: 20 } : { unit: "kPa", least: 5 });
}

/** Courses over the last minute: what is below zero is noise. */
export function drawPlot(canvas, lines, nowMs, { unit, least }) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: w, clientHeight: h } = canvas;
  canvas.width = Math.round(w * ratio);
  canvas.height = Math.round(h * ratio);
  const ctx = canvas.getContext("2d");
  const look = paper();
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  let peak = 0;
  for (const { course } of lines) for (const [, value] of course) if (value > peak) peak = value;
  const top = nice(Math.max(peak * 1.1, least));
  const x = (t) => LEFT + ((t - nowMs) / 1000 / HISTORY_S + 1) * (w - LEFT - 4);
  const y = (value) => Math.min(6 + (1 - value / top) * (h - BOTTOM - 6), h - BOTTOM + BELOW);
  ctx.font = "11px system-ui, sans-serif";
  ctx.fillStyle = look.dim;
  ctx.strokeStyle = look.line;
  ctx.lineWidth = 1;
  for (const share of [0, 0.5, 1]) {
    const level = Math.round(y(top * share)) + 0.5;
    ctx.beginPath();
    ctx.moveTo(LEFT, level);
    ctx.lineTo(w, level);
    ctx.stroke();
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    ctx.fillText(String(+(top * share).toPrecision(3)), LEFT - 5, level);
  }
  ctx.textBaseline = "bottom";
  for (const s of [-60, -40, -20, 0]) {
    ctx.textAlign = s === 0 ? "right" : s === -60 ? "left" : "center";
    ctx.fillText(s === 0 ? `now, ${unit}` : `${s} s`, x(nowMs + s * 1000), h);
  }
  for (const { course, colour, dash } of lines) {
    ctx.beginPath();
    let last = null;
    for (const [t, value] of course) {
      if (nowMs - t > HISTORY_S * 1000) continue;
      if (Number.isNaN(value)) { last = null; continue; }
      if (last === null || t - last > GAP_MS) ctx.moveTo(x(t), y(value));
      else ctx.lineTo(x(t), y(value));
      last = t;
    }
    ctx.strokeStyle = colour;
    ctx.setLineDash(dash);
    ctx.lineWidth = 2;
    ctx.stroke();
  }
  ctx.setLineDash([]);
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
