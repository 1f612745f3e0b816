// Draws the charts of a report from the JSON beside them, in the colours of light or dark; a click opens the run.
"use strict";
(() => {
  const source = document.getElementById("figures");
  if (!source) return;
  let figures = source.dataset.from ? null : JSON.parse(source.textContent);
  const preferred = window.matchMedia("(prefers-color-scheme: dark)");

  const dark = () => (document.documentElement.dataset.bsTheme || (preferred.matches ? "dark" : "light")) === "dark";
  const inks = () => dark()
    ? { text: "#d7dbe0", grid: "#3a4047", truth: "#c3c9d0" }
    : { text: "#2b3035", grid: "#e3e6ea", truth: "#3d4247" };
  const axis = (spec, ink) => ({ color: ink.text, gridcolor: ink.grid, zerolinecolor: ink.grid, linecolor: ink.grid, ...spec });

  function themed(figure) {
    const ink = inks();
    const data = figure.data.map((trace) => trace.meta !== "theme:groundtruth" ? trace : {
      ...trace,
      ...(trace.line ? { line: { ...trace.line, color: ink.truth } } : {}),
      ...(trace.marker ? { marker: { ...trace.marker, color: ink.truth } } : {}),
    });
    const layout = {
      ...figure.layout,
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: { color: ink.text, family: "system-ui, sans-serif", size: 12 },
      margin: { l: 64, r: 16, t: 36, b: 52 },
      hoverlabel: { namelength: -1 },
      modebar: { bgcolor: "rgba(0,0,0,0)", color: ink.grid, activecolor: ink.text },
      uirevision: "kept",
      autosize: true,
    };
    for (const name of ["xaxis", "yaxis", "yaxis2"]) if (layout[name]) layout[name] = axis(layout[name], ink);
    if (layout.scene) {
      layout.margin = { l: 0, r: 0, t: 36, b: 0 };
      layout.scene = { ...layout.scene };
      for (const name of ["xaxis", "yaxis", "zaxis"]) layout.scene[name] = axis(layout.scene[name], ink);
    }
    return { data, layout };
  }

  function draw(place) {
    const figure = figures[place.dataset.chart];
    if (!figure) return;
    const { data, layout } = themed(figure);
    Plotly.react(place, data, layout, { responsive: true, displaylogo: false, toImageButtonOptions: { format: "svg" } });
    const pattern = source.dataset.run;
    if (!pattern || place.dataset.clickable) return;
    place.dataset.clickable = "1";
    place.on("plotly_click", (event) => {
      const run = event.points[0]?.customdata;
      if (Number.isInteger(run) && run > 0) window.location.href = pattern.replace("RUN", run);
    });
  }

  // Charts far down the page are drawn when they come near: the first ones need not wait for them.
  const watcher = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      watcher.unobserve(entry.target);
      draw(entry.target);
    }
  }, { rootMargin: "800px" });
  const places = () => document.querySelectorAll("[data-chart]");
  const begin = () => places().forEach((place) => watcher.observe(place));
  // A policy of the server forbids styles in attributes; the room is taken before anything is drawn, so nothing jumps.
  places().forEach((place) => { place.style.minHeight = `${place.dataset.height}px`; });
  const again = () => places().forEach((place) => { if (place.classList.contains("js-plotly-plot")) draw(place); });
  window.addEventListener("beforeprint", () => places().forEach(draw));
  document.addEventListener("themechange", again);
  preferred.addEventListener("change", again);
  if (figures) begin();
  else fetch(source.dataset.from).then((answer) => answer.json()).then((content) => { figures = content; begin(); });
})();
