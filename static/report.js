// Draws plots with Plotly: those of a report, from the JSON in the page, and those of a static site. A click on a point
// opens its run.
"use strict";
(() => {
  const PAPER_PX = 680;
  const MOST_COLOURS = 1000;
  const { dark, inks, numbers, offersLog, plotly, preferred, whenPrinting, withTable } = slamhivePlots;
  const axis = (spec, ink) => ({ color: ink.text, gridcolor: ink.grid, zerolinecolor: ink.grid, linecolor: ink.grid, ...spec });

  function inked({ line, marker }, color) {
    if (line) line = { ...line, color };
    if (marker) marker = { ...marker, color, ...(marker.line ? { line: { ...marker.line, color } } : {}) };
    if (marker?.pattern) marker.pattern = { ...marker.pattern, fgcolor: color };
    return { ...(line ? { line } : {}), ...(marker ? { marker } : {}) };
  }

  /** A copy of a trace in which each colour is replaced by the one in the map; big arrays are kept. */
  function recoloured(part, colours) {
    if (typeof part === "string") return colours[part] || part;
    if (Array.isArray(part)) return part.length > MOST_COLOURS ? part : part.map((entry) => recoloured(entry, colours));
    if (part === null || typeof part !== "object" || ArrayBuffer.isView(part)) return part;
    return Object.fromEntries(Object.entries(part).map(([key, entry]) => [key, recoloured(entry, colours)]));
  }

  /** The figure with what depends on light or dark; references carry a mark, since no single grey is seen on both. */
  function themed(figure, margin) {
    const ink = inks();
    const onDark = dark() && figure.layout.meta?.dark;
    const data = figure.data.map((trace) => onDark ? recoloured(trace, onDark) : trace).map((trace) => ({
      ...trace,
      ...(trace.type === "bar" && trace.error_y ? { error_y: { ...trace.error_y, color: ink.truth } } : {}),
      ...(trace.meta === "theme:groundtruth" ? inked(trace, ink.truth) : {}),
    }));
    const layout = {
      ...figure.layout,
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink.text, family: "system-ui, sans-serif", size: 12 },
      margin: { ...margin, ...figure.layout.margin },
      hoverlabel: { namelength: -1 },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: ink.modebar, activecolor: ink.text },
      uirevision: "kept",
      autosize: true,
    };
    for (const name of ["xaxis", "yaxis", "yaxis2"]) {
      if (layout[name] || (name !== "yaxis2" && !layout.scene)) layout[name] = axis(layout[name] || {}, ink);
    }
    if (layout.scene) {
      layout.margin = { l: 0, r: 0, t: margin.t, b: 0 };
      layout.scene = { ...layout.scene };
      for (const name of ["xaxis", "yaxis", "zaxis"]) layout.scene[name] = axis(layout.scene[name], ink);
    }
    return { data, layout };
  }

  /** The buttons of a plot are one Tab stop; the arrow keys move between them. */
  function asToolbar(place) {
    const bar = place.querySelector(".modebar");
    const buttons = [...place.querySelectorAll(".modebar-btn")];
    if (!bar || !buttons.length) return;
    bar.setAttribute("role", "toolbar");
    bar.setAttribute("aria-label", "Tools of the plot");
    buttons.forEach((button, at) => {
      button.tabIndex = at ? -1 : 0;
      button.onkeydown = (event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!step) return;
        const next = buttons[(at + step + buttons.length) % buttons.length];
        buttons.forEach((other) => { other.tabIndex = other === next ? 0 : -1; });
        next.focus();
      };
    });
  }

  const LOG_ICON = { width: 24, height: 24, path: "M2 2h2.5v17.5H22V22H2zM7 15h15v2H7zM7 11.5h15v1.5H7zM7 6h15v1.5H7z" };

  /** The figure with its heights on the axis that somebody has chosen for this place. */
  function scaled(place, figure) {
    const type = place.dataset.scale;
    if (!type || !offersLog(figure)) return figure;
    const { range, rangemode, autorange, ...yaxis } = figure.layout.yaxis || {};
    return { ...figure, layout: { ...figure.layout, yaxis: { ...yaxis, type, autorange: true, uirevision: type } } };
  }

  function logButton(figure) {
    const first = figure.layout.yaxis?.type === "log" ? "log" : "linear";
    return {
      name: "log",
      title: "Logarithmic or linear axis",
      icon: LOG_ICON,
      click: (place) => {
        place.dataset.scale = (place.dataset.scale || first) === "log" ? "linear" : "log";
        show(place, ...shown.get(place));
      },
    };
  }

  const shown = new Map();

  /** Draws a figure anew, at once where Plotly is there: a page that is printed does not wait. */
  function show(place, figure, margin, options) {
    shown.set(place, [figure, margin, options]);
    withTable(place, figure);
    return window.Plotly ? react(place, figure, margin, options) : plotly().then(() => react(place, figure, margin, options));
  }

  /** The bar of buttons does not offer Plotly's own, to upload the chart to a server. */
  function react(place, figure, margin, options) {
    const { data, layout } = themed(scaled(place, figure), margin);
    const drawn = Plotly.react(place, data, layout, {
      responsive: true,
      displaylogo: false,
      plotlyServerURL: "",
      modeBarButtonsToRemove: ["sendChartToCloud", "select2d", "lasso2d", "autoScale2d"],
      modeBarButtonsToAdd: offersLog(figure) ? [logButton(figure)] : [],
      ...options,
    });
    return drawn.then(() => asToolbar(place));
  }
  window.slamhiveShow = show;

  /** All plots in light colours and as wide as a sheet of paper; a plot that needs more is made smaller. */
  function toPaper(printing) {
    for (const [place, drawn] of shown) {
      if (!place.isConnected || !place.classList.contains("js-plotly-plot")) {
        shown.delete(place);
        continue;
      }
      const width = Math.max(PAPER_PX, Number(place.dataset.leastWidth || 0));
      place.style.width = printing ? `${width}px` : "";
      place.style.zoom = printing ? PAPER_PX / width : "";
      show(place, ...drawn);
    }
  }
  whenPrinting((printing) => {
    if (printing) places().forEach(draw);
    toPaper(printing);
  });

  const source = document.getElementById("figures");
  const places = () => source ? document.querySelectorAll("[data-chart]") : [];
  if (!source) return;
  const MARGIN = { l: 64, r: 16, t: 36, b: 52 };
  const NARROW_PX = 600;
  let figures = source.dataset.from ? null : JSON.parse(source.textContent);

  /** Of a chart that shows density: every point of the part looked at, if it holds few enough; the density otherwise. */
  function zoomed(place, figure) {
    const { most, first } = figure.zoom;
    const points = place.allPoints ??= figure.zoom.points.map((part) => ({ x: numbers(part.x), y: numbers(part.y), runs: part.runs && numbers(part.runs) }));
    const span = (name) => {
      const { range, type } = place.layout[name];
      const ends = type === "log" ? range.map((end) => 10 ** end) : range;
      return [Math.min(...ends), Math.max(...ends)];
    };
    const [left, right] = span("xaxis");
    const [bottom, top] = span("yaxis");
    const inside = points.map(({ x, y }) => {
      const rows = [];
      for (let row = 0; row < x.length; row += 1) if (x[row] >= left && x[row] <= right && y[row] >= bottom && y[row] <= top) rows.push(row);
      return rows;
    });
    const few = inside.reduce((sum, rows) => sum + rows.length, 0) <= most;
    if (!few && !place.showsPoints) return;
    place.showsPoints = few;
    const drawn = (part, rows, trace) => few
      ? { x: rows.map((row) => part.x[row]), y: rows.map((row) => part.y[row]), customdata: part.runs && rows.map((row) => part.runs[row]) }
      : { x: trace.x, y: trace.y, customdata: trace.customdata };
    const shown = points.map((part, place) => drawn(part, inside[place], figure.data[first + place]));
    const traces = points.map((_, place) => first + place);
    const densities = Array.from({ length: first }, (_, place) => place);
    Plotly.restyle(place, { x: shown.map((part) => part.x), y: shown.map((part) => part.y), customdata: shown.map((part) => part.customdata) }, traces)
      .then(() => Plotly.restyle(place, { opacity: few ? 0 : 1, hoverinfo: few ? "skip" : "all" }, densities));
  }

  function draw(place) {
    const figure = figures?.[place.dataset.chart];
    if (!figure) return;
    place.showsPoints = false;
    show(place, figure, MARGIN, {
      displayModeBar: place.clientWidth < NARROW_PX ? false : "hover",
      toImageButtonOptions: { format: "svg" },
    }).then(() => listen(place, figure), (error) => { place.textContent = `The plot could not be drawn: ${error.message}.`; });
  }

  function listen(place, figure) {
    if (place.dataset.listens) return;
    place.dataset.listens = "1";
    place.dispatchEvent(new Event("chartdrawn", { bubbles: true }));
    if (figure.zoom) place.on("plotly_relayout", () => zoomed(place, figure));
    const pattern = source.dataset.run;
    if (!pattern) return;
    place.on("plotly_click", (event) => {
      const run = event.points[0]?.customdata;
      if (Number.isInteger(run) && run > 0 && event.points[0].data.type !== "heatmap") window.location.href = pattern.replace("RUN", run);
    });
  }

  // Draw plots far down the page only when they come near, so the first ones do not wait for them.
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      watcher.unobserve(entry.target);
      draw(entry.target);
    }
  }, { rootMargin: "800px" });
  const begin = () => places().forEach((place) => watcher.observe(place));
  // The server's policy forbids style attributes. Reserve the space before drawing, so nothing jumps.
  places().forEach((place) => {
    place.style.minHeight = `${place.dataset.height}px`;
    if (place.dataset.leastWidth > 0) place.style.minWidth = `${place.dataset.leastWidth}px`;
  });
  const again = () => places().forEach((place) => { if (place.classList.contains("js-plotly-plot")) draw(place); });
  document.addEventListener("themechange", again);
  preferred.addEventListener("change", again);
  if (figures) begin();
  else fetch(source.dataset.from).then((answer) => answer.json()).then((content) => { figures = content; begin(); });
})();
