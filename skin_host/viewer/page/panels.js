// Contacts, health, parts: what stands in words beside the map.
import { ageText, isBound } from "./store.js";

const LEVELS = { ok: "ok", warning: "warn", degraded: "warn", disabled: "warn" };

export function level(part, nowMs) {
  if (part.stale(nowMs)) return "alarm";
  return part.lacksHealth(nowMs) ? "warn" : LEVELS[part.health.state] ?? "alarm";
}

/** Keep DOM nodes that stay, so that focus and selection stay too. */
function keep(list, n, make) {
  while (list.children.length > n) list.lastChild.remove();
  while (list.children.length < n) list.append(make());
  return [...list.children];
}

export function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function showParts(nav, store, shown, nowMs, pick) {
  const names = [null, ...store.parts.map((part) => part.name)];
  const buttons = keep(nav, names.length, () => {
    const button = document.createElement("button");
    button.append(document.createElement("i"), document.createElement("span"));
    button.addEventListener("click", () => pick(button.dataset.part || null));
    return button;
  });
  buttons.forEach((button, i) => {
    const part = store.parts[i - 1];
    button.dataset.part = names[i] ?? "";
    button.setAttribute("aria-current", String(names[i] === shown));
    button.dataset.level = part ? level(part, nowMs) : "";
    button.firstChild.hidden = !part;
    put(button.lastChild, names[i] ?? "all");
  });
}

/** Names of some parts, or how many there are where they are many. */
function named(parts) {
  return parts.length > MANY ? `${parts.length} parts` : parts.map((part) => part.name).join(", ");
}

/** In words what touches no row of the table shows; nothing touches only what is known to be untouched. */
function untouched(parts, touched, nowMs) {
  const groups = new Map();
  for (const part of parts) {
    const why = part.unknown(nowMs);
    if (why !== null) groups.set(why, [...groups.get(why) ?? [], part]);
  }
  const said = [...groups].map(([why, those]) => `Not known of ${named(those)}: ${why}.`);
  const known = parts.filter((part) => part.unknown(nowMs) === null && !touched.includes(part));
  const on = known.filter((part) => part.state === "ON");
  if (on.length) said.push(`Touched: ${named(on)}; where is not known yet.`);
  const off = known.filter((part) => part.state === "OFF");
  if (!touched.length && !on.length && off.length) said.push(`Nothing touches ${groups.size ? named(off) : "the skin"}.`);
  return said.join(" ");
}

/** Whether more may press on these parts than is known. */
export function isLeast(parts, nowMs) { return parts.some((part) => part.isLeast(nowMs)); }

const VERDICTS = {
  no_single_contact: "no one push gives this force and torque",
  several_contacts: "several things touch it",
  saturated: "its board is at the end of its range",
};

/** What there is to know of the numbers of a contact. */
function remarks({ verdict, partial, beyond }) {
  const said = [VERDICTS[verdict], beyond && verdict !== "saturated" && "a pad is pressed beyond its calibrated range", partial && "pads beside it are not valid"];
  return said.filter(Boolean).join("; ");
}

/** Contacts of the parts that are shown, with their sum; the pointer and a click mark one. */
export function showContacts(table, hint, parts, map, nowMs, point, select) {
  const touched = parts.filter((part) => !part.stale(nowMs) && part.contacts.length);
  const rows = touched.flatMap((part) => part.contacts.map((contact) => [part.name, contact]));
  const body = table.tBodies[0];
  table.hidden = !rows.length;
  put(hint, untouched(parts, touched, nowMs));
  hint.hidden = !hint.textContent;
  keep(body, rows.length, () => {
    const row = document.createElement("tr");
    row.tabIndex = 0;
    for (let i = 0; i < 5; i++) row.append(document.createElement("td"));
    const mine = () => ({ part: row.dataset.part, id: Number(row.dataset.id) });
    row.addEventListener("pointerenter", () => point(mine()));
    row.addEventListener("pointerleave", () => point(null));
    row.addEventListener("focus", () => point(mine()));
    row.addEventListener("blur", () => point(null));
    row.addEventListener("click", () => select(mine()));
    row.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      event.stopPropagation();
      select(mine());
    });
    return row;
  }).forEach((row, i) => {
    const [name, contact] = rows[i];
    row.dataset.part = name;
    row.dataset.id = contact.id;
    row.setAttribute("aria-selected", String(map.selected?.part === name && map.selected.id === contact.id));
    row.title = remarks(contact);
    const { partial, beyond } = contact;
    const cells = [name, `#${contact.id}`, told(contact.force_n, 2, "N", isBound(contact)), told(contact.peak_kpa, 1, "kPa", partial || beyond), told(contact.area_mm2, 0, "mm²", partial)];
    cells.forEach((text, k) => put(row.children[k], text));
  });
  const total = rows.reduce((sum, [, contact]) => sum + contact.force_n, 0);
  put(table.tFoot.rows[0].cells[2], told(total, 2, "N", isLeast(parts, nowMs)));
  table.tFoot.hidden = rows.length < 2;
}

/** More parts than this in one state are one line, which opens. */
const MANY = 3;
const ORDER = ["alarm", "warn", "ok"];

function stateOf(part, nowMs) {
  if (part.heardMs === null && part.health?.state === "not calibrated") return "not calibrated";
  if (part.heardMs === null) return "no data";
  if (part.stale(nowMs)) return "stale";
  return part.lacksHealth(nowMs) ? "no health" : part.health.state;
}

/** Whether what was known of a part is over: its data came, and come no more. */
function isOver(part, nowMs) { return part.heardMs !== null && part.stale(nowMs); }

/** Whether what its health stated is true now. */
function isStated(part, nowMs) { return !isOver(part, nowMs) && !part.isHealthOld(nowMs); }

/** Sentences that more than one part has, but for its own name: [sentence, how many]. */
function sharedSentences(parts) {
  const counts = new Map();
  for (const part of parts) {
    for (const says of new Set(part.health?.sentences ?? [])) counts.set(says, (counts.get(says) ?? 0) + 1);
  }
  return [...counts].filter(([, n]) => n > 1);
}

export function showHealth(box, list, parts, nowMs) {
  if (!parts.length) return;
  if (box.querySelector(".hint")) box.replaceChildren();
  const shared = sharedSentences(parts.filter((part) => isStated(part, nowMs)));
  keep(list, shared.length, () => document.createElement("li")).forEach((item, i) => put(item, `${shared[i][0]} (${shared[i][1]} parts)`));
  list.hidden = !shared.length;
  const once = new Set(shared.map(([says]) => says));
  const groups = new Map();
  for (const part of parts) {
    const state = stateOf(part, nowMs);
    if (!groups.has(state)) groups.set(state, { state, level: level(part, nowMs), parts: [] });
    groups.get(state).parts.push(part);
  }
  const sorted = [...groups.values()].sort((a, b) => ORDER.indexOf(a.level) - ORDER.indexOf(b.level));
  const entries = sorted.flatMap((group) => (group.parts.length > MANY ? [group] : group.parts.map((part) => ({ part }))));
  const kinds = entries.map((entry) => (entry.part ? "article" : "details"));
  // Nodes that stay keep what is open and what is focused.
  while (box.children.length > entries.length) box.lastChild.remove();
  entries.forEach((entry, i) => {
    const key = entry.part ? "" : entry.state;
    const there = box.children[i];
    if (there?.localName !== kinds[i] || (there.dataset.state ?? "") !== key) {
      const made = entry.part ? newArticle() : newGroup(key);
      if (there) there.replaceWith(made); else box.append(made);
    }
    if (entry.part) return fill(box.children[i], entry.part, once, nowMs);
    const details = box.children[i];
    details.dataset.level = entry.level;
    const [summary, ...articles] = details.children;
    put(summary.firstChild, `${entry.parts.length} parts: ${entry.state}`);
    put(summary.lastChild, ` ${rates(entry.parts, nowMs)}`);
    while (articles.length > entry.parts.length) articles.pop().remove();
    entry.parts.forEach((part, k) => {
      if (!articles[k]) { articles[k] = newArticle(); details.append(articles[k]); }
      fill(articles[k], part, once, nowMs);
    });
  });
}

/** What a group of parts sends together. */
function rates(parts, nowMs) {
  const sum = (of) => parts.reduce((all, part) => all + of(part), 0);
  const taxels = sum((part) => part.health?.taxels ?? part.feeling);
  const known = parts.map((part) => part.valids(nowMs));
  const valid = known.includes(null) ? "?" : known.reduce((all, n) => all + n, 0);
  return `${sum((part) => part.rate(nowMs)).toFixed(0)} frames/s, ${valid} of ${taxels} taxels valid`;
}

function newGroup(state) {
  const details = document.createElement("details");
  details.dataset.state = state;
  const summary = document.createElement("summary");
  summary.append(document.createElement("b"), document.createElement("span"));
  details.append(summary);
  return details;
}

function newArticle() {
  const article = document.createElement("article");
  const head = document.createElement("h3");
  head.append(document.createTextNode(""), document.createElement("span"));
  const rates = document.createElement("p");
  rates.className = "rates";
  article.append(head, rates, document.createElement("ul"));
  return article;
}

function fill(article, part, once, nowMs) {
  const stale = part.stale(nowMs);
  const [head, rates, list] = article.children;
  article.dataset.level = level(part, nowMs);
  article.dataset.part = part.name;
  put2(head.firstChild, part.name);
  put(head.lastChild, stateOf(part, nowMs));
  const taxels = `${part.valids(nowMs) ?? "?"} of ${part.health?.taxels ?? part.feeling} taxels valid`;
  const frames = part.hasFrames ? `${part.rate(nowMs).toFixed(1)} frames/s, ${part.missed} ${part.thinned ? "lost or left out" : "missed"}` : "no frames are published";
  put(rates, part.fingertip ? `${told(stale ? null : part.health?.rate_hz, 0, "samples/s")} of force and torque` : `${frames}, ${taxels}`);
  const sentences = (part.health?.sentences ?? []).filter((says) => !isStated(part, nowMs) || !once.has(says));
  const said = [...ages(part, nowMs, sentences.length ? "; before that:" : "."), ...sentences];
  keep(list, said.length, () => document.createElement("li")).forEach((item, k) => put(item, said[k]));
  list.hidden = !said.length;
}

/** What has stopped to come, and since when. */
function ages(part, nowMs, end) {
  const since = (ms) => `for ${ageText(ms, nowMs)}${end}`;
  if (isOver(part, nowMs)) {
    const isLate = part.why === "stale" && nowMs - part.heardMs < 1000;
    return [isLate ? "What comes is too late to be true." : `${part.hasFrames ? "No frame" : "Nothing"} ${since(part.heardMs)}`];
  }
  if (part.heardMs === null || !part.lacksHealth(nowMs)) return [];
  return [part.healthMs === null ? `No health has come yet${end}` : `No health ${since(part.healthMs)}`];
}

/** A number with its unit, and whether it is a bound from below; where there is no skin there is no pressure and no area. */
export function told(value, decimals, unit, isLeast = false) {
  return Number.isFinite(value) ? `${isLeast ? "≥ " : ""}${value.toFixed(decimals)} ${unit}` : "–";
}

function put2(node, text) {
  if (node.data !== text) node.data = text;
}
