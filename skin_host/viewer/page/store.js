// What the server has told: parts, their last values, and their past.
import { Course, History, LONGEST_S } from "./history.js";

const HEAD = 36;
const VALID = 1;
const BEYOND = 2;
/** Health comes once a second; what is older than this does not count as known. */
const HEALTH_MS = 5000;
/** A part without frames is alive as long as its health comes. */
const HEALTH_PERIOD_MS = 1000;
/** Why a contact state is not known, as the client of the broker gives it. */
const WHY = {
  not_felt: "not all is felt",
  stale: "nothing comes in time",
  offline: "the node is offline",
  disconnected: "there is no connection",
};
/** States of health in which a part feels nothing; they are the reason, too. */
const NOT_IN_USE = ["not calibrated", "disabled"];

/** Whether a contact presses at least as hard as its force: a board at the end of its range, pads beyond theirs, or not valid. */
export function isBound({ verdict, partial, beyond }) { return verdict === null ? partial || beyond : verdict === "saturated"; }

/** In words how long ago something was; what comes while a picture is drawn is newer than the picture. */
export function ageText(atMs, nowMs) { return `${(Math.max(0, nowMs - atMs) / 1000).toFixed(0)} s`; }

export class Part {
  constructor(info) {
    this.name = info.name;
    this.node = info.node;
    this.fingertip = Boolean(info.fingertip); // on a force/torque board: it has no taxels
    this.n = info.pads.length;
    this.hasFrames = !this.fingertip && info.frames !== false;
    this.thinned = Boolean(info.thinned); // frames are left out on purpose
    this.periodMs = this.hasFrames ? info.period_ms : HEALTH_PERIOD_MS;
    this.thermal = info.pads.map((pad) => pad === "thermal");
    this.feeling = this.thermal.filter((one) => !one).length; // pads that feel pressure, as health counts taxels
    this.position = info.position_m.map((p) => p.map((x) => x * 1e3));
    this.normal = info.normal;
    this.radius = info.radius_mm;
    this.triangles = info.triangles.map((t) => ({ ...t, outline: t.outline_m.map((p) => p.map((x) => x * 1e3)) }));
    this.faults = new Set();
    this.pressure = new Float32Array(this.n);
    this.bits = new Uint8Array(this.n);
    this.raw = null;
    this.heardMs = null;
    this.received = 0;
    this.missed = 0;
    this.arrivals = [];
    this.contacts = [];
    this.state = null; // whether anything touches it: ON, OFF, UNKNOWN; null: that has not come
    this.why = null; // why it is UNKNOWN
    this.forces = new Course(this.limitMs); // of all contacts together
    this.forceOf = new Map(); // of each contact by its id
    this.noLoad = this.triangles.length ? Float32Array.from({ length: this.n }, (_, i) => this.triangleOf(i)?.no_load ?? 240) : new Float32Array(this.n);
    this.health = null;
    this.healthMs = null;
    this.past = new History(this.n, this.periodMs);
    this.pastRaw = null;
  }

  takeContacts({ contacts, state, why }, nowMs) {
    [this.contacts, this.state, this.why] = [contacts, state, why];
    this.rememberForces(nowMs);
  }

  /** Why it is not known whether anything touches it; null: it is known. */
  unknown(nowMs) {
    const unused = NOT_IN_USE.find((state) => state === this.health?.state);
    if (this.gone) return WHY[this.why];
    if (this.stale(nowMs)) return this.heardMs === null ? unused ?? "nothing has come" : "nothing comes any more";
    if (this.state === null) return "no contact state has come";
    return this.state === "UNKNOWN" ? unused ?? WHY[this.why] : null;
  }

  /** Force of all its contacts; null where it is not known whether there are any. */
  force(nowMs) {
    if (this.stale(nowMs) || (!this.contacts.length && this.state !== "OFF")) return null;
    return this.contacts.reduce((sum, contact) => sum + contact.force_n, 0);
  }

  /** Whether more may press on it than its force: not all is felt, or not to its end. */
  isLeast(nowMs) { return this.force(nowMs) === null || this.unknown(nowMs) !== null || this.contacts.some(isBound); }

  rememberForces(nowMs) {
    this.forces.add(nowMs, this.force(nowMs), this.isLeast(nowMs));
    for (const contact of this.contacts) {
      if (!this.forceOf.has(contact.id)) this.forceOf.set(contact.id, new Course(this.limitMs));
      this.forceOf.get(contact.id).add(nowMs, contact.force_n, isBound(contact));
    }
    for (const [id, course] of this.forceOf) if (course.last < nowMs - LONGEST_S * 1000) this.forceOf.delete(id);
  }

  valid(i) { return (this.bits[i] & VALID) !== 0; }

  /** Whether its board sends a byte of it; 0 stands for one that was not received, and a dead chip may send it. */
  hasRaw(i) { return this.raw !== null && (this.raw[i] !== 0 || this.valid(i)); }

  beyond(i) { return (this.bits[i] & BEYOND) !== 0; }
  triangleOf(i) { return this.triangles[Math.floor(i / 12)]; }

  /** Whether its node has stopped, or all comes too late to be true. */
  get gone() { return this.why === "offline" || this.why === "stale"; }

  /** After so long without data they have stopped: five periods, at least a second. */
  get limitMs() { return Math.max(1000, 5 * this.periodMs); }

  /** Whether the data have stopped. */
  stale(nowMs) { return this.gone || this.heardMs === null || nowMs - this.heardMs > this.limitMs; }

  /** Whether nothing is known of its single taxels, and never is where no frames are published. */
  isBlank(nowMs) { return !this.hasFrames || this.stale(nowMs); }

  take(view, nowMs) {
    const n = this.n;
    const hasRaw = (view.getUint8(1) & 1) !== 0;
    this.received = view.getUint32(24, true);
    this.missed = view.getUint32(28, true);
    const start = view.byteOffset + HEAD;
    this.pressure.set(new Float32Array(view.buffer, start, n));
    this.bits.set(new Uint8Array(view.buffer, start + 4 * n, n));
    this.raw = hasRaw ? new Uint8Array(view.buffer, start + 5 * n, n).slice() : null;
    const before = this.heardMs;
    this.hear(nowMs - 1000 * view.getFloat32(32, true));
    // By the robot's clock: what a busy browser takes all at once did not come so fast.
    const sentMs = view.getFloat64(16, true) * 1000;
    if (sentMs < this.arrivals.at(-1)?.[0]) this.arrivals = [];
    this.arrivals.push([sentMs, this.received]);
    while (this.arrivals.length > 2 && sentMs - this.arrivals[0][0] > 2000) this.arrivals.shift();
    // A page that connects again gets the last frame again.
    if (this.heardMs !== before) this.remember(this.heardMs);
    this.rememberForces(nowMs);
  }

  hear(atMs) { this.heardMs = Math.max(this.heardMs ?? -Infinity, atMs); }

  /** How many of its taxels are valid; null: not known, or not any more. */
  valids(nowMs) {
    return this.stale(nowMs) || this.isHealthOld(nowMs) ? null : this.health?.valid_taxels ?? null;
  }

  isHealthOld(nowMs) { return this.health !== null && (this.healthMs === null || nowMs - this.healthMs > HEALTH_MS); }

  /** Whether its state is not known, though its frames may come. */
  lacksHealth(nowMs) { return this.health === null || this.isHealthOld(nowMs); }

  remember(nowMs) {
    this.past.add(nowMs, this.pressure.map((value, i) => (this.bits[i] & VALID ? value : NaN)));
    if (!this.raw) return;
    this.pastRaw ??= new History(this.n, this.periodMs);
    this.pastRaw.add(nowMs, Array.from(this.raw, (byte, i) => (this.hasRaw(i) ? byte : NaN)));
  }

  /** [time, value] of a taxel between two times: kPa, or raw values less those of untouched skin. */
  course(taxel, raw, fromMs, toMs) {
    if (!raw) return this.past.course(taxel, fromMs, toMs);
    const course = this.pastRaw?.course(taxel, fromMs, toMs) ?? [];
    return course.map(([t, value]) => [t, value === null ? null : this.noLoad[taxel] - value]);
  }

  /** Frames a second that came here over the last two seconds. */
  rate(nowMs) {
    if (this.arrivals.length < 2 || this.stale(nowMs)) return 0;
    const [[t0, n0], [t1, n1]] = [this.arrivals[0], this.arrivals.at(-1)];
    return t1 > t0 ? ((n1 - n0) * 1000) / (t1 - t0) : 0;
  }
}

export class Store {
  constructor() {
    this.robot = "";
    this.version = -1;
    this.parts = [];
    this.nodes = {};
    this.status = { connected: false, error: "connecting", commands: false, nodes: {} };
  }

  part(name) { return this.parts.find((part) => part.name === name); }

  takeLayout(message) {
    this.robot = message.robot;
    this.version = message.version;
    this.nodes = message.nodes;
    const old = new Map(this.parts.map((part) => [part.name, part]));
    this.parts = message.parts.map((info) => {
      const part = new Part(info);
      const before = old.get(part.name);
      // A new calibration gives a new layout of the same taxels: their past stays.
      if (before && before.n === part.n) {
        for (const key of ["pressure", "bits", "raw", "heardMs", "received", "missed", "arrivals", "contacts", "state", "why", "forces", "forceOf", "health", "healthMs", "faults", "past", "pastRaw"]) part[key] = before[key];
      }
      return part;
    });
  }

  /** Nothing comes from the server any more: what touches the skin is not known. */
  lose(nowMs) {
    for (const part of this.parts) part.takeContacts({ contacts: [], state: "UNKNOWN", why: "disconnected" }, nowMs);
  }

  takeBytes(buffer, nowMs) {
    const view = new DataView(buffer);
    const part = this.parts[view.getUint16(2, true)];
    if (view.getUint8(0) !== 1 || view.getUint32(8, true) !== this.version || !part) return;
    if (view.getUint32(4, true) === part.n) part.take(view, nowMs);
  }

  takeHealth(message, nowMs) {
    const part = this.part(message.part);
    if (!part) return;
    part.health = message;
    part.healthMs = message.age_s === null ? null : nowMs - 1000 * message.age_s; // null: the broker had stored it
    if (!part.hasFrames && part.healthMs !== null) { part.hear(part.healthMs); part.rememberForces(nowMs); }
    part.faults = new Set((message.triangles ?? []).map((t) => `${t.board}/${t.triangle}`));
  }
}
