// Colour maps (matplotlib's viridis for maps, plasma for paths, both colour-blind safe), and ranges of values.

const MAPS = {
  viridis: ["#440154", "#482878", "#3e4989", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"],
  plasma: ["#0d0887", "#46039f", "#7201a8", "#9c179e", "#bd3786", "#d8576b", "#ed7953", "#fb9f3a", "#fdca26", "#f0f921"],
};
// The ends that are hard to see on a page of that brightness are left out.
const SHOWN = { light: [0, 0.88], dark: [0.16, 1] };
const UNKNOWN = { light: [0.72, 0.74, 0.76], dark: [0.35, 0.38, 0.41] };

/** As the page says; one of a static site follows the system. */
export function isDark() {
  const theme = document.documentElement.dataset.bsTheme;
  return theme ? theme === "dark" : window.matchMedia("(prefers-color-scheme: dark)").matches;
}

/** "#0072B2" as [red, green, blue], 0 to 1. */
export function parts(colour) {
  return [1, 3, 5].map((place) => parseInt(colour.slice(place, place + 2), 16) / 255);
}

/** A function from a share, 0 to 1, to [red, green, blue]; what is no number is grey. */
export function scaleOf(name) {
  const stops = MAPS[name].map(parts);
  const [low, high] = isDark() ? SHOWN.dark : SHOWN.light;
  const unknown = isDark() ? UNKNOWN.dark : UNKNOWN.light;
  return (share) => {
    if (!Number.isFinite(share)) return unknown;
    const at = (low + Math.min(1, Math.max(0, share)) * (high - low)) * (stops.length - 1);
    const first = Math.min(stops.length - 2, Math.floor(at));
    return stops[first].map((part, place) => part + (at - first) * (stops[first + 1][place] - part));
  };
}

const ENOUGH = 20000;

/** The smallest and largest of the values without the outermost two per cent on each side; null without numbers. */
export function rangeOf(lists) {
  const count = lists.reduce((sum, list) => sum + list.length, 0);
  const step = Math.ceil(count / ENOUGH) || 1;
  const some = new Float32Array(Math.ceil(count / step) + lists.length);
  let found = 0;
  for (const list of lists) {
    for (let place = 0; place < list.length; place += step) if (Number.isFinite(list[place])) some[found++] = list[place];
  }
  if (!found) return null;
  const values = some.subarray(0, found).sort();
  const at = (share) => values[Math.round(share * (found - 1))];
  return found < 50 ? [at(0), at(1)] : [at(0.02), at(0.98)];
}

export const shareOf = (value, [low, high]) => (value - low) / (high - low || 1);

/** A number with three significant digits. */
export function short(value) {
  if (value === 0) return "0";
  const size = Math.abs(value);
  return size >= 1e5 || size < 1e-3 ? value.toExponential(2) : String(Number(value.toPrecision(3)));
}
