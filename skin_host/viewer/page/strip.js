// The course of chosen taxels over the last minute.
import { DASHES, LINES, paper, theme } from "./colours.js";
import { HISTORY_S } from "./store.js";

const LEFT = 34;
const BOTTOM = 22;
/** Noise below zero has this much room, and stays clear of the labels. */
const BELOW = 5;
/** Points farther apart than this are not joined: nothing was heard between. */
const GAP_MS = 700;

export function lineColour(i) { return LINES[theme()][i % DASHES.length]; }

export function drawStrip(canvas, store, chosen, raw, nowMs) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: w, clientHeight: h } = canvas;
  canvas.width = Math.round(w * ratio);
  canvas.height = Math.round(h * ratio);
  const ctx = canvas.getContext("2d");
  const look = paper();
  ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
  const courses = chosen.map(({ part, taxel }) => [...(store.part(part)?.course(taxel, raw) ?? [])]);
  const peak = courses.flat().reduce((top, [, value]) => (value > top ? value : top), 0);
  const top = raw ? 255 : nice(Math.max(peak * 1.1, 5));
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
    ctx.fillText(s === 0 ? (raw ? "now" : "now, kPa") : `${s} s`, x(nowMs + s * 1000), h);
  }
  courses.forEach((course, i) => {
    ctx.beginPath();
    let last = null;
    for (const [t, value] of course) {
      if (nowMs - t > HISTORY_S * 1000) continue;
      if (Number.isNaN(value)) { last = null; continue; }
      if (last === null || t - last > GAP_MS) ctx.moveTo(x(t), y(value));
      else ctx.lineTo(x(t), y(value));
      last = t;
    }
    ctx.strokeStyle = lineColour(i);
    ctx.setLineDash(DASHES[i % DASHES.length]);
    ctx.lineWidth = 2;
    ctx.stroke();
  });
  ctx.setLineDash([]);
}

/** The next round number. */
export function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 1.5, 2, 3, 4, 5, 6, 8, 10].map((step) => step * power).find((step) => step >= value * 0.999);
}
