// Folds the repeats of a configuration for compare.html: means with their 95 % intervals, and lines with a band. As
// services/run_comparison and analysis/plot_types/looks.py do for the pages of a server, except that an interval of a mean is
// Student's here.
"use strict";
(() => {
  const GRID_POINTS = 300;
  const { students } = JSON.parse(document.getElementById("compared").textContent);
  const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;
  const variance = (values) => values.reduce((sum, value) => sum + (value - mean(values)) ** 2, 0) / (values.length - 1);

  /** The factor of a 95 % interval with this many degrees of freedom. */
  const student = (freedom) => students[Math.min(Math.floor(freedom), students.length) - 1];

  /** What stands side by side: each run, or the runs of each configuration. */
  function columns(runs, grouped) {
    const found = new Map();
    for (const run of runs) {
      const key = grouped ? run.configuration : run.id;
      (found.get(key) || found.set(key, []).get(key)).push(run);
    }
    return [...found].map(([key, members]) => ({
      runs: members,
      good: members.length === 1 ? members : members.filter((run) => !run.failed),
      rival: members.some((run) => run.rival),
      name: grouped ? `Configuration ${key}` : `Run ${key}`,
    }));
  }

  /** The values of a metric in a column: those of its good runs. */
  const sample = (column, key) => column.good.filter((run) => run.metrics[key]).map((run) => run.metrics[key][0]);

  /** The ends of the 95 % interval of a mean; null without two values. */
  function interval(values) {
    if (values.length < 2) return null;
    const half = student(values.length - 1) * Math.sqrt(variance(values) / values.length);
    return [mean(values) - half, mean(values) + half];
  }

  /** Whether two columns differ by more than chance (Welch, 95 %). Two single values are compared as they are. */
  function differ(first, second) {
    if (Math.min(first.length, second.length) < 2) return first.length === second.length;
    const parts = [first, second].map((values) => variance(values) / values.length);
    const sum = parts[0] + parts[1];
    if (sum === 0) return mean(first) !== mean(second);
    const freedom = sum ** 2 / (parts[0] ** 2 / (first.length - 1) + parts[1] ** 2 / (second.length - 1));
    return Math.abs(mean(first) - mean(second)) > student(freedom) * Math.sqrt(sum);
  }

  /** The value of a line at a time between its first and its last. */
  function at(time, { x, y }) {
    let low = 0;
    let high = x.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (x[middle] <= time) low = middle; else high = middle;
    }
    const share = x[high] > x[low] ? Math.min(1, Math.max(0, (time - x[low]) / (x[high] - x[low]))) : 0;
    return y[low] + share * (y[high] - y[low]);
  }

  /** Several lines as one: the mean, the smallest and the largest value at the times that all of them cover. */
  function fold(traces) {
    const lines = traces.map((trace) => {
      const [x, y] = [trace.x, trace.y].map(slamhivePlots.list);
      const known = x.map((_, place) => place).filter((place) => Number.isFinite(y[place]) && Number.isFinite(x[place]));
      return { x: known.map((place) => x[place]), y: known.map((place) => y[place]) };
    }).filter(({ x }) => x.length);
    if (!lines.length) return null;
    const start = Math.max(...lines.map(({ x }) => x[0]));
    const end = Math.max(start, Math.min(...lines.map(({ x }) => x[x.length - 1])));
    const times = Array.from({ length: GRID_POINTS }, (_, place) => start + (end - start) * place / (GRID_POINTS - 1));
    const values = times.map((time) => lines.map((line) => at(time, line)));
    return { times, mean: values.map(mean), low: values.map((row) => Math.min(...row)), high: values.map((row) => Math.max(...row)) };
  }

  /** The traces of a column with repeats: a band from the smallest to the largest value, and the mean. */
  function band(column, traces, colour) {
    const folded = fold(traces);
    if (!folded) return [];
    const [red, green, blue] = [1, 3, 5].map((place) => parseInt(colour.slice(place, place + 2), 16));
    const around = (forth, back) => [...forth, ...[...back].reverse()];
    return [
      { type: "scatter", mode: "lines", x: around(folded.times, folded.times), y: around(folded.high, folded.low), line: { width: 0, color: colour }, fill: "toself", fillcolor: `rgba(${red},${green},${blue},0.2)`, legendgroup: column.name, name: `${column.name}: smallest to largest`, showlegend: false, hoverinfo: "skip" },
      { type: "scatter", mode: "lines", x: folded.times, y: folded.mean, line: { width: 1.5, color: colour }, legendgroup: column.name, name: `${column.name}, mean of ${traces.length}`, showlegend: true },
    ];
  }

  window.slamhiveGroups = { columns, sample, mean, interval, differ, band };
})();
