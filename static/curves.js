// Draws curves over a common axis with uPlot, from the same figures that Plotly reads: lines, points, bands and steps
// on axes of numbers. Plots of one page whose axes have the same title share their cursor and their zoom.
"use strict";
(() => {
  const { element, inks, list, offersLog, plain, savePicture, short, toggleTable, whenPrinting, withTable } = slamhivePlots;
  const CLICK_PX = 4;
  const LEFT_PX = 58;
  const DASHES = { dash: [6, 4], dot: [2, 3] };
  const STEPPED = uPlot.paths.stepped({ align: 1 });
  const NEAREST_POINTS = 400;
  const drawn = new Map();

  /** Whether a figure consists of lines and points on two axes of numbers. */
  function draws({ data, layout }) {
    const { xaxis = {}, yaxis = {}, scene, yaxis2 } = layout;
    if (scene || yaxis2 || yaxis.scaleanchor || [xaxis, yaxis].some(({ type }) => type === "category" || type === "date")) return false;
    const numeric = (values) => Boolean(values?.bdata) || (Array.isArray(values) && values.every((value) => value === null || typeof value === "number"));
    return data.length > 0 && data.every(({ type = "scatter", x, y }) => type.startsWith("scatter") && type !== "scatter3d" && numeric(x) && numeric(y));
  }

  /** The values of a trace in ascending order of x; a place without numbers becomes a gap. */
  function tableOf(trace) {
    const [x, y] = [list(trace.x), list(trace.y)];
    const rows = [];
    for (let place = 0; place < x.length; place += 1) {
      if (Number.isFinite(x[place])) rows.push([x[place], Number.isFinite(y[place]) ? y[place] : null]);
      else if (rows.length && Number.isFinite(x[place + 1])) rows.push([(rows[rows.length - 1][0] + x[place + 1]) / 2, null]);
    }
    rows.sort((one, other) => one[0] - other[0]);
    return [rows.map(([at]) => at), rows.map(([, value]) => value)];
  }

  /** The curves of a figure: its traces, and two for each band, which Plotly draws as one closed line. */
  function curvesOf({ data }) {
    return data.flatMap((trace) => {
      if (trace.fill !== "toself") return [trace];
      const [x, y] = [list(trace.x), list(trace.y)];
      const half = x.length / 2;
      const edge = { ...trace, fill: undefined };
      return [{ ...edge, x: x.slice(0, half), y: y.slice(0, half) }, { ...edge, x: x.slice(half), y: y.slice(half), below: trace.fillcolor }];
    });
  }

  function colourOf(trace, figure) {
    if (trace.meta === "theme:groundtruth") return inks().truth;
    const colour = trace.line?.color ?? trace.marker?.color ?? inks().text;
    return (slamhivePlots.dark() && figure.layout.meta?.dark?.[colour]) || colour;
  }

  function seriesOf(trace, figure) {
    const colour = colourOf(trace, figure);
    const isCross = String(trace.marker?.symbol ?? "").startsWith("x");
    const hasLine = (trace.mode ?? "lines").includes("lines");
    const hasPoints = (trace.mode ?? "").includes("markers") && !isCross;
    return {
      label: plain(trace.name),
      stroke: colour,
      width: trace.line?.width ?? 1.5,
      dash: DASHES[trace.line?.dash],
      fill: trace.fill === "tozeroy" ? trace.fillcolor ?? colour : undefined,
      paths: hasLine ? (trace.line?.shape === "hv" ? STEPPED : undefined) : () => null,
      points: { show: hasPoints, size: trace.marker?.size ?? 4, fill: colour, stroke: colour, width: 0 },
      spanGaps: false,
      cross: isCross,
      run: trace.run,
      silent: trace.hoverinfo === "skip",
    };
  }

  /** Crosses for what has no value of its own, such as dropped frames. */
  function crosses(u, place) {
    const { cross, stroke } = u.series[place];
    if (!cross) return;
    const { ctx, data } = u;
    const arm = 3 * devicePixelRatio;
    ctx.save();
    ctx.strokeStyle = typeof stroke === "function" ? stroke(u, place) : stroke;
    ctx.lineWidth = 1.2 * devicePixelRatio;
    ctx.setLineDash([]);
    ctx.beginPath();
    data[place].forEach((value, row) => {
      if (value === null || value === undefined) return;
      const [x, y] = [u.valToPos(data[0][row], "x", true), u.valToPos(value, "y", true)];
      if (x < u.bbox.left || x > u.bbox.left + u.bbox.width) return;
      ctx.moveTo(x - arm, y - arm);
      ctx.lineTo(x + arm, y + arm);
      ctx.moveTo(x - arm, y + arm);
      ctx.lineTo(x + arm, y - arm);
    });
    ctx.stroke();
    ctx.restore();
  }

  /** Grey areas below the curves, as the figure has them. */
  function areas(u, shapes = []) {
    const { ctx, bbox } = u;
    for (const { type, x0, x1, fillcolor } of shapes) {
      if (type !== "rect") continue;
      const [from, to] = [x0, x1].map((x) => Math.min(bbox.left + bbox.width, Math.max(bbox.left, u.valToPos(x, "x", true))));
      ctx.fillStyle = fillcolor;
      ctx.fillRect(from, bbox.top, to - from, bbox.height);
    }
  }

  /** The line at the moment that somebody has chosen. */
  function momentLine(u, at) {
    if (at === null) return;
    const { ctx, bbox } = u;
    const x = Math.round(u.valToPos(at, "x", true));
    if (x < bbox.left || x > bbox.left + bbox.width) return;
    ctx.save();
    ctx.strokeStyle = inks().text;
    ctx.lineWidth = 1.5 * devicePixelRatio;
    ctx.setLineDash([]);
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.restore();
  }

  /** The row nearest to ``wanted`` in which a series has a value. */
  function nearest(u, place, row, wanted) {
    const values = u.data[place];
    const known = (at) => values[at] !== null && values[at] !== undefined;
    let best = null;
    for (const step of [-1, 1]) {
      for (let at = row, tried = 0; at >= 0 && at < values.length && tried < NEAREST_POINTS; at += step, tried += 1) {
        if (!known(at)) continue;
        if (best === null || Math.abs(u.data[0][at] - wanted) < Math.abs(u.data[0][best] - wanted)) best = at;
        break;
      }
    }
    return best;
  }

  /** The value of every series at x, as [series, x, value]. */
  function valuesAt(u, x) {
    const row = u.valToIdx(x);
    return u.series.flatMap((series, place) => {
      if (place === 0 || !series.show || series.silent) return [];
      const at = nearest(u, place, row, x);
      return at === null ? [] : [[series, u.data[0][at], u.data[place][at]]];
    });
  }

  const MOST_VALUES = 6;

  /** Writes what the curves show at the cursor, or at the chosen moment, into the line above the plot. */
  function tell(entry) {
    const { u, readout, title } = entry;
    const pointed = u.cursor.left >= 0 && u.cursor.left !== null ? u.posToVal(u.cursor.left, "x") : null;
    const x = pointed ?? entry.moment;
    if (x === null || !Number.isFinite(x)) return readout.replaceChildren();
    const unit = /\[(.+)\]/.exec(title.x)?.[1] ?? "";
    const parts = [element("span", `${Number(x.toFixed(2))} ${unit}`)];
    for (const [series, at, value] of valuesAt(u, x).slice(0, MOST_VALUES)) {
      if (series.cross) {
        if (series.run === undefined && Math.abs(at - x) * u.bbox.width / devicePixelRatio < 3 * (u.scales.x.max - u.scales.x.min)) parts.push(element("b", series.label));
        continue;
      }
      const part = element("span", "", { class: "value" });
      const mark = element("i");
      mark.style.background = typeof series.stroke === "function" ? series.stroke(u) : series.stroke;
      part.append(mark, short(Number(value.toPrecision(3))));
      parts.push(part);
    }
    return readout.replaceChildren(...parts);
  }

  /** The part of the x axis that is shown at first: the one that the figure states, otherwise all. */
  function wholeOf(figure, data) {
    const stated = figure.layout.xaxis?.range;
    const known = data[0];
    return stated ?? (known.length ? [known[0], known[known.length - 1]] : [0, 1]);
  }

  const group = ({ title }) => [...drawn.values()].filter((other) => other.title.x === title.x);

  /** Zooming into one plot zooms into all with the same axis. */
  function zoomTogether(entry, min, max) {
    for (const other of group(entry)) {
      const { x } = other.u.scales;
      if (other !== entry && (x.min !== min || x.max !== max)) other.u.setScale("x", { min, max });
    }
  }

  function optionsOf(entry) {
    const { figure, place, title } = entry;
    const ink = inks();
    const isLog = (place.dataset.scale ?? figure.layout.yaxis?.type) === "log" && offersLog(figure);
    const fromZero = figure.layout.yaxis?.rangemode === "tozero";
    const axis = { stroke: ink.text, font: "11px system-ui, sans-serif", grid: { stroke: ink.grid, width: 1 }, ticks: { stroke: ink.grid, width: 1, size: 4 } };
    const bands = entry.curves.flatMap(({ below }, at) => (below ? [{ series: [at, at + 1], fill: below }] : []));
    const stacked = "stacked" in place.dataset;
    return {
      ...sizeOf(entry),
      padding: [8, 12, stacked ? 4 : 0, 0],
      legend: { show: false },
      cursor: {
        y: false,
        points: { show: (u, at) => (u.series[at].silent || u.series[at].cross ? undefined : uPlot.assign(document.createElement("div"), { className: "u-cursor-pt" })), size: 7 },
        drag: { x: true, y: false, setScale: true },
        sync: { key: uPlot.sync(title.x).key, scales: ["x", null], filters: { pub: (type) => type === "mousemove" || type === "mouseleave" } },
        dataIdx: (u, at, row, x) => nearest(u, at, row, x) ?? row,
        bind: { dblclick: () => () => { reset(entry); return null; } },
      },
      scales: {
        x: { time: false, range: (_, min, max) => [min, max] },
        y: {
          distr: isLog ? 3 : 1,
          range: isLog ? (_, min, max) => uPlot.rangeLog(min > 0 ? min : 1e-6, max > 0 ? max : 1, 10, false) : (_, min, max) => heightOf(min, max, fromZero),
        },
      },
      axes: [
        { ...axis, size: 22, gap: 3, label: stacked ? undefined : title.x, labelSize: 16, labelGap: 0, labelFont: axis.font },
        { ...axis, size: LEFT_PX, gap: 4, values: (u, splits) => splits.map((value) => (value === null || value === undefined ? "" : short(Number(value.toPrecision(6))))) },
      ],
      series: [{ label: title.x }, ...entry.curves.map((trace) => seriesOf(trace, figure))],
      bands,
      hooks: {
        drawClear: [(u) => areas(u, figure.layout.shapes)],
        drawSeries: [crosses],
        draw: [(u) => momentLine(u, entry.moment)],
        setCursor: [() => entry.u && tell(entry)],
        setScale: [(u, key) => { if (key === "x" && entry.u) zoomed(entry); }],
      },
    };
  }

  function heightOf(min, max, fromZero) {
    if (min === null || max === null || !Number.isFinite(min) || !Number.isFinite(max)) return [0, 1];
    const low = fromZero ? Math.min(0, min) : min;
    const room = (max - low) * 0.06 || Math.abs(max) * 0.1 || 1;
    return [low < 0 || !fromZero ? low - (fromZero ? 0 : room) : 0, max + room];
  }

  function sizeOf({ body }) {
    return { width: Math.max(120, body.clientWidth), height: Math.max(60, body.clientHeight) };
  }

  function zoomed(entry) {
    const { min, max } = entry.u.scales.x;
    entry.resetButton.hidden = min === entry.whole[0] && max === entry.whole[1];
    zoomTogether(entry, min, max);
  }

  function reset(entry) {
    entry.u.setScale("x", { min: entry.whole[0], max: entry.whole[1] });
  }

  /** A click that was no drag names its moment to whoever draws the page. */
  function listen(entry) {
    const { over } = entry.u;
    let pressed = null;
    over.addEventListener("mousedown", ({ clientX }) => { pressed = clientX; });
    over.addEventListener("click", ({ clientX }) => {
      if (pressed !== null && Math.abs(clientX - pressed) > CLICK_PX) return;
      const x = entry.u.posToVal(clientX - over.getBoundingClientRect().left, "x");
      entry.options.pick?.(x);
    });
  }

  function tool(text, title, act) {
    const button = element("button", text, { type: "button", class: "plot-tool", title });
    button.addEventListener("click", act);
    return button;
  }

  /** The line above a plot: what its heights are, what is shown at the cursor, and its tools. */
  function frame(entry) {
    const { place, title, figure } = entry;
    const head = element("div", "", { class: "plot-head" });
    entry.readout = element("output", "", { class: "plot-values" });
    entry.body = element("div", "", { class: "plot-body" });
    entry.resetButton = tool("All", "Show the whole axis again (double click)", () => reset(entry));
    entry.resetButton.hidden = true;
    const tools = element("span", "", { class: "plot-tools", role: "group", "aria-label": "Tools of the plot" });
    tools.append(entry.resetButton);
    if (offersLog(figure)) {
      const isLog = (place.dataset.scale ?? figure.layout.yaxis?.type) === "log";
      const button = tool("Log", "Logarithmic or linear axis", () => {
        place.dataset.scale = (place.dataset.scale ?? figure.layout.yaxis?.type) === "log" ? "linear" : "log";
        redraw(entry);
        place.querySelector("[aria-pressed]").focus();
      });
      button.setAttribute("aria-pressed", isLog);
      tools.append(button);
    }
    tools.append(tool("Table", "Data as a table", () => toggleTable(place)));
    tools.append(tool("PNG", "Save this plot as a picture", () => save(entry)));
    head.append(element("span", title.y, { class: "plot-title" }), entry.readout, tools);
    place.replaceChildren(head, entry.body);
    const legend = legendOf(entry);
    if (legend) place.append(legend);
  }

  /** The curves by name, each a button that hides or shows it; none if another part of the page names them. */
  function legendOf(entry) {
    const { layout } = entry.figure;
    const named = entry.curves.map((trace, at) => [trace, at + 1]).filter(([trace]) => trace.name && trace.showlegend !== false && trace.hoverinfo !== "skip");
    if (layout.showlegend === false || named.length < 2) return null;
    const legend = element("div", "", { class: "plot-legend" });
    for (const [trace, at] of named) {
      const button = element("button", plain(trace.name), { type: "button", class: "plot-tool", "aria-pressed": "true" });
      const mark = element("i");
      mark.style.background = colourOf(trace, entry.figure);
      button.prepend(mark);
      button.addEventListener("click", () => {
        const shown = !entry.u.series[at].show;
        entry.u.setSeries(at, { show: shown });
        button.setAttribute("aria-pressed", shown);
      });
      legend.append(button);
    }
    return legend;
  }

  function save({ u, place, title }) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [u.ctx.canvas.width, u.ctx.canvas.height + 24 * devicePixelRatio];
    const context = canvas.getContext("2d");
    context.fillStyle = inks().page;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.fillStyle = inks().text;
    context.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    context.fillText(title.y, 8 * devicePixelRatio, 16 * devicePixelRatio);
    context.drawImage(u.ctx.canvas, 0, 24 * devicePixelRatio);
    savePicture(canvas, place.dataset.figure ?? place.dataset.chart ?? "plot");
  }

  function redraw(entry) {
    const { figure, place } = entry;
    const kept = entry.u && [entry.u.scales.x.min, entry.u.scales.x.max];
    const hidden = entry.hidden ?? new Set();
    entry.u?.destroy();
    entry.u = null;
    entry.curves = curvesOf(figure);
    frame(entry);
    const data = uPlot.join(entry.curves.map(tableOf));
    const before = entry.whole;
    entry.whole = wholeOf(figure, data);
    const options = optionsOf(entry);
    options.series.forEach((series, at) => { if (at && hidden.has(entry.curves[at - 1].run)) series.show = false; });
    entry.u = new uPlot(options, data, entry.body);
    // A plot that grows while a run is going shows all of it, unless somebody has zoomed in.
    const [min, max] = kept && before && (kept[0] !== before[0] || kept[1] !== before[1]) ? kept : entry.whole;
    entry.u.setScale("x", { min, max });
    listen(entry);
    tell(entry);
    place.dataset.drawn = entry.u.scales.y.distr === 3 ? "log" : "linear";
  }

  const sizes = new ResizeObserver((changes) => {
    for (const { target } of changes) {
      const entry = drawn.get(target.parentElement);
      if (entry?.u && target === entry.body && (entry.u.width !== target.clientWidth || entry.u.height !== target.clientHeight)) entry.u.setSize(sizeOf(entry));
    }
  });

  /** Draws a figure into a place. ``pick`` is called with the x of a click. */
  function draw(place, figure, options = {}) {
    const entry = drawn.get(place) ?? { place, moment: null };
    const title = (name) => plain(figure.layout[name]?.title?.text ?? figure.layout[name]?.title);
    Object.assign(entry, { figure, options, title: { x: title("xaxis"), y: title("yaxis") } });
    drawn.set(place, entry);
    place.classList.add("curves");
    redraw(entry);
    sizes.observe(entry.body);
    withTable(place, figure);
  }

  /** Forgets a place that shows something else from now on. */
  function clear(place) {
    drawn.get(place)?.u?.destroy();
    drawn.delete(place);
    place.classList.remove("curves");
    delete place.dataset.drawn;
  }

  /** Draws the line of the chosen moment at x; null for none. */
  function mark(place, x) {
    const entry = drawn.get(place);
    if (!entry) return;
    entry.moment = x;
    if (x === null) delete place.dataset.moment; else place.dataset.moment = x;
    entry.u.redraw(false);
    tell(entry);
  }

  /** Hides the curves of some runs: those whose trace names one of them. */
  function hide(place, runs) {
    const entry = drawn.get(place);
    if (!entry) return;
    entry.hidden = runs;
    entry.curves.forEach(({ run }, at) => { if (run !== undefined) entry.u.setSeries(at + 1, { show: !runs.has(run) }); });
    tell(entry);
  }

  function again() {
    for (const [place, entry] of drawn) {
      if (!place.isConnected) { entry.u?.destroy(); drawn.delete(place); } else {
        redraw(entry);
        sizes.observe(entry.body);
      }
    }
  }

  document.addEventListener("themechange", again);
  whenPrinting(again);
  window.slamhiveCurves = { clear, draw, draws, hide, mark, valuesAt: (place, x) => (drawn.has(place) ? valuesAt(drawn.get(place).u, x) : []) };
})();
