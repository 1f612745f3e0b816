// Puts runs of a static site side by side: compare.html?runs=3,5 loads the scripts of these runs. Cells are always text.
"use strict";
(() => {
  const FEWEST = 2;
  const TRUTH = "theme:groundtruth";
  const { most, colours, metrics } = JSON.parse(document.getElementById("compared").textContent);
  const says = document.getElementById("says");
  const asked = new URLSearchParams(window.location.search).get("runs") || "";
  const ids = asked.split(",").map((text) => text.trim()).filter(Boolean);
  const loaded = new Map();
  window.slamhiveRun = (run) => loaded.set(String(run.id), run);

  const load = (id) => slamhiveLoad(`runs/${id}.js`).catch(() => { throw new Error(`Run ${id} is not on this site.`); });

  function element(tag, text = "", attributes = {}) {
    const made = document.createElement(tag);
    made.textContent = text;
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  }

  /** A table with a column for each run; rows are [heading, what it means, cells]. */
  function table(caption, first, runs, rows) {
    const made = element("table");
    made.append(element("caption", caption));
    const head = made.createTHead().insertRow();
    head.append(element("th", first, { scope: "col" }));
    runs.forEach((run, place) => {
      const cell = element("th", "", { scope: "col", class: "number" });
      const swatch = element("span", "■ ", { "aria-hidden": "true" });
      swatch.style.color = colours[place][0];
      cell.append(swatch, element("a", `Run ${run.id}`, { href: `runs/${run.id}.html` }));
      for (const line of [run.algorithm, run.dataset, run.failed ? "failed" : ""]) if (line) cell.append(element("span", line, { class: "under" }));
      head.append(cell);
    });
    const body = made.createTBody();
    for (const [name, title, cells] of rows) {
      const line = body.insertRow();
      line.append(element("th", name, { scope: "row", title }), ...cells);
    }
    const frame = element("div", "", { class: "table-frame", tabindex: "0", role: "region", "aria-label": `Table: ${caption}` });
    frame.append(made);
    return frame;
  }

  const digits = (value) => value.toPrecision(4);

  /** Which metrics are not marked, and why; as services/run_comparison/marks.py has it for the pages of a server. */
  function unmarkedParts(runs, protocols) {
    const several = (key) => new Set(runs.map((run) => run[key]).filter(Boolean)).size;
    const parts = [];
    if (several("dataset") > 1) return [{ holds: () => true, words: `Nothing is marked as better: the runs are of ${several("dataset")} datasets.` }];
    const accuracy = protocols > 1 ? `the runs are evaluated under ${protocols} protocols` : several("trajectory") > 1 ? "kinds of trajectories are mixed" : "";
    if (accuracy) parts.push({ holds: (metric) => metric.accuracy, words: `No accuracy is marked as better: ${accuracy}.` });
    if (several("cpu") > 1) parts.push({ holds: (metric) => !metric.accuracy, words: `No CPU, memory or time is marked as better: the runs are of ${several("cpu")} CPU models.` });
    return parts;
  }

  /** The column with the better value: none on a tie, and never a run that failed or has low trust. */
  function bestOf(metric, runs) {
    if (!["lower", "higher"].includes(metric.better)) return null;
    const sign = metric.better === "lower" ? 1 : -1;
    const rivals = runs.map((run, place) => [run.metrics[metric.key], place]).filter(([value, place]) => value && runs[place].rival)
      .map(([[value], place]) => [sign * value, place]).sort(([a], [b]) => a - b);
    if (rivals.length < 2 || digits(rivals[0][0]) === digits(rivals[1][0])) return null;
    return rivals[0][1];
  }

  function showMetrics(runs, unmarked) {
    const groups = new Map();
    for (const metric of metrics.filter(({ key }) => runs.some((run) => key in run.metrics))) {
      const best = unmarked.some(({ holds }) => holds(metric)) ? null : bestOf(metric, runs);
      const cells = runs.map((run, place) => {
        const [, text, exact] = run.metrics[metric.key] || [null, "–", `no ${metric.label} known`];
        const cell = element("td", text, { class: place === best ? "number best" : "number", title: exact });
        if (place === best) cell.prepend(element("span", "★ ", { role: "img", "aria-label": "better:" }));
        return cell;
      });
      const rows = groups.get(metric.group) || groups.set(metric.group, []).get(metric.group);
      rows.push([metric.unit ? `${metric.label} [${metric.unit}]` : metric.label, metric.definition, cells]);
    }
    const place = document.querySelector("[data-metrics]");
    for (const [group, rows] of groups) place.append(table(`Metrics: ${group}`, "Metric", runs, rows));
    if (!groups.size) place.append(element("p", "These runs have no metrics.", { class: "quiet" }));
  }

  function showSettings(runs) {
    const keys = [...new Set(runs.flatMap((run) => Object.keys(run.settings)))];
    const differs = (key) => new Set(runs.map((run) => run.settings[key])).size > 1;
    const row = (key) => [key.replace(/^parameter\./, ""), "", runs.map((run) => element("td", run.settings[key] ?? "–", { class: "number" }))];
    const place = document.querySelector("[data-settings]");
    const [other, same] = [keys.filter(differs), keys.filter((key) => !differs(key))];
    place.append(other.length ? table("Settings that differ", "Setting", runs, other.map(row)) : element("p", "Nothing differs: these are repeats of one another."));
    if (!same.length) return;
    const details = element("details");
    details.append(element("summary", `${same.length} settings that are the same`), table("Equal settings", "Setting", runs, same.map(row)));
    place.append(details);
  }

  /** A trace of a run in the colour of its column. */
  function ofRun(trace, run, colour, first) {
    const own = { ...trace, name: `Run ${run.id}${first ? "" : `: ${trace.name}`}`, legendgroup: String(run.id), showlegend: first };
    delete own.meta;
    if (trace.line) own.line = { ...trace.line, color: colour };
    if (trace.marker) own.marker = { ...trace.marker, color: colour };
    return own;
  }

  /** Axes that hold all of the scenes, at equal scale. */
  function commonScene(scenes) {
    const half = (axis) => (axis.range[1] - axis.range[0]) / 2;
    const scene = { ...scenes[0], aspectratio: {} };
    for (const name of ["x", "y", "z"]) {
      const ranges = scenes.map((entry) => entry[`${name}axis`].range);
      scene[`${name}axis`] = { ...scenes[0][`${name}axis`], range: [Math.min(...ranges.map(([low]) => low)), Math.max(...ranges.map(([, high]) => high))] };
    }
    const longest = Math.max(...["x", "y", "z"].map((name) => half(scene[`${name}axis`])));
    for (const name of ["x", "y", "z"]) scene.aspectratio[name] = 1.5 * half(scene[`${name}axis`]) / longest;
    return scene;
  }

  const RECORDING = "recording time [s]";

  /** The runs with data for a plot. Runs of older versions lack the time of the recording, so they are left out beside others. */
  function withData(key, runs) {
    const having = runs.filter((run) => run.figures[key]);
    const onRecording = having.filter((run) => run.figures[key].layout.xaxis?.title.text === RECORDING);
    return onRecording.length ? onRecording : having;
  }

  /** The range that holds the times of all runs. Grey areas are those of one run, so a comparison has none. */
  function commonTime(having, key) {
    const { shapes, ...layout } = having[0].figures[key].layout;
    const ranges = having.map((run) => run.figures[key].layout.xaxis?.range).filter(Boolean);
    if (!ranges.length) return layout;
    const range = [Math.min(...ranges.map(([low]) => low)), Math.max(...ranges.map(([, high]) => high))];
    return { ...layout, xaxis: { ...layout.xaxis, range } };
  }

  function merged(key, runs) {
    const having = withData(key, runs);
    if (!having.length) return null;
    const data = having.flatMap((run) => run.figures[key].data.filter((trace) => trace.meta !== TRUTH)
      .map((trace, place) => ofRun(trace, run, colours[runs.indexOf(run)][0], place === 0)));
    const truth = having.flatMap((run) => run.figures[key].data).find((trace) => trace.meta === TRUTH && trace.mode === "lines");
    const layout = commonTime(having, key);
    const dark = Object.fromEntries(colours.filter(([colour, lighter]) => colour !== lighter));
    const scene = layout.scene ? { scene: commonScene(having.map((run) => run.figures[key].layout.scene)) } : {};
    return { data: truth ? [...data, truth] : data, layout: { ...layout, ...scene, legend: { orientation: "h", yanchor: "bottom", y: 1, xanchor: "left", x: 0 }, showlegend: true, meta: { dark } } };
  }

  function showPlots(runs, datasets) {
    const figures = {};
    const reasons = {};
    for (const place of document.querySelectorAll("[data-plot]")) {
      const key = place.dataset.plot;
      const figure = key === "path" && datasets.size > 1 ? null : merged(key, runs);
      if (figure) figures[key] = figure;
      else reasons[key] = key === "path" && datasets.size > 1 ? `The runs are of ${datasets.size} datasets, so their paths are not drawn together.` : "None of these runs has data for this plot.";
      const lacking = runs.filter((run) => !withData(key, runs).includes(run)).map((run) => run.id);
      place.parentElement.querySelector("figcaption").textContent = figure && lacking.length ? `Without data: ${lacking.length > 1 ? "runs" : "run"} ${lacking.join(", ")}.` : "";
    }
    slamhiveDraw({ figures, reasons, plane: runs.find((run) => run.plane)?.plane });
  }

  /** What the 3D view loads when it is opened. */
  function offerScene(runs, datasets) {
    const panel = document.querySelector("[data-viewer]");
    const look = (run) => {
      const [colour, dark] = colours[runs.indexOf(run)];
      return { address: `runs/${run.id}.scene.js`, name: `run ${run.id}, ${run.algorithm}`, colour, dark };
    };
    const having = runs.filter((run) => run.scene);
    panel.parentElement.hidden = datasets.size > 1 || !having.length;
    panel.dataset.scene = JSON.stringify(having.map(look));
  }

  function show(runs) {
    const datasets = new Set(runs.map((run) => run.dataset));
    const protocols = new Map(runs.filter((run) => run.protocol).map((run) => run.protocol));
    const without = runs.filter((run) => !run.protocol).map((run) => run.id);
    document.querySelector("h1").textContent = `Comparison of ${runs.length} runs`;
    const words = [...protocols].map(([fingerprint, label]) => `${label} (${fingerprint})`);
    const lines = [protocols.size === 1 ? `Protocol: ${words[0]}.` : protocols.size ? `Protocols: ${words.join("; ")}.` : "None of these runs is evaluated."];
    if (protocols.size && without.length) lines.push(`Not evaluated: ${without.length > 1 ? "runs" : "run"} ${without.join(", ")}.`);
    says.textContent = lines.join(" ");
    const unmarked = unmarkedParts(runs, protocols.size);
    const rule = "The better value is marked with ★. There is no mark on a tie, or for a metric without a better direction. A run that failed or has low trust is never marked.";
    document.getElementById("marks").textContent = [...(datasets.size > 1 ? [] : [rule]), ...unmarked.map(({ words: why }) => why)].join(" ");
    document.querySelector("[data-comparison]").hidden = false;
    showMetrics(runs, unmarked);
    showPlots(runs, datasets);
    offerScene(runs, datasets);
    showSettings(runs);
  }

  const bad = ids.find((id, place) => !/^[1-9]\d{0,15}$/.test(id) || ids.indexOf(id) !== place);
  if (bad !== undefined) says.textContent = `${bad.slice(0, 40)} is not the number of a run, or it is named twice.`;
  else if (ids.length < FEWEST || ids.length > most) says.textContent = `Select ${FEWEST} to ${most} runs in the list, then press Compare.`;
  else Promise.all(ids.map(load)).then(() => show(ids.map((id) => loaded.get(id)))).catch((error) => { says.textContent = error.message; });
})();
