// Puts runs of a static site side by side: compare.html?runs=3,5 loads the scripts of these runs, and &group=configuration
// makes the repeats of a configuration one column. Cells are always text.
"use strict";
(() => {
  const FEWEST = 2;
  const TRUTH = "theme:groundtruth";
  const { most, colours, metrics } = JSON.parse(document.getElementById("compared").textContent);
  const says = document.getElementById("says");
  const query = new URLSearchParams(window.location.search);
  const asked = query.get("runs") || "";
  const grouped = query.get("group") === "configuration";
  const groups = window.slamhiveGroups;
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

  /** A table with a column for each run or configuration; rows are [heading, what it means, cells]. */
  function table(caption, first, columns, rows) {
    const made = element("table");
    made.append(element("caption", caption));
    const head = made.createTHead().insertRow();
    head.append(element("th", first, { scope: "col" }));
    columns.forEach(({ runs, name }, place) => {
      const [run] = runs;
      const cell = element("th", "", { scope: "col", class: "number" });
      const swatch = element("span", "■ ", { "aria-hidden": "true" });
      swatch.style.color = colours[place][0];
      cell.append(swatch, grouped ? name : element("a", name, { href: `runs/${run.id}.html` }));
      const failed = runs.filter((member) => member.failed).length;
      for (const line of [run.algorithm, run.dataset, !failed ? "" : grouped ? `${failed} of ${runs.length} failed` : "failed"]) if (line) cell.append(element("span", line, { class: "under" }));
      if (grouped) {
        const members = element("span", runs.length > 1 ? "runs " : "run ", { class: "under" });
        runs.forEach((member, number) => members.append(number ? ", " : "", element("a", member.id, { href: `runs/${member.id}.html` })));
        cell.append(members);
      }
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

  const digits = (value) => value.toPrecision(3);

  /** Which metrics are not marked, and why; as services/run_comparison.py has it for the pages of a server. */
  function unmarkedParts(runs, mixed) {
    const several = (key) => new Set(runs.map((run) => run[key]).filter(Boolean)).size;
    const parts = [];
    if (several("dataset") > 1) return [{ holds: () => true, words: `Nothing is marked as better: the runs are of ${several("dataset")} datasets.` }];
    const accuracy = !mixed ? "" : mixed.onlyTrajectories ? "kinds of trajectories are mixed" : `the runs are evaluated under ${mixed.protocols} protocols`;
    if (accuracy) parts.push({ holds: (metric) => metric.accuracy, words: `No accuracy is marked as better: ${accuracy}.` });
    if (several("cpu") > 1) parts.push({ holds: (metric) => !metric.accuracy, words: `No CPU, memory or time is marked as better: the runs are of ${several("cpu")} CPU models.` });
    return parts;
  }

  /** The column with the better value: none on a tie, and never one whose runs failed or have low trust. */
  function bestOf(metric, columns) {
    if (!["lower", "higher"].includes(metric.better)) return null;
    const sign = metric.better === "lower" ? 1 : -1;
    const samples = columns.map((column) => groups.sample(column, metric.key));
    const rivals = samples.map((values, place) => [values, place]).filter(([values, place]) => values.length && columns[place].rival)
      .map(([values, place]) => [sign * groups.mean(values), place]).sort(([a], [b]) => a - b);
    if (rivals.length < 2) return null;
    const [[first, best], ...others] = rivals;
    const beaten = ([value, place]) => digits(first) !== digits(value) && groups.differ(samples[best], samples[place]);
    return others.every(beaten) ? best : null;
  }

  /** A number in the unit of a metric, as pages write it. */
  function written(metric, value) {
    const shown = value * metric.factor;
    return Math.abs(shown) >= 100 ? shown.toLocaleString("en", { maximumFractionDigits: 0 }) : digits(shown);
  }

  /** The value of a column: that of its run, or the mean of its good runs above its 95 % interval. */
  function valueCell(metric, column) {
    const having = column.good.filter((run) => run.metrics[metric.key]);
    if (having.length < 2) {
      const [, text, exact] = having.length ? having[0].metrics[metric.key] : [null, "–", `no ${metric.label} known`];
      return element("td", text, { class: "number", title: exact });
    }
    const values = groups.sample(column, metric.key);
    const cell = element("td", written(metric, groups.mean(values)), { class: "number", title: `mean of ${values.length}: ${groups.mean(values)}` });
    cell.append(element("span", groups.interval(values).map((end) => written(metric, end)).join(" to "), { class: "under" }));
    return cell;
  }

  function showMetrics(runs, columns, unmarked) {
    const families = new Map();
    for (const metric of metrics.filter(({ key }) => runs.some((run) => key in run.metrics))) {
      const best = unmarked.some(({ holds }) => holds(metric)) ? null : bestOf(metric, columns);
      const cells = columns.map((column, place) => {
        const cell = valueCell(metric, column);
        if (place === best) {
          cell.classList.add("best");
          cell.prepend(element("span", "★ ", { role: "img", "aria-label": "better:" }));
        }
        return cell;
      });
      const rows = families.get(metric.group) || families.set(metric.group, []).get(metric.group);
      rows.push([metric.unit ? `${metric.label} [${metric.unit}]` : metric.label, metric.definition, cells]);
    }
    const place = document.querySelector("[data-metrics]");
    for (const [group, rows] of families) place.append(table(`Metrics: ${group}`, "Metric", columns, rows));
    if (!families.size) place.append(element("p", "These runs have no metrics.", { class: "quiet" }));
  }

  function showSettings(runs, columns) {
    const keys = [...new Set(runs.flatMap((run) => Object.keys(run.settings)))];
    const text = (column, key) => [...new Set(column.runs.map((run) => run.settings[key] ?? "–"))].join(", ");
    const differs = (key) => new Set(columns.map((column) => text(column, key))).size > 1;
    const row = (key) => [key.replace(/^parameter\./, ""), "", columns.map((column) => element("td", text(column, key), { class: "number" }))];
    const place = document.querySelector("[data-settings]");
    const [other, same] = [keys.filter(differs), keys.filter((key) => !differs(key))];
    place.append(other.length ? table("Settings that differ", "Setting", columns, other.map(row)) : element("p", "Nothing differs: these are repeats of one another."));
    if (!same.length) return;
    const details = element("details");
    details.append(element("summary", `${same.length} settings that are the same`), table("Equal settings", "Setting", columns, same.map(row)));
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

  /** What a column draws: each run by itself, or its good repeats as mean and band. Paths are never folded. */
  function drawn(key, column, having, colour) {
    const own = (run) => run.figures[key].data.filter((trace) => trace.meta !== TRUTH);
    const good = column.good.filter((run) => having.includes(run));
    const folded = grouped && key !== "path" && good.length > 1;
    const band = folded ? groups.band(column, good.map((run) => own(run)[0]), colour) : [];
    const single = column.runs.filter((run) => having.includes(run) && !(folded && good.includes(run)));
    return [...band, ...single.flatMap((run) => own(run).map((trace, place) => ofRun(trace, run, colour, place === 0)))];
  }

  function merged(key, runs, columns) {
    const having = withData(key, runs);
    if (!having.length) return null;
    const data = columns.flatMap((column, place) => drawn(key, column, having, colours[place][0]));
    const truth = having.flatMap((run) => run.figures[key].data).find((trace) => trace.meta === TRUTH && trace.mode === "lines");
    const layout = commonTime(having, key);
    const dark = Object.fromEntries(colours.filter(([colour, lighter]) => colour !== lighter));
    const scene = layout.scene ? { scene: commonScene(having.map((run) => run.figures[key].layout.scene)) } : {};
    return { data: truth ? [...data, truth] : data, layout: { ...layout, ...scene, legend: { orientation: "h", yanchor: "bottom", y: 1, xanchor: "left", x: 0 }, showlegend: true, meta: { dark } } };
  }

  function showPlots(runs, columns, datasets) {
    const figures = {};
    const reasons = {};
    for (const place of document.querySelectorAll("[data-plot]")) {
      const key = place.dataset.plot;
      const figure = key === "path" && datasets.size > 1 ? null : merged(key, runs, columns);
      if (figure) figures[key] = figure;
      else reasons[key] = key === "path" && datasets.size > 1 ? `The runs are of ${datasets.size} datasets, so their paths are not drawn together.` : "None of these runs has data for this plot.";
      const lacking = runs.filter((run) => !withData(key, runs).includes(run)).map((run) => run.id);
      place.parentElement.querySelector("figcaption").textContent = figure && lacking.length ? `Without data: ${lacking.length > 1 ? "runs" : "run"} ${lacking.join(", ")}.` : "";
    }
    slamhiveDraw({ figures, reasons, plane: runs.find((run) => run.plane)?.plane });
  }

  /** What the 3D view loads when it is opened. */
  function offerScene(runs, columns, datasets) {
    const panel = document.querySelector("[data-viewer]");
    const look = (run) => {
      const [colour, dark] = colours[columns.findIndex((column) => column.runs.includes(run))];
      return { address: `runs/${run.id}.scene.js`, name: `run ${run.id}, ${run.algorithm}`, colour, dark };
    };
    const having = runs.filter((run) => run.scene);
    panel.parentElement.hidden = datasets.size > 1 || !having.length;
    panel.dataset.scene = JSON.stringify(having.map(look));
  }

  /** A link to the other way to show the same runs, if there are repeats. */
  function offerGroups(runs) {
    const link = document.getElementById("grouping");
    const other = new URLSearchParams({ runs: ids.join(","), ...(grouped ? {} : { group: "configuration" }) });
    link.hidden = !grouped && groups.columns(runs, true).length === runs.length;
    link.href = `compare.html?${decodeURIComponent(other)}`;
    link.textContent = grouped ? "Show single runs" : "Group by configuration";
  }

  function show(runs) {
    const columns = groups.columns(runs, grouped);
    offerGroups(runs);
    const datasets = new Set(runs.map((run) => run.dataset));
    const protocols = new Map(runs.filter((run) => run.use).map(({ use: [fingerprint, label] }) => [fingerprint, label]));
    const mixed = slamhiveProtocols.show(runs.map((run) => run.use).filter(Boolean));
    const without = runs.filter((run) => !run.use).map((run) => run.id);
    document.querySelector("h1").textContent = grouped ? `Comparison of ${columns.length} configuration${columns.length > 1 ? "s" : ""}` : `Comparison of ${runs.length} runs`;
    const words = [...protocols].map(([fingerprint, label]) => `${label} (${fingerprint})`);
    const lines = [protocols.size === 1 ? `Protocol: ${words[0]}.` : protocols.size ? `Protocols: ${words.join("; ")}.` : "None of these runs is evaluated."];
    if (protocols.size && without.length) lines.push(`Not evaluated: ${without.length > 1 ? "runs" : "run"} ${without.join(", ")}.`);
    says.textContent = lines.join(" ");
    const unmarked = unmarkedParts(runs, mixed);
    const chance = grouped ? ", a difference that chance explains (Welch, 95 %)" : "";
    const means = grouped ? " Means leave failed runs out; below each mean is its 95 % interval (Student)." : "";
    const rule = `The better value is marked with ★. There is no mark on a tie${chance}, or for a metric without a better direction. A run that failed or is very doubtful is never marked.${means}`;
    document.getElementById("marks").textContent = [...(datasets.size > 1 ? [] : [rule]), ...unmarked.map(({ words: why }) => why)].join(" ");
    document.querySelector("[data-comparison]").hidden = false;
    showMetrics(runs, columns, unmarked);
    showPlots(runs, columns, datasets);
    offerScene(runs, columns, datasets);
    showSettings(runs, columns);
  }

  const bad = ids.find((id, place) => !/^[1-9]\d{0,15}$/.test(id) || ids.indexOf(id) !== place);
  if (bad !== undefined) says.textContent = `${bad.slice(0, 40)} is not the number of a run, or it is named twice.`;
  else if (ids.length < FEWEST || ids.length > most) says.textContent = `Select ${FEWEST} to ${most} runs in the list, then press Compare.`;
  else Promise.all(ids.map(load)).then(() => show(ids.map((id) => loaded.get(id)))).catch((error) => { says.textContent = error.message; });
})();
