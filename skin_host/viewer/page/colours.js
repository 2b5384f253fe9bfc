// Colour scales whose lightness rises (dark) or falls (light) all the way, so that they can be
// read without telling hues apart. Dark: cividis from a lifted zero; light: blues.
const STOPS = {
  dark: ["#243550", "#203f6c", "#3b4a6b", "#575c6d", "#707173", "#8a8779", "#a69d75", "#c4b56c", "#e4cf5b", "#fde945"],
  light: ["#e6ebf1", "#cfdde9", "#aecbe0", "#83b2d3", "#5a97c4", "#3a7ab3", "#285d9e", "#204583", "#1c2f64", "#150f3c"],
};
// Okabe and Ito's colours for lines, told apart by dashes too.
export const LINES = {
  dark: ["#56b4e9", "#e69f00", "#f0e442", "#cc79a7", "#2fc499", "#d5d9de"],
  light: ["#0072b2", "#b35900", "#8a6d00", "#a5377e", "#007d5a", "#30363d"],
};
export const DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3], [4, 4], [1, 4]];

export function theme() {
  return document.documentElement.dataset.theme === "light" ? "light" : "dark";
}

const ramps = {};

/** 256 colours from nothing to the most. */
export function ramp() {
  const name = theme();
  ramps[name] ??= Array.from({ length: 256 }, (_, i) => mixed(STOPS[name], i / 255));
  return ramps[name];
}

function mixed(stops, share) {
  const at = share * (stops.length - 1);
  const low = Math.min(Math.floor(at), stops.length - 2);
  const parts = [0, 1, 2].map((i) => {
    const [a, b] = [stops[low], stops[low + 1]].map((stop) => parseInt(stop.slice(1 + 2 * i, 3 + 2 * i), 16));
    return Math.round(a + (b - a) * (at - low));
  });
  return `rgb(${parts.join(",")})`;
}

/** Where on a scale a value lies, 0 to 1: as its square root, so that 5 kPa shows beside 100. */
export function shareOf(value, top) { return Math.sqrt(Math.min(1, Math.max(0, value / top))); }

const papers = {};

/** The page's own colours for drawings. */
export function paper() {
  const name = theme();
  if (!papers[name]) {
    const style = getComputedStyle(document.documentElement);
    const colour = (key) => style.getPropertyValue(key).trim();
    papers[name] = { back: colour("--panel"), body: colour("--body"), line: colour("--line"), rim: colour("--rim"), text: colour("--text"), dim: colour("--dim"), alarm: colour("--alarm"), warn: colour("--warn") };
  }
  return papers[name];
}
