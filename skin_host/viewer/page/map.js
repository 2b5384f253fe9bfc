// The drawing of the skin: parts side by side, or one of them large.
import { drawer } from "./body.js";
import { paper, ramp, shareOf } from "./colours.js";
import { told } from "./panels.js";
import { ageText, isBound } from "./store.js";

const GAP_MM = 14;
const LABEL_PX = 20;
const FONT = "600 13px system-ui, sans-serif";
/** Discs smaller than this (px) have no rim: it would hide them. */
const RIM_PX = 1.2;
const TAU = 2 * Math.PI;

/** How one part is turned towards the eye; flat parts are not turned. */
class Pose {
  constructor(part) {
    const n = part.n || 1;
    this.flat = part.normal.every((v) => v[2] > 0.999);
    this.centre = [0, 1, 2].map((k) => part.position.reduce((sum, p) => sum + p[k], 0) / n);
    this.face(part);
  }

  /** Turn it so that most of it is seen. */
  face(part) {
    this.axes = this.flat ? [[1, 0, 0], [0, 1, 0], [0, 0, 1]] : faceOn(part, this.centre);
    this.project(part);
  }

  turn(part, dx, dy) {
    const [right, up] = this.axes;
    const [across, , eye] = this.axes.map((axis) => rotated(rotated(axis, up, -dx), right, -dy));
    // The eye moves, so the axes move as one; they stay at right angles however often they do.
    const towards = unit(eye);
    const side = unit(across.map((x, k) => x - dot(across, towards) * towards[k]));
    this.axes = [side, cross(towards, side), towards];
    this.project(part);
  }

  project(part) {
    const flat = (p) => {
      const d = p.map((x, k) => x - this.centre[k]);
      return [dot(d, this.axes[0]), -dot(d, this.axes[1])];
    };
    this.points = part.position.map(flat);
    this.x = Float32Array.from(this.points, (p) => p[0]);
    this.y = Float32Array.from(this.points, (p) => p[1]);
    this.towards = part.normal.map((v) => dot(v, this.axes[2]));
    this.outlines = part.triangles.map((t) => t.outline.map(flat));
    this.facing = part.triangles.map((t) => this.towards[t.first] ?? 1);
    this.place = flat;
    const corners = this.outlines.flat().concat(this.points);
    const xs = corners.map((p) => p[0]);
    const ys = corners.map((p) => p[1]);
    const all = (list, pick) => list.reduce((a, b) => pick(a, b), list[0] ?? 0);
    // A bent part keeps its room while it is turned.
    if (!this.box) this.box = [all(xs, Math.min), all(ys, Math.min), all(xs, Math.max), all(ys, Math.max)];
  }
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));

function rotated(v, axis, angle) {
  const [c, s, d] = [Math.cos(angle), Math.sin(angle), dot(axis, v)];
  const w = cross(axis, v);
  return v.map((x, k) => x * c + w[k] * s + axis[k] * d * (1 - c));
}

/** Axes that show most of a bent part: the eye where most of it faces, its long side across. */
function faceOn(part, centre) {
  let eye = [0, 0, 1];
  let most = -1;
  const n = 200;
  for (let i = 0; i < n; i++) {
    // Directions spread evenly over the sphere (a Fibonacci spiral).
    const z = 1 - (2 * i + 1) / n;
    const [r, turn] = [Math.sqrt(1 - z * z), i * 2.399963];
    const way = [r * Math.cos(turn), r * Math.sin(turn), z];
    const seen = part.normal.reduce((sum, v) => sum + Math.max(0, dot(v, way)) ** 2, 0);
    if (seen > most) [eye, most] = [way, seen];
  }
  let right = unit(cross(Math.abs(eye[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], eye));
  const up = cross(eye, right);
  // The principal axis of what the eye sees.
  let [xx, xy, yy] = [0, 0, 0];
  for (const p of part.position) {
    const d = p.map((x, k) => x - centre[k]);
    const [x, y] = [dot(d, right), dot(d, up)];
    xx += x * x; xy += x * y; yy += y * y;
  }
  right = rotated(right, eye, 0.5 * Math.atan2(2 * xy, xx - yy));
  return [right, cross(eye, right), eye];
}

export class SkinMap {
  constructor(canvas, store) {
    this.canvas = canvas;
    this.store = store;
    this.poses = new Map();
    this.shown = null; // name of the part, null for all
    this.zoom = 1;
    this.pan = [0, 0];
    this.cursor = null; // [part, taxel] under the keyboard or pointer
    this.chosen = [];
    this.raw = false;
    this.top = 50;
    this.pointed = null; // [part, id] of the contact under the pointer
    this.selected = null; // and of the one that was clicked
    this.body = null; // draws curved parts, once one is here
    this.asked = false;
    this.flattened = false; // whether curved parts have to do without it
    this.grabbed = null; // the curved part that a drag turns
  }

  get parts() {
    const one = this.shown && this.store.part(this.shown);
    return one?.n ? [one] : this.store.parts.filter((part) => part.n);
  }

  /** Parts have come or changed. */
  relayout() {
    const poses = new Map();
    for (const part of this.store.parts) {
      const old = this.poses.get(part.name);
      const pose = new Pose(part);
      if (old && !pose.flat && !old.flat) { pose.axes = old.axes; pose.project(part); }
      poses.set(part.name, pose);
    }
    this.poses = poses;
    this.body?.relayout();
    if (!this.asked && [...poses.values()].some((pose) => !pose.flat)) {
      this.asked = true;
      drawer(this.canvas).then((body) => { this.body = body; this.flattened = !body; });
    }
    this.arrange();
  }

  /** Whether a part is drawn in space. */
  solid(part) { return this.body !== null && !this.body.lost && !this.poses.get(part.name).flat; }

  fit() {
    this.zoom = 1;
    this.pan = [0, 0];
    for (const part of this.parts) this.poses.get(part.name)?.face(part);
  }

  show(name) { this.shown = name; this.fit(); this.arrange(); }

  /** Size the canvas to its place on the screen. */
  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    if (this.canvas.width !== Math.round(w * ratio) || this.canvas.height !== Math.round(h * ratio)) {
      this.canvas.width = Math.round(w * ratio);
      this.canvas.height = Math.round(h * ratio);
      this.arrange();
    }
    this.ratio = ratio;
  }

  /** Put the parts on shelves so that all are as large as can be, at one scale. */
  arrange() {
    const ctx = this.canvas.getContext("2d");
    ctx.font = FONT;
    // A name that is wider than the map is squeezed: it must not make all skin small.
    const widest = this.canvas.clientWidth || 1;
    const boxes = this.parts.map((part) => {
      const [x0, y0, x1, y1] = this.poses.get(part.name)?.box ?? [0, 0, 1, 1];
      const w = x1 - x0 + GAP_MM;
      return { part, w, own: w, h: y1 - y0 + GAP_MM, x0, y0, label: Math.min(widest, ctx.measureText(part.name).width + 16) };
    });
    this.placed = [];
    if (!boxes.length) return;
    // A label is as wide at any scale: parts that are narrower than theirs make room for it.
    let best = this.shelved(boxes);
    for (let turn = 0; turn < 4; turn++) {
      for (const box of boxes) box.w = Math.max(box.own, box.label / best.scale);
      best = this.shelved(boxes);
    }
    const labelMm = LABEL_PX / best.scale;
    const highMm = best.high + labelMm * best.shelves.length;
    let y = -highMm / 2;
    for (const shelf of best.shelves) {
      const wide = shelf.reduce((sum, b) => sum + b.w, 0);
      const high = Math.max(...shelf.map((b) => b.h));
      let x = -wide / 2;
      for (const box of shelf) {
        this.placed.push({
          part: box.part,
          dx: x + (box.w - box.own + GAP_MM) / 2 - box.x0,
          dy: y + labelMm + GAP_MM / 2 - box.y0 + (high - box.h) / 2,
          label: [x + box.w / 2, y + labelMm + (high - box.h) / 2],
          room: box.w,
        });
        x += box.w;
      }
      y += high + labelMm;
    }
    this.base = best.scale;
  }

  /** The shelves that give the largest scale. */
  shelved(boxes) {
    const w = this.canvas.clientWidth || 1;
    const h = this.canvas.clientHeight || 1;
    let best = null;
    const total = boxes.reduce((sum, box) => sum + box.w, 0);
    const widest = Math.max(...boxes.map((box) => box.w));
    for (let step = 0; step <= 60; step++) {
      const limit = (widest + ((total - widest) * step) / 60) * 1.001;
      const shelves = [[]];
      let used = 0;
      for (const box of boxes) {
        if (used + box.w > limit && shelves.at(-1).length) { shelves.push([]); used = 0; }
        shelves.at(-1).push(box);
        used += box.w;
      }
      const wide = Math.max(...shelves.map((s) => s.reduce((sum, b) => sum + b.w, 0)));
      const high = shelves.reduce((sum, s) => sum + Math.max(...s.map((b) => b.h)), 0);
      const scale = Math.min(w / wide, Math.max(20, h - LABEL_PX * shelves.length) / high);
      if (!best || scale > best.scale) best = { scale, shelves, wide, high };
    }
    return best;
  }

  get scale() { return this.base * this.zoom; }

  toScreen([x, y]) {
    return [
      this.canvas.clientWidth / 2 + (x + this.pan[0]) * this.scale,
      this.canvas.clientHeight / 2 + (y + this.pan[1]) * this.scale,
    ];
  }

  /** Zoom about a point of the canvas. */
  zoomAt(factor, sx, sy) {
    const before = this.scale;
    this.zoom = Math.min(40, Math.max(0.5, this.zoom * factor));
    const mx = sx - this.canvas.clientWidth / 2;
    const my = sy - this.canvas.clientHeight / 2;
    this.pan[0] += mx / this.scale - mx / before;
    this.pan[1] += my / this.scale - my / before;
  }

  /** Take hold of what is at a point of the canvas: dragging turns a curved part. */
  grab(sx, sy) {
    const at = (this.placed ?? []).find(({ part, dx, dy }) => {
      const { flat, box: [x0, y0, x1, y1] } = this.poses.get(part.name);
      const [left, top] = this.toScreen([x0 + dx, y0 + dy]);
      const [right, bottom] = this.toScreen([x1 + dx, y1 + dy]);
      return !flat && sx > left && sx < right && sy > top && sy < bottom;
    });
    this.grabbed = at?.part.name ?? null;
  }

  /** Move what is shown, or turn the curved part that was grabbed. */
  drag(dx, dy, slide) {
    if (this.grabbed && !slide) return this.turn([this.store.part(this.grabbed)], dx, dy);
    this.pan[0] += dx / this.scale;
    this.pan[1] += dy / this.scale;
  }

  /** Turn curved parts as if their front was moved by so many px. */
  turn(parts, dx, dy) {
    for (const part of parts) {
      const pose = part && this.poses.get(part.name);
      if (pose && !pose.flat) pose.turn(part, dx * 0.008, dy * 0.008);
    }
  }

  /** The taxel at a point of the canvas, or null. */
  pick(sx, sy) {
    let best = null;
    for (const { part, dx, dy } of this.placed ?? []) {
      const pose = this.poses.get(part.name);
      const hit = this.solid(part) && this.body.hit(part, sx, sy, this.canvas.clientWidth, this.canvas.clientHeight);
      for (let i = 0; i < part.n; i++) {
        if (pose.towards[i] < 0) continue;
        // Where skin is in front, its taxel is meant and none behind it.
        if (hit && Math.hypot(...part.position[i].map((x, k) => x - hit[k])) > 1.5 * part.radius[i] + 9 / this.scale) continue;
        const [x, y] = this.toScreen([pose.points[i][0] + dx, pose.points[i][1] + dy]);
        const away = Math.hypot(x - sx, y - sy);
        if (away < Math.max(9, part.radius[i] * this.scale * 1.2) && (!best || away < best.away)) best = { part: part.name, taxel: i, away };
      }
    }
    return best;
  }

  /** The contact whose outline holds a point of the canvas, or null. */
  contactAt(sx, sy) {
    for (const { part, dx, dy } of this.placed ?? []) {
      const pose = this.poses.get(part.name);
      for (const contact of part.contacts) {
        const near = contact.taxels.some((i) => i < part.n && pose.towards[i] >= 0
          && Math.hypot(...this.toScreen([pose.points[i][0] + dx, pose.points[i][1] + dy]).map((v, k) => v - [sx, sy][k])) < part.radius[i] * this.scale + 4);
        if (near) return { part: part.name, id: contact.id };
      }
    }
    return null;
  }

  /** Where a taxel is on the canvas, or null. */
  find(name, taxel) {
    const at = this.placed?.find(({ part }) => part.name === name);
    if (!at) return null;
    const point = this.poses.get(name).points[taxel];
    return this.toScreen([point[0] + at.dx, point[1] + at.dy]);
  }

  draw(nowMs) {
    this.resize();
    const ctx = this.canvas.getContext("2d");
    const look = paper();
    ctx.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    ctx.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    const solid = (this.placed ?? []).filter(({ part }) => this.solid(part)).map(({ part, dx, dy }) => {
      const [x, y] = this.toScreen([dx, dy]);
      return { part, pose: this.poses.get(part.name), x, y };
    });
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.body?.draw(solid, { width, height, ratio: this.ratio, scale: this.scale, raw: this.raw, top: this.top, nowMs });
    for (const at of this.placed ?? []) this.drawPart(ctx, look, at, nowMs);
    const labels = (this.placed ?? []).flatMap((at) => this.drawContacts(ctx, look, at, nowMs));
    this.labels = [];
    for (const label of labels.sort((a, b) => b.marked - a.marked)) this.drawLabel(ctx, look, label);
    this.drawMarks(ctx, look);
  }

  drawPart(ctx, look, { part, dx, dy, label, room }, nowMs) {
    const pose = this.poses.get(part.name);
    const scale = this.scale;
    const stale = part.stale(nowMs);
    const solid = this.solid(part);
    ctx.lineWidth = 1;
    part.triangles.forEach((triangle, k) => {
      // Units of several triangles have one outline.
      if (k && sameOutline(part.triangles[k - 1], triangle) && !part.faults.size) return;
      const faulty = part.faults.has(`${triangle.board}/${triangle.number}`);
      if (solid && (!faulty || pose.facing[k] < 0)) return;
      ctx.beginPath();
      pose.outlines[k].forEach((p, i) => {
        const [x, y] = this.toScreen([p[0] + dx, p[1] + dy]);
        if (i) ctx.lineTo(x, y); else ctx.moveTo(x, y);
      });
      ctx.closePath();
      ctx.globalAlpha = pose.facing[k] < 0 ? 0.25 : 1;
      if (faulty) {
        ctx.fillStyle = hatch(ctx, look.alarm);
        if (!sharesOutline(part, k)) ctx.fill();
        ctx.strokeStyle = look.alarm;
        ctx.lineWidth = 2;
        ctx.setLineDash([5, 4]);
      } else {
        ctx.strokeStyle = look.rim;
        ctx.lineWidth = 0.75;
        ctx.setLineDash([]);
      }
      ctx.stroke();
    });
    ctx.setLineDash([]);
    ctx.globalAlpha = 1;
    if (!solid) this.drawTaxels(ctx, look, part, pose, dx, dy, scale, part.isBlank(nowMs));
    const [lx, ly] = this.toScreen(label);
    ctx.font = FONT;
    ctx.textAlign = "center";
    ctx.textBaseline = "bottom";
    ctx.fillStyle = stale ? look.alarm : look.dim;
    const age = part.heardMs === null ? "no data" : `stale, ${ageText(part.heardMs, nowMs)}`;
    const words = stale ? `${part.name}: ${age}` : part.hasFrames ? part.name : `${part.name}: touches only`;
    // What does not fit without touching the next label is told by its colour, and beside Health.
    ctx.fillText(ctx.measureText(words).width + 8 < room * scale ? words : part.name, lx, ly, this.canvas.clientWidth);
  }

  drawTaxels(ctx, look, part, pose, dx, dy, scale, blank) {
    const colours = ramp();
    const buckets = new Map();
    const crosses = [];
    const squares = [];
    const rings = [];
    const w = this.canvas.clientWidth;
    const h = this.canvas.clientHeight;
    const [ox, oy] = this.toScreen([dx, dy]);
    for (let i = 0; i < part.n; i++) {
      const x = ox + pose.x[i] * scale;
      const y = oy + pose.y[i] * scale;
      // Drawn in raw values only: it lies between pads that feel pressure.
      const r = part.radius[i] * scale * (part.thermal[i] && this.raw ? 0.6 : 1);
      if (x < -r || y < -r || x > w + r || y > h + r) continue;
      const behind = pose.towards[i] < 0;
      if (part.thermal[i] && !this.raw) { if (!behind && r > 3) squares.push(x, y, r); }
      else if (blank) { if (!behind) rings.push(x, y, r, look.rim); }
      else if (this.raw ? !part.hasRaw(i) : !part.valid(i)) { if (!behind) crosses.push(x, y, r); }
      else {
        const value = this.raw ? part.noLoad[i] - part.raw[i] : part.pressure[i];
        const level = Math.round(255 * shareOf(value, this.top));
        const bucket = behind ? level + 256 : level;
        const list = buckets.get(bucket);
        if (list) list.push(x, y, r); else buckets.set(bucket, [x, y, r]);
        if (this.raw && !part.valid(i) && !part.thermal[i] && !behind) crosses.push(x, y, r);
        if (!this.raw && part.beyond(i) && !behind) rings.push(x, y, r + 2, look.alarm);
      }
    }
    // What faces away comes first, so that it lies behind.
    for (const [bucket, items] of [...buckets].sort((a, b) => b[0] - a[0])) {
      ctx.globalAlpha = bucket > 255 ? 0.2 : 1;
      ctx.fillStyle = colours[bucket % 256];
      ctx.beginPath();
      for (let k = 0; k < items.length; k += 3) {
        ctx.moveTo(items[k] + items[k + 2], items[k + 1]);
        ctx.arc(items[k], items[k + 1], items[k + 2], 0, TAU);
      }
      ctx.fill();
      // The rim keeps an untouched disc visible on the page's own colour.
      if (items[2] < RIM_PX) continue;
      ctx.strokeStyle = look.rim;
      ctx.lineWidth = Math.min(1, items[2] / 4);
      ctx.stroke();
    }
    ctx.globalAlpha = 1;
    ctx.lineWidth = Math.max(1, Math.min(2, scale / 3));
    ctx.strokeStyle = look.dim;
    ctx.beginPath();
    for (let k = 0; k < crosses.length; k += 3) {
      const [x, y, r] = [crosses[k], crosses[k + 1], crosses[k + 2]];
      const a = r * 0.62;
      ctx.moveTo(x - a, y - a); ctx.lineTo(x + a, y + a);
      ctx.moveTo(x - a, y + a); ctx.lineTo(x + a, y - a);
    }
    for (let k = 0; k < squares.length; k += 3) {
      const r = squares[k + 2];
      ctx.rect(squares[k] - r / 2, squares[k + 1] - r / 2, r, r);
    }
    ctx.stroke();
    ctx.lineWidth = Math.min(1.5, Math.max(0.75, scale / 2));
    for (let k = 0; k < rings.length; k += 4) {
      ctx.strokeStyle = rings[k + 3];
      ctx.beginPath();
      ctx.arc(rings[k], rings[k + 1], rings[k + 2], 0, TAU);
      ctx.stroke();
    }
  }

  /** Draw the contacts of a part; returns their labels, which stand above all outlines. */
  drawContacts(ctx, look, { part, dx, dy }, nowMs) {
    if (part.stale(nowMs)) return [];
    const labels = [];
    const pose = this.poses.get(part.name);
    for (const contact of part.contacts) {
      const seen = contact.taxels.filter((i) => i < part.n);
      const points = seen.flatMap((i) => around(this.toScreen([pose.points[i][0] + dx, pose.points[i][1] + dy]), part.radius[i] * this.scale + 4));
      if (!points.length) continue;
      const hull = convex(points);
      ctx.beginPath();
      hull.forEach(([x, y], i) => { if (i) ctx.lineTo(x, y); else ctx.moveTo(x, y); });
      ctx.closePath();
      // Of a contact on the far side there is a faint outline, and its force.
      const alpha = ctx.globalAlpha = seen.some((i) => pose.towards[i] >= 0) ? 1 : 0.45;
      const marked = is(this.pointed, part, contact) || is(this.selected, part, contact);
      halo(ctx, look, marked ? 4 : 2, marked);
      let [cx, cy] = [0, 1].map((k) => hull.reduce((sum, p) => sum + p[k], 0) / hull.length);
      if (contact.centroid_m) {
        const p = pose.place(contact.centroid_m.map((x) => x * 1e3));
        [cx, cy] = this.toScreen([p[0] + dx, p[1] + dy]);
        ctx.beginPath();
        ctx.moveTo(cx - 6, cy); ctx.lineTo(cx + 6, cy);
        ctx.moveTo(cx, cy - 6); ctx.lineTo(cx, cy + 6);
        halo(ctx, look, 2);
      }
      labels.push({ hull, at: [cx, cy], alpha, marked, text: `#${contact.id}  ${told(contact.force_n, contact.force_n < 10 ? 2 : 1, "N", isBound(contact))}` });
      ctx.globalAlpha = 1;
    }
    return labels;
  }

  /** Words beside an outline, on the side where there is room and no other words are. Those that find none stand in the table alone, but for a contact that is marked. */
  drawLabel(ctx, look, { hull, at: [cx, cy], alpha, marked, text }) {
    ctx.font = FONT;
    const wide = ctx.measureText(text).width;
    const [xs, ys] = [0, 1].map((k) => hull.map((p) => p[k]));
    const [left, right, top, bottom] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const places = [[right + 6, cy - 9], [left - 6 - wide, cy - 9], [cx - wide / 2, top - 21], [cx - wide / 2, bottom + 3]];
    const free = ([x, y]) => x > 0 && y > 0 && x + wide < this.canvas.clientWidth && y + 18 < this.canvas.clientHeight
      && this.labels.every(([ox, oy, ow]) => x > ox + ow || ox > x + wide || y > oy + 18 || oy > y + 18);
    const place = places.find(free) ?? (marked ? places[0] : null);
    if (!place) return;
    const [x, y] = place;
    this.labels.push([x, y, wide]);
    ctx.globalAlpha = alpha;
    ctx.textAlign = "left";
    ctx.textBaseline = "middle";
    ctx.lineWidth = 4;
    ctx.strokeStyle = look.back;
    ctx.strokeText(text, x, y + 9);
    ctx.fillStyle = look.text;
    ctx.fillText(text, x, y + 9);
    ctx.globalAlpha = 1;
  }

  drawMarks(ctx, look) {
    this.chosen.forEach(({ part, taxel, colour }) => {
      const at = this.find(part, taxel);
      if (!at) return;
      const r = this.store.part(part).radius[taxel] * this.scale + 2.5;
      ctx.globalAlpha = this.poses.get(part).towards[taxel] < 0 ? 0.45 : 1;
      ctx.beginPath();
      ctx.arc(...at, r, 0, TAU);
      ctx.lineWidth = 3;
      ctx.strokeStyle = colour;
      ctx.stroke();
    });
    ctx.globalAlpha = 1;
    const at = this.cursor && this.find(this.cursor.part, this.cursor.taxel);
    if (at) {
      ctx.beginPath();
      ctx.arc(...at, this.store.part(this.cursor.part).radius[this.cursor.taxel] * this.scale + 4, 0, TAU);
      ctx.lineWidth = 1.5;
      ctx.strokeStyle = look.text;
      ctx.stroke();
    }
  }
}

function sameOutline(a, b) {
  return a.outline.length === b.outline.length && a.outline.every((p, i) => p.every((x, k) => x === b.outline[i][k]));
}

/** Whether an earlier triangle has filled this outline already. */
function sharesOutline(part, k) {
  return k > 0 && sameOutline(part.triangles[k - 1], part.triangles[k]) && part.faults.has(`${part.triangles[k - 1].board}/${part.triangles[k - 1].number}`);
}

/** Whether a contact is the one that was pointed at or selected. */
function is(one, part, contact) { return one?.part === part.name && one.id === contact.id; }

function halo(ctx, look, width, marked = false) {
  ctx.lineJoin = "round";
  ctx.lineWidth = width + 3;
  ctx.strokeStyle = look.back;
  ctx.stroke();
  ctx.lineWidth = width;
  ctx.strokeStyle = marked ? look.alarm : look.text;
  ctx.stroke();
}

function around([x, y], r) {
  return Array.from({ length: 8 }, (_, i) => [x + r * Math.cos((i * TAU) / 8), y + r * Math.sin((i * TAU) / 8)]);
}

/** Andrew's monotone chain. */
function convex(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (list) => {
    const chain = [];
    for (const p of list) {
      while (chain.length > 1) {
        const [a, b] = [chain.at(-2), chain.at(-1)];
        if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
        chain.pop();
      }
      chain.push(p);
    }
    chain.pop();
    return chain;
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

let hatching = {};

function hatch(ctx, colour) {
  if (hatching.colour !== colour) {
    const tile = document.createElement("canvas");
    tile.width = tile.height = 8;
    const pen = tile.getContext("2d");
    pen.strokeStyle = colour;
    pen.globalAlpha = 0.55;
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (const d of [-8, 0, 8]) { pen.moveTo(d, 8); pen.lineTo(d + 8, 0); }
    pen.stroke();
    hatching = { colour, pattern: ctx.createPattern(tile, "repeat") };
  }
  return hatching.pattern;
}
