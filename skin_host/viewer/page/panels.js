// Contacts, health, parts: what stands in words beside the map.
const LEVELS = { ok: "ok", degraded: "warn", disabled: "warn" };

export function level(part, nowMs) {
  if (part.stale(nowMs)) return "alarm";
  return part.health ? LEVELS[part.health.state] ?? "alarm" : "ok";
}

/** Keep DOM nodes that stay, so that focus and selection stay too. */
function keep(list, n, make) {
  while (list.children.length > n) list.lastChild.remove();
  while (list.children.length < n) list.append(make());
  return [...list.children];
}

function put(element, text) {
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

export function showContacts(table, hint, store, nowMs) {
  const live = store.parts.filter((part) => !part.stale(nowMs));
  const rows = live.flatMap((part) => part.contacts.map((contact) => [part.name, contact]));
  const body = table.tBodies[0];
  table.hidden = !rows.length;
  hint.hidden = rows.length > 0;
  put(hint, live.length ? "Nothing touches the skin." : "Not known: no data.");
  keep(body, rows.length, () => {
    const row = document.createElement("tr");
    for (let i = 0; i < 5; i++) row.append(document.createElement("td"));
    return row;
  }).forEach((row, i) => {
    const [name, contact] = rows[i];
    const cells = [name, `#${contact.id}`, told(contact.force_n, 2, "N"), told(contact.peak_kpa, 1, "kPa"), told(contact.area_mm2, 0, "mm²")];
    cells.forEach((text, k) => put(row.children[k], text));
  });
}

export function showHealth(box, store, shown, nowMs) {
  const parts = store.parts.filter((part) => !shown || part.name === shown);
  if (!parts.length) return;
  if (box.querySelector(".hint")) box.replaceChildren();
  keep(box, parts.length, () => {
    const article = document.createElement("article");
    const head = document.createElement("h3");
    head.append(document.createTextNode(""), document.createElement("span"));
    const rates = document.createElement("p");
    rates.className = "rates";
    article.append(head, rates, document.createElement("ul"));
    return article;
  }).forEach((article, i) => {
    const part = parts[i];
    const stale = part.stale(nowMs);
    const [head, rates, list] = article.children;
    article.dataset.level = level(part, nowMs);
    article.dataset.part = part.name;
    put2(head.firstChild, part.name);
    put(head.lastChild, part.heardMs === null ? "no data" : stale ? "stale" : part.health?.state ?? "");
    const valid = part.health?.valid_taxels;
    const taxels = valid === undefined ? `${part.n} taxels` : `${valid} of ${part.health.taxels} taxels valid`;
    const frames = `${part.rate(nowMs).toFixed(1)} frames/s, ${part.missed} missed, ${taxels}`;
    put(rates, part.fingertip ? `${told(part.health?.rate_hz, 0, "samples/s")} of force and torque` : frames);
    const said = [...(stale && part.heardMs !== null ? [`${part.fingertip ? "Nothing" : "No frame"} for ${((nowMs - part.heardMs) / 1000).toFixed(0)} s.`] : []), ...(part.health?.sentences ?? [])];
    keep(list, said.length, () => document.createElement("li")).forEach((item, k) => put(item, said[k]));
    list.hidden = !said.length;
  });
}

/** A number with its unit; where there is no skin there is no pressure and no area. */
function told(value, decimals, unit) {
  return Number.isFinite(value) ? `${value.toFixed(decimals)} ${unit}` : "–";
}

function put2(node, text) {
  if (node.data !== text) node.data = text;
}
