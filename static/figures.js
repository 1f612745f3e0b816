// Draws the plots of a page from the JSON at data-figures, in the light or dark colours defined in report.js.
"use strict";
(() => {
  const WHILE_ACTIVE_MS = 5000;
  const VIEWS = { xy: "path_xy", xz: "path_xz", yz: "path_yz", "3d": "path_3d" };
  let content = null;
  let view = null;

  const MARGIN = { l: 58, r: 12, t: 28, b: 44 };

  function say(place, text) {
    Plotly.purge(place);
    if (place.nextElementSibling?.matches("details.plot-table")) place.nextElementSibling.remove();
    const line = document.createElement("p");
    line.className = "quiet";
    line.textContent = text;
    place.replaceChildren(line);
  }

  function draw(place) {
    const key = place.dataset.figure;
    const figure = content.figures[key === "path" ? VIEWS[view] : key];
    const panel = place.closest("[data-shown-with-data]");
    if (panel) panel.hidden = !figure;
    if (!figure) {
      say(place, content.reasons[key === "path" ? "estimate" : key] || "No data for this plot.");
      place.classList.add("without");
      return;
    }
    place.classList.remove("without");
    if (!place.classList.contains("js-plotly-plot")) place.replaceChildren();
    const name = `${document.title.split(" – ")[0]} ${key}`.replace(/\W+/g, "-").toLowerCase();
    slamhiveShow(place, figure, MARGIN, {
      toImageButtonOptions: { format: "svg", filename: name },
      showTips: false,
    });
    if ("time" in place.dataset) linkTime(place);
    if (key in origins()) pickTime(place, key);
    place.setAttribute("role", "group");
    place.setAttribute("aria-label", document.querySelector(`[data-caption="${key}"]`)?.textContent || key);
  }

  /** Zooming into a time in one plot shows the same time in the others with the same axis. */
  function linkTime(place) {
    if (place.dataset.linked) return;
    place.dataset.linked = "1";
    place.on("plotly_relayout", (change) => {
      if (!("xaxis.range[0]" in change)) return;
      const range = [change["xaxis.range[0]"], change["xaxis.range[1]"]];
      const axis = place.layout.xaxis.title.text;
      for (const other of document.querySelectorAll("[data-time].js-plotly-plot")) {
        const shown = other.layout.xaxis;
        const same = shown.title.text === axis && shown.range[0] === range[0] && shown.range[1] === range[1];
        if (other !== place && shown.title.text === axis && !same) Plotly.relayout(other, { "xaxis.range": [...range] });
      }
    });
  }

  /** {plot: timestamp at which its time axis is 0}, for plots over the time of a recording. */
  const origins = () => content.timeline?.origins ?? {};

  /** A click on a plot announces its moment; moment.js shows what the sensors saw then. */
  function pickTime(place, key) {
    if (place.dataset.picks) return;
    place.dataset.picks = "1";
    place.on("plotly_click", ({ points }) => {
      document.dispatchEvent(new CustomEvent("moment", { detail: origins()[key] + Number(points[0].x) }));
    });
  }

  /** A line at a moment in every plot over the time of the recording. */
  function mark(timestamp) {
    for (const [key, origin] of Object.entries(origins())) {
      const place = document.querySelector(`[data-figure="${key}"].js-plotly-plot`);
      const x = timestamp - origin;
      const line = { type: "line", x0: x, x1: x, yref: "paper", y0: 0, y1: 1, line: { dash: "dot", width: 1.5, color: "#8a929a" } };
      const areas = (content.figures[key].layout.shapes ?? []);
      if (place) Plotly.relayout(place, { shapes: [line, ...areas] });
    }
  }

  /** Panels of a failed run without data are hidden; one sentence for each reason says which they are. */
  function sayWhatIsMissing() {
    const place = document.querySelector("[data-no-plots]");
    if (!place) return;
    const titles = {};
    for (const panel of document.querySelectorAll("[data-shown-with-data][hidden]")) {
      const key = panel.querySelector("[data-figure]").dataset.figure;
      const reason = content.reasons[key === "path" ? "estimate" : key] || "This run has no data for it.";
      (titles[reason] ??= []).push(panel.querySelector("h2").textContent);
    }
    place.textContent = Object.entries(titles).map(([reason, names]) => `No plot of ${names.join(", ")}: ${reason}`).join(" ");
    place.hidden = !place.textContent;
  }

  function drawAll() {
    if (!content) return;
    for (const place of document.querySelectorAll("[data-caption]")) {
      place.textContent = content.captions[place.dataset.caption] || "";
    }
    document.querySelectorAll("[data-figure]").forEach(draw);
    sayWhatIsMissing();
    const pattern = document.querySelector("[data-data]")?.dataset.data;
    for (const link of document.querySelectorAll("[data-csv]")) {
      const key = link.dataset.csv;
      link.hidden = !content.figures[key === "path" ? "path_xy" : key];
      link.href = pattern.replace("FIGURE", key);
    }
    for (const button of document.querySelectorAll("[data-view]")) {
      button.setAttribute("aria-pressed", button.dataset.view === view);
      button.disabled = !content.figures.path_xy;
    }
  }

  async function load() {
    const source = document.querySelector("[data-figures]");
    if (!source) return;
    try {
      const answer = await fetch(source.dataset.figures, { headers: { Accept: "application/json" } });
      const body = await answer.json();
      if (!answer.ok) throw new Error(body.error.message);
      content = body;
    } catch (error) {
      for (const panel of document.querySelectorAll("[data-shown-with-data]")) panel.hidden = false;
      document.querySelectorAll("[data-figure]").forEach((place) => say(place, `The plot could not be drawn: ${error.message}`));
      return;
    }
    view ??= new URLSearchParams(location.hash.slice(1)).get("view") || content.best_plane;
    if (!(view in VIEWS)) view = content.best_plane;
    drawAll();
    if (content.timeline) document.dispatchEvent(new CustomEvent("timeline", { detail: content.timeline }));
  }

  document.addEventListener("DOMContentLoaded", () => {
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => {
        if (!content) return;
        view = button.dataset.view;
        history.replaceState(null, "", `#view=${view}`);
        const place = document.querySelector('[data-figure="path"]');
        Plotly.purge(place);
        drawAll();
      });
    }
    load();
    setInterval(() => { if (document.querySelector("[data-active]")) load(); }, WHILE_ACTIVE_MS);
  });
  document.addEventListener("moment", ({ detail }) => { if (content) mark(detail); });
  document.addEventListener("themechange", drawAll);
  document.addEventListener("pageswap", load);
})();
