// Wiring: the WebSocket, the tools, the keys, and when to draw.
import { calibrated, inTaxels } from "./calibrated.js";
import { DASHES, paper, ramp, shareOf, theme } from "./colours.js";
import { SkinMap } from "./map.js";
import { isLeast, put, showContacts, showHealth, showParts, told } from "./panels.js";
import { isBound, Store } from "./store.js";
import { HAS_PLOTS, lineColour, nearest, Plot, roundTicks } from "./strip.js";

const $ = (id) => document.getElementById(id);
const MOST_CHOSEN = 6;
const RAW_AGAIN_MS = 20000;
/** The scale follows the highest pressure of this time. */
const AUTO_MS = 10000;
/** Plots are drawn again after this time. */
const PLOT_MS = 100;

const store = new Store();
const map = new SkinMap($("map"), store);
let socket = null;
let link = "connecting";
let dirty = true;
/** The calibration that is going on: of which part (null: the whole skin), how many nodes were asked, and their answers. */
let calibrating = null;
/** Nodes that have refused raw values since they were asked last. */
const refused = new Set();
let endedSaid = "";
let notice = null;
let peaks = [];
let restored = false;
/** Plots end now, or at the time when they were held. */
let heldMs = null;
let held = new Map();
/** Where the plots' cursor is, in ms before their end. */
let agoMs = null;
const strip = new Plot($("strip"), { unit: "kPa", least: 5, point: pointTo });
const force = new Plot($("force"), { unit: "N", least: 1, point: pointTo });

// --- the server -------------------------------------------------------------------------------

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => { link = "open"; };
  socket.onmessage = ({ data }) => take(data);
  socket.onclose = () => {
    link = "lost";
    dirty = true;
    store.lose(performance.now());
    store.status = { ...store.status, connected: false };
    if (calibrating) say("The page lost its server: health shows whether the skin was calibrated.", 15000, "warn");
    calibrating = null;
    setTimeout(connect, 1000);
  };
}

function take(data) {
  dirty = true;
  if (data instanceof ArrayBuffer) return store.takeBytes(data, performance.now());
  const message = JSON.parse(data);
  if (message.type === "layout") {
    store.takeLayout(message);
    if (map.shown && !store.part(map.shown)) map.shown = null;
    if (!restored) {
      restored = true;
      map.chosen = recalled(`chosen-${message.robot}`);
    }
    map.chosen = map.chosen.filter(({ part, taxel }) => taxel < (store.part(part)?.n ?? 0));
    map.relayout();
    showChosen();
    document.title = `${message.robot} skin`;
    $("robot").textContent = message.robot;
  } else if (message.type === "status") {
    const isBack = message.connected && !store.status.connected;
    store.status = message;
    if (isBack && map.raw) askRaw();
  } else if (message.type === "contacts") {
    const part = store.part(message.part);
    if (part) part.takeContacts(message, performance.now());
  } else if (message.type === "health") store.takeHealth(message, performance.now());
  else if (message.type === "answer") answered(message);
}

/** Send a wish; whether there is a connection for it. */
function send(wish) {
  if (socket?.readyState !== WebSocket.OPEN) return false;
  socket.send(JSON.stringify(wish));
  return true;
}

function answered(message) {
  if (message.do === "raw") return message.ok || !map.raw || refuseRaw(message);
  if (message.do === "calibrate") return takeCalibration(message);
  if (!message.ok) return say(message.error, 8000);
  if (message.do === "record") return say(`Recording to ${message.result.file}`, 4000, "ok");
  if (message.do === "mark") return say(`Mark ${message.result.marks}`, 2000, "ok");
  if (message.do === "stop") {
    const { file, messages, marks, gaps } = message.result;
    const lost = gaps ? `, the broker was lost ${gaps === 1 ? "once" : `${gaps} times`}` : "";
    return say(`Recorded ${messages} messages, ${marks} of them marks${lost}: ${file}`, 10000, gaps ? "warn" : "ok");
  }
}

/** Show what the nodes found when all have answered, an error at once. */
function takeCalibration(answer) {
  if (!calibrating) return;
  const { part, asked, answers } = calibrating;
  answers.push(answer);
  const isWhole = answers.length >= asked;
  if (isWhole) calibrating = null;
  if (!isWhole && answer.ok) return;
  const { text, level, ms } = calibrated(answers, part);
  say(text, ms, level);
}

function say(text, ms, level = "alarm") {
  notice = { text, until: performance.now() + ms, level };
  dirty = true;
}

// --- what is shown ----------------------------------------------------------------------------

function pick(name) { map.show(name); remember("part", name ?? ""); dirty = true; }

function step(by) {
  const names = [null, ...store.parts.map((part) => part.name)];
  pick(names[(names.indexOf(map.shown) + by + names.length) % names.length]);
}

function nodesShown() { return [...new Set(map.parts.map((part) => part.node))]; }

/** Whether a node takes commands, as far as is known. */
function takesCommands(node) { return Boolean(store.nodes[node]?.commands) && store.status.nodes[node] !== false; }

function mayCommand() { return link === "open" && store.status.connected && store.status.commands && nodesShown().some(takesCommands); }

function setRaw(on) {
  if (on && !mayCommand()) return say("Raw values are sent on request, which no node takes from this page now.", 4000);
  map.raw = on;
  peaks = [];
  $("show-raw").setAttribute("aria-pressed", String(on));
  $("show-pressure").setAttribute("aria-pressed", String(!on));
  if (on) askRaw();
  dirty = true;
}

/** Nodes that send raw values, or have not refused to. */
function rawNodes() { return [...new Set(store.parts.map((part) => part.node))].filter((node) => takesCommands(node) && !refused.has(node)); }

function askRaw() {
  refused.clear();
  for (const node of rawNodes()) send({ do: "raw", node });
}

/** Raw values are left only when no node sends any. */
function refuseRaw({ node, error }) {
  refused.add(node);
  if (rawNodes().length) return;
  say(error, 8000);
  setRaw(false);
}

setInterval(() => { if (map.raw && mayCommand()) askRaw(); }, RAW_AGAIN_MS);

/** Open a dialog; whether it was confirmed. */
async function asked(dialog) {
  dialog.returnValue = "";
  dialog.showModal();
  await new Promise((done) => dialog.addEventListener("close", done, { once: true }));
  return dialog.returnValue === "yes";
}

/** What a calibration from here is of: the part that is shown, or the whole skin. */
async function calibrate() {
  if (calibrating || !mayCommand()) return;
  const part = store.part(map.shown) && !store.part(map.shown).fingertip ? map.shown : null;
  put($("confirm-title"), `Calibrate ${part ?? "the whole skin"}?`);
  put($("confirm-words"), `Leave ${part ?? "the whole skin"} untouched until it is done. The new calibration replaces the old one.`);
  const nodes = nodesShown();
  if (!await asked($("confirm"))) return;
  const sent = nodes.filter((node) => send(part ? { do: "calibrate", node, part } : { do: "calibrate", node })).length;
  if (!sent) return say("Nothing was calibrated: the page has no connection to its server.", 8000);
  calibrating = { part, asked: sent, answers: [] };
  say(`Calibrating: leave ${part ?? "the skin"} untouched.`, 120000, "ok");
}

function record() {
  if (!$("record").hidden) send({ do: recording() ? "stop" : "record" });
}

/** The recording in progress, or nothing. */
function recording() { return store.status.recording?.seconds === undefined ? null : store.status.recording; }

async function mark() {
  if (!recording()) return;
  const began = performance.now();
  $("note-text").value = "";
  if (!await asked($("note"))) return;
  const agoS = Math.min(600, (performance.now() - began) / 1000);
  send({ do: "mark", text: $("note-text").value.slice(0, 200), ago_s: agoS });
}

function showRecording() {
  const now = recording();
  const button = $("record");
  button.hidden = !store.status.commands || !store.status.connected && !now;
  button.setAttribute("aria-pressed", String(Boolean(now)));
  const minutes = now ? `${Math.floor(now.seconds / 60)}:${String(now.seconds % 60).padStart(2, "0")}` : "";
  put(button, now ? `stop ${minutes}` : "record");
  button.title = now ? `${now.file}, ${now.marks} marks: end the recording (o)` : "Record the robot's messages (o)";
  $("mark").hidden = !now;
  const ended = store.status.recording?.ended ?? "";
  if (ended && ended !== endedSaid) say(ended, 15000, "warn");
  endedSaid = ended;
}

function choose(found) {
  if (!found) return;
  const { part, taxel } = found;
  const at = map.chosen.findIndex((one) => one.part === part && one.taxel === taxel);
  if (at >= 0) map.chosen.splice(at, 1);
  else map.chosen.push({ part, taxel });
  if (map.chosen.length > MOST_CHOSEN) map.chosen.shift();
  showChosen();
}

/** A piece of a line as it is drawn over time: by its dashes lines can be told without hues. */
function sample(colour, dash) {
  const picture = $("line").content.firstElementChild.cloneNode(true);
  picture.firstElementChild.setAttribute("stroke", colour);
  picture.firstElementChild.setAttribute("stroke-dasharray", dash.join(" "));
  return picture;
}

function showChosen() {
  if (restored) remember(`chosen-${store.robot}`, JSON.stringify(map.chosen.map(({ part, taxel }) => ({ part, taxel }))));
  map.chosen.forEach((one, i) => { one.colour = lineColour(i); });
  const list = $("chosen");
  list.replaceChildren(...map.chosen.map(({ part, taxel, colour }, i) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.title = "Forget this taxel";
    const line = sample(colour, DASHES[i % DASHES.length]);
    const text = document.createElement("span");
    button.append(line, text);
    button.addEventListener("click", () => choose(map.chosen[i]));
    item.append(button);
    return item;
  }));
  if (!map.chosen.length) {
    const hint = document.createElement("li");
    hint.className = "hint";
    hint.textContent = "Click taxels to see their course.";
    list.append(hint);
  }
  dirty = true;
}

function signed(number) { return number < 0 ? `−${-number}` : `+${number}`; }

function value(part, taxel) {
  if (part.stale(performance.now())) return "stale";
  if (!part.hasFrames) return "no frames are published";
  if (map.raw && part.raw && !part.hasRaw(taxel)) return "raw 0, or not received";
  if (map.raw) return part.raw ? `raw ${part.raw[taxel]} (${signed(part.raw[taxel] - part.noLoad[taxel])})` : "no raw value";
  if (part.thermal[taxel]) return "feels temperature";
  if (!part.valid(taxel)) return "not valid";
  return `${part.pressure[taxel].toFixed(1)} kPa${part.beyond(taxel) ? ", beyond range" : ""}`;
}

function showTip() {
  const tip = $("tip");
  const at = map.cursor && map.find(map.cursor.part, map.cursor.taxel);
  tip.hidden = !at;
  if (!at) return;
  const part = store.part(map.cursor.part);
  const triangle = part.triangleOf(map.cursor.taxel);
  tip.textContent = `${part.name} ${map.cursor.taxel}: ${value(part, map.cursor.taxel)}\nboard ${triangle.board}, triangle ${triangle.number}, pad ${map.cursor.taxel % 12}`;
  const x = Math.min(at[0] + 14, $("stage").clientWidth - tip.offsetWidth - 4);
  tip.style.left = `${Math.max(4, x)}px`;
  const y = at[1] + 16 + tip.offsetHeight > $("map").clientHeight ? at[1] - tip.offsetHeight - 12 : at[1] + 14;
  tip.style.top = `${$("drawing").offsetTop + y}px`; // below the banner
}

/** Names of some parts, or how many there are where they are many. */
function named(parts) {
  if (parts.length === store.parts.length && parts.length > 2) return `all ${parts.length} parts`;
  return parts.length > 3 ? `${parts.length} parts` : parts.map((part) => part.name).join(", ");
}

function isUncalibrated(part) { return part.heardMs === null && part.health?.state === "not calibrated"; }

function staleText(stale) {
  const uncalibrated = stale.filter(isUncalibrated);
  return uncalibrated.length === stale.length ? `${named(stale)}: not calibrated` : `no data from ${named(stale)}`;
}

function showStatus(nowMs) {
  const status = $("status");
  // A node whose parts others have now may be offline for ever.
  const nodes = Object.entries(store.status.nodes ?? {}).filter(([node]) => store.parts.some((part) => part.node === node));
  const [offline, unknown] = [false, null].map((state) => nodes.filter(([, online]) => online === state).map(([node]) => node).join(", "));
  const stale = store.parts.filter((part) => part.stale(nowMs));
  let [text, level] = ["", "ok"];
  if (link !== "open") [text, level] = [link === "lost" ? "this page has lost its server; trying again" : "connecting", link === "lost" ? "alarm" : "wait"];
  else if (!store.status.connected) [text, level] = [store.status.error || "connecting", "alarm"];
  else if (!store.parts.length) [text, level] = [store.status.error || "no node has published what it is: is `skin run` running?", store.status.error ? "alarm" : "wait"];
  else if (offline) [text, level] = [`node ${offline} is offline`, "alarm"];
  else if (stale.length) [text, level] = [staleText(stale), "alarm"];
  else if (unknown) [text, level] = [`not known whether node ${unknown} is online`, "wait"];
  else text = `live, ${inTaxels(store.parts.reduce((sum, part) => sum + part.feeling, 0))}`;
  status.dataset.level = level;
  if (status.textContent !== text) status.textContent = text;
  const banner = $("banner");
  const shown = map.parts;
  const uncalibrated = stale.length > 0 && stale.every(isUncalibrated) && store.status.connected && link !== "lost";
  const allStale = shown.length > 0 && shown.every((part) => part.stale(nowMs));
  if (notice && nowMs > notice.until) notice = null;
  const words = notice?.text ?? (link === "lost" || (store.parts.length && (!store.status.connected || allStale)) ? (uncalibrated ? text : `Stale: ${text}`) : rawWords(nowMs));
  banner.hidden = !words;
  banner.style.background = notice ? `var(--${notice.level})` : "";
  if (banner.textContent !== words) banner.textContent = words;
  document.body.dataset.stale = String(allStale || link !== "open" || !store.status.connected);
}

/** What is missing while raw values are shown. */
function rawWords(nowMs) {
  const without = map.raw ? map.parts.filter((part) => !part.raw && !part.isBlank(nowMs)) : [];
  const nodes = rawNodes();
  if (without.some((part) => nodes.includes(part.node))) return "Waiting for raw values";
  return without.length ? `No raw values are sent of ${named(without)}` : "";
}

/** The next number of 1, 2, 5, 10, 20, ... */
function nextRound(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((step) => step * power).find((step) => step >= value * 0.999);
}

function showScale(nowMs) {
  const wanted = $("scale").value;
  if (wanted !== "auto" && !map.raw) map.top = Number(wanted);
  else {
    let peak = 0;
    for (const part of map.parts) {
      if (part.isBlank(nowMs) || (map.raw && !part.raw)) continue;
      for (let i = 0; i < part.n; i++) {
        if (!part.valid(i)) continue;
        const value = map.raw ? part.noLoad[i] - part.raw[i] : part.pressure[i];
        if (value > peak) peak = value;
      }
    }
    peaks = [...peaks.filter(([t, p]) => nowMs - t < AUTO_MS && p > peak), [nowMs, peak]];
    map.top = nextRound(Math.max(map.raw ? 20 : 10, peaks[0][1]));
  }
  $("scale").disabled = map.raw;
  const share = (value) => shareOf(value, map.top);
  // Room for a number, for the unit with the last, and for the words of the first raw value.
  const apart = 46 / Math.max(200, $("ticks").clientWidth);
  const first = map.raw ? 2.4 * apart : 0;
  const values = roundTicks(map.top, share, apart).filter((value) => [0, map.top].includes(value) || (share(value) > first && share(value) < 1 - 1.6 * apart));
  const labels = values.map((value) => (map.raw && value ? `−${+value.toPrecision(4)}` : `${+value.toPrecision(4)}`));
  if (map.raw) labels[0] = "raw = no-load";
  else labels[labels.length - 1] += " kPa";
  const ticks = $("ticks");
  if (ticks.dataset.shown !== labels.join()) {
    ticks.dataset.shown = labels.join();
    ticks.replaceChildren(...labels.map((text, i) => {
      const tick = document.createElement("span");
      tick.textContent = text;
      tick.style.left = `${100 * share(values[i])}%`;
      return tick;
    }));
  }
}

// --- plots ------------------------------------------------------------------------------------

function pointTo(ms) {
  if (ms !== agoMs) dirty = true;
  agoMs = ms;
}

function hold(on) {
  heldMs = on ? performance.now() : null;
  held = new Map();
  $("pause").setAttribute("aria-pressed", String(on));
  dirty = true;
}

/** A course between two times; of held plots what was seen when they were held. */
function courseOf(key, take) {
  if (heldMs === null) return take();
  if (!held.has(key)) held.set(key, take());
  return held.get(key);
}

/** What the plots show, until they are drawn again. */
let plotted = { chosen: [], forces: [], endMs: 0, seconds: 60 };

function showPlots(nowMs) {
  const endMs = heldMs ?? nowMs;
  const seconds = Number($("length").value);
  const fromMs = endMs - seconds * 1000;
  const chosen = map.chosen.map(({ part, taxel, colour }, i) => ({
    course: courseOf(`${part} ${taxel} ${map.raw} ${seconds}`, () => store.part(part)?.course(taxel, map.raw, fromMs, endMs) ?? []),
    colour,
    dash: DASHES[i % DASHES.length],
  }));
  [strip.unit, strip.least] = map.raw ? ["units", 20] : ["kPa", 5];
  strip.show(chosen, endMs, seconds);
  const forces = forceLines(seconds, fromMs, endMs);
  force.show(forces, endMs, seconds);
  plotted = { chosen, forces, endMs, seconds };
  const list = $("forces");
  const key = JSON.stringify([theme(), forces.map(({ name }) => name)]);
  if (list.dataset.shown !== key) {
    list.dataset.shown = key;
    list.replaceChildren(...forces.map(({ colour, dash }) => {
      const item = document.createElement("li");
      item.append(sample(colour, dash), document.createElement("span"));
      return item;
    }));
  }
}

/** Write the values under the plots: those at the cursor, and the present ones with each picture, as the table of contacts has them. */
function showValues(nowMs) {
  const { chosen, forces, endMs, seconds } = plotted;
  const atMs = agoMs === null ? null : endMs - agoMs;
  const reachMs = Math.max(700, seconds * 10);
  const at = (course) => nearest(course, atMs, reachMs);
  $("at").hidden = atMs === null && heldMs === null && HAS_PLOTS;
  const words = [heldMs === null ? "" : `held ${((nowMs - heldMs) / 1000).toFixed(0)} s ago`, atMs === null ? "" : `at −${(agoMs / 1000).toFixed(agoMs < 100000 ? 1 : 0)} s`];
  put($("at"), HAS_PLOTS ? words.filter(Boolean).join(", ") : "There are no plots: this installation lacks uPlot. Install it again where npm or PyPI can be reached.");
  map.chosen.forEach(({ part, taxel }, i) => {
    const text = $("chosen").children[i]?.querySelector("span");
    const of = store.part(part);
    if (!text || !of) return;
    const seen = atMs === null ? null : at(chosen[i]?.course ?? [])?.[1] ?? null;
    const then = seen === null ? "–" : map.raw ? `${signed(-Math.round(seen))} units` : `${seen.toFixed(1)} kPa`;
    put(text, `${part} ${taxel}: ${atMs === null ? value(of, taxel) : then}`);
  });
  forces.forEach(({ name, course, present }, i) => {
    const isNow = atMs === null && heldMs === null;
    const [, seen, isLeastThen] = (isNow ? [nowMs, ...present(nowMs)] : atMs === null ? course.at(-1) : at(course)) ?? [];
    put($("forces").children[i].lastChild, `${name}: ${name === "total" && !Number.isFinite(seen) ? "not known" : told(seen, 2, "N", isLeastThen)}`);
  });
}

/** Force of all contacts of the parts that are shown, and of the selected one. */
function forceLines(seconds, fromMs, endMs) {
  const look = paper();
  const total = courseOf(`force ${map.shown} ${seconds}`, () => {
    const courses = shownParts().map((part) => part.forces.between(fromMs, endMs));
    if (courses.length === 1) return courses[0];
    // One course for all parts: each part's force counts until it says another.
    const events = courses.flatMap((course, k) => course.map(([t, value, least]) => [t, k, value, least])).sort((a, b) => a[0] - b[0]);
    // Nothing is known of a part before it says so; with others, a sum is the least that there is.
    const now = courses.map(() => ({ value: null, least: true }));
    let [sum, unknown, bounds] = [0, courses.length, courses.length];
    return events.map(([t, k, value, least]) => {
      sum = Math.max(0, sum + (value ?? 0) - (now[k].value ?? 0));
      unknown += (value === null) - (now[k].value === null);
      bounds += least - now[k].least;
      now[k] = { value, least };
      return [t, unknown && sum < 1e-9 ? null : sum, bounds > 0];
    });
  });
  const lines = [{ name: "total", course: total, present: presentForce, colour: look.text, dash: [] }];
  const one = map.selected && store.part(map.selected.part)?.forceOf.get(map.selected.id);
  if (one) lines.push({ name: `#${map.selected.id}`, present: presentForceOf(map.selected), course: courseOf(`force of ${map.selected.part} ${map.selected.id} ${seconds}`, () => one.between(fromMs, endMs)), colour: look.alarm, dash: [6, 3] });
  return lines;
}

/** The present force of all contacts of the parts that are shown, null if nothing is known; and whether it is a bound. */
function presentForce(nowMs) {
  const known = shownParts().map((part) => part.force(nowMs));
  const sum = known.reduce((total, force) => total + (force ?? 0), 0);
  const isKnown = sum >= 1e-9 || (known.length > 0 && !known.includes(null));
  return [isKnown ? sum : null, isLeast(shownParts(), nowMs)];
}

/** The same of one contact. */
function presentForceOf({ part: name, id }) {
  return (nowMs) => {
    const part = store.part(name);
    const contact = part && !part.stale(nowMs) && part.contacts.find((one) => one.id === id);
    return contact ? [contact.force_n, isBound(contact)] : [null, true];
  };
}

/** The parts whose contacts and health are shown: the chosen one, or all. */
function shownParts() { return store.parts.filter((part) => !map.shown || part.name === map.shown); }

function pointAt(contact) { map.pointed = contact; dirty = true; }

function select(contact) {
  const same = map.selected?.part === contact?.part && map.selected?.id === contact?.id;
  map.selected = same ? null : contact;
  dirty = true;
}

function showRamp() {
  const colours = ramp();
  const ctx = $("ramp").getContext("2d");
  colours.forEach((colour, i) => { ctx.fillStyle = colour; ctx.fillRect(i, 0, 1, 1); });
  document.documentElement.style.setProperty("--zero", colours[0]);
  document.documentElement.style.setProperty("--peak", colours[255]);
}

let drawnMs = 0;
let plottedMs = 0;

function frame(nowMs) {
  // Ages must go on when nothing comes.
  if (dirty || nowMs - drawnMs > 250) {
    const began = performance.now();
    dirty = false;
    drawnMs = nowMs;
    document.body.dataset.many = String(map.parts.length > 6);
    showScale(nowMs);
    map.draw(nowMs);
    document.body.dataset.drawMs = (performance.now() - began).toFixed(1);
    $("flattened").hidden = !map.flattened && !map.body?.lost;
    showTip();
    showStatus(nowMs);
    showParts($("parts"), store, map.shown, nowMs, pick);
    showContacts($("contacts"), $("no-contacts"), shownParts(), map, nowMs, pointAt, select);
    showHealth($("health"), $("shared"), shownParts(), nowMs);
    if (nowMs - plottedMs > PLOT_MS) {
      plottedMs = nowMs;
      for (const part of store.parts) part.rememberForces(nowMs);
      showPlots(nowMs);
    }
    showValues(nowMs);
    showRecording();
    $("calibrate").hidden = !store.status.commands;
    $("calibrate").disabled = calibrating !== null || !mayCommand();
    $("show-raw").disabled = !map.raw && !mayCommand();
    document.body.dataset.draws = String(Number(document.body.dataset.draws ?? 0) + 1);
  }
  requestAnimationFrame(frame);
}

// --- pointer, wheel, keys ---------------------------------------------------------------------

const pointers = new Map();
let moved = 0;

$("map").addEventListener("pointerdown", (event) => {
  $("map").setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
  if (pointers.size === 1) {
    moved = 0;
    map.grab(event.offsetX, event.offsetY);
  }
});
$("map").addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  const here = [event.offsetX, event.offsetY];
  if (!before) {
    map.cursor = map.pick(...here);
    map.pointed = map.contactAt(...here);
  } else if (pointers.size === 2) {
    const [other] = [...pointers].filter(([id]) => id !== event.pointerId).map(([, at]) => at);
    const apart = (at) => Math.hypot(at[0] - other[0], at[1] - other[1]) || 1;
    map.zoomAt(apart(here) / apart(before), (here[0] + other[0]) / 2, (here[1] + other[1]) / 2);
    map.drag((here[0] - before[0]) / 2, (here[1] - before[1]) / 2, true);
    pointers.set(event.pointerId, here);
    moved = 99;
  } else {
    moved += Math.abs(here[0] - before[0]) + Math.abs(here[1] - before[1]);
    if (moved > 5) map.drag(here[0] - before[0], here[1] - before[1], event.shiftKey);
    pointers.set(event.pointerId, here);
  }
  dirty = true;
});
for (const kind of ["pointerup", "pointercancel"]) {
  $("map").addEventListener(kind, (event) => {
    if (pointers.delete(event.pointerId) && kind === "pointerup" && moved <= 5) {
      const contact = map.contactAt(event.offsetX, event.offsetY);
      if (contact) map.selected = contact;
      choose(map.pick(event.offsetX, event.offsetY));
    }
  });
}
$("map").addEventListener("pointerleave", () => { if (!pointers.size) { map.cursor = null; map.pointed = null; } dirty = true; });
$("map").addEventListener("wheel", (event) => {
  event.preventDefault();
  map.zoomAt(Math.exp(-event.deltaY * 0.0015), event.offsetX, event.offsetY);
  dirty = true;
}, { passive: false });

function zoom(factor) {
  map.zoomAt(factor, map.canvas.clientWidth / 2, map.canvas.clientHeight / 2);
  dirty = true;
}

function walk(by) {
  const parts = map.parts;
  if (!parts.length) return;
  const taxels = parts.flatMap((part) => Array.from({ length: part.n }, (_, taxel) => ({ part: part.name, taxel })));
  const at = map.cursor ? taxels.findIndex((one) => one.part === map.cursor.part && one.taxel === map.cursor.taxel) : -Math.max(by, 0);
  map.cursor = taxels[(at + by + taxels.length) % taxels.length];
  // Enter chooses it; a button that has the focus would take that.
  $("map").focus({ preventScroll: true });
  dirty = true;
}

function setTheme(name) {
  document.documentElement.dataset.theme = name;
  showRamp();
  showChosen();
}

/** What was chosen before the page was loaded again. */
function recalled(key) {
  try {
    const found = JSON.parse(remembered(key) ?? "[]");
    return found.filter(({ part, taxel }) => typeof part === "string" && Number.isInteger(taxel) && taxel >= 0).slice(0, MOST_CHOSEN);
  } catch { return []; }
}

function remember(key, text) {
  try { localStorage.setItem(`skin-${key}`, text); } catch { /* a browser may forbid it */ }
}

function remembered(key) {
  try { return localStorage.getItem(`skin-${key}`); } catch { return null; }
}

const keys = {
  ArrowLeft: () => step(-1), ArrowRight: () => step(1), 0: () => pick(null), a: () => pick(null),
  "+": () => zoom(1.25), "=": () => zoom(1.25), "-": () => zoom(0.8), f: () => { map.fit(); dirty = true; },
  ",": () => walk(-1), ".": () => walk(1), Enter: () => choose(map.cursor),
  Escape: () => { map.chosen = []; map.cursor = null; map.selected = null; showChosen(); },
  p: () => hold(heldMs === null), r: () => setRaw(!map.raw), c: calibrate, o: record, m: mark, t: () => { setTheme(theme() === "dark" ? "light" : "dark"); remember("theme", theme()); },
  "?": () => $("keys").showModal(),
};

/** Shift and an arrow turn the curved parts that are shown. */
const TURNS = { ArrowLeft: [-12, 0], ArrowRight: [12, 0], ArrowUp: [0, -12], ArrowDown: [0, 12] };

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
  if (event.target.matches("select") || (event.key === "Enter" && event.target !== $("map"))) return;
  if (event.shiftKey && TURNS[event.key]) {
    map.turn(map.parts, ...TURNS[event.key]);
    dirty = true;
    return event.preventDefault();
  }
  const digit = /^[1-9]$/.test(event.key) && store.parts[Number(event.key) - 1];
  const act = digit ? () => pick(digit.name) : keys[event.key];
  if (act) { event.preventDefault(); act(); }
});

$("show-pressure").addEventListener("click", () => setRaw(false));
$("show-raw").addEventListener("click", () => setRaw(true));
$("zoom-in").addEventListener("click", () => zoom(1.25));
$("zoom-out").addEventListener("click", () => zoom(0.8));
$("zoom-fit").addEventListener("click", keys.f);
$("calibrate").addEventListener("click", calibrate);
$("record").addEventListener("click", record);
$("mark").addEventListener("click", mark);
$("note-cancel").addEventListener("click", () => $("note").close());
$("theme").addEventListener("click", keys.t);
$("pause").addEventListener("click", keys.p);
$("length").addEventListener("change", () => { remember("length", $("length").value); plottedMs = 0; dirty = true; });
$("help").addEventListener("click", keys["?"]);
$("scale").addEventListener("change", () => { peaks = []; dirty = true; });
window.addEventListener("resize", () => { map.arrange(); dirty = true; });

// The system's theme, also when it changes, until one is chosen here.
const light = matchMedia("(prefers-color-scheme: light)");
const ofSystem = () => { if (!remembered("theme")) setTheme(light.matches ? "light" : "dark"); };
light.addEventListener("change", () => { ofSystem(); dirty = true; });
setTheme(remembered("theme") ?? (light.matches ? "light" : "dark"));
map.shown = remembered("part") || null;
if ([...$("length").options].some(({ value }) => value === remembered("length"))) $("length").value = remembered("length");
connect();
requestAnimationFrame(frame);
