// Draws the plots of a static site from the scripts of its runs. A path is stored once, in 3D, and its planes are made here.
// Plotly is loaded for a path in 3D only.
"use strict";
(() => {
  const MARGIN = { l: 64, r: 16, t: 36, b: 52 };
  const PLANES = { xy: ["x", "y"], xz: ["x", "z"], yz: ["y", "z"] };
  const FLAT_MARKERS = { circle: { symbol: "circle-open", size: 13, line: { width: 2 } }, square: { symbol: "square", size: 7 } };
  const THIN = 1.2;
  const THICK = 2.5;
  const THICK_IN_3D = 5;

  /** A path in 3D, seen along the axis that the plane leaves out. */
  function inPlane({ data, layout }, plane) {
    const [first, second] = PLANES[plane];
    const axis = (name) => ({ title: { text: `${name} [m]` }, constrain: "domain" });
    return {
      data: data.map(({ x, y, z, line, marker, ...trace }) => ({
        ...trace,
        type: "scatter",
        x: { x, y, z }[first],
        y: { x, y, z }[second],
        hovertemplate: `${first} %{x:.4g} m<br>${second} %{y:.4g} m`,
        ...(line ? { line: { ...line, width: line.width >= THICK_IN_3D ? THICK : THIN } } : {}),
        ...(marker ? { marker: { ...marker, ...FLAT_MARKERS[marker.symbol] } } : {}),
      })),
      layout: { meta: layout.meta, legend: layout.legend, xaxis: axis(first), yaxis: { ...axis(second), scaleanchor: "x" } },
    };
  }

  let content = null;
  let view = null;
  const views = document.querySelectorAll("[data-views] button");

  function draw(place) {
    const stored = content.figures[place.dataset.plot];
    if (!stored) {
      const line = document.createElement("p");
      line.className = "quiet";
      line.textContent = content.reasons[place.dataset.plot] || "No data for this plot.";
      place.replaceWith(line);
      if (place.dataset.plot === "path") document.querySelector("[data-views]").hidden = true;
      return undefined;
    }
    const figure = place.dataset.plot === "path" && view !== "3d" ? inPlane(stored, view) : stored;
    const flat = [slamhivePlanes, slamhiveCurves].find((kind) => kind.draws(figure));
    if (place.classList.contains("js-plotly-plot") && flat) {
      Plotly.purge(place);
      place.classList.remove("js-plotly-plot");
    }
    if (flat) return flat.draw(place, figure);
    slamhivePlanes.clear(place);
    place.replaceChildren();
    return slamhiveShow(place, figure, MARGIN, { toImageButtonOptions: { format: "svg" } });
  }

  function drawAll() {
    document.querySelectorAll("[data-plot]").forEach(draw);
    for (const button of views) button.setAttribute("aria-pressed", button.dataset.view === view);
  }

  for (const button of views) {
    button.addEventListener("click", () => {
      view = button.dataset.view;
      drawAll();
    });
  }
  slamhivePlots.preferred.addEventListener("change", () => { if (content) drawAll(); });

  /** Draws {figures, reasons, plane} into the places of the page. */
  window.slamhiveDraw = (shown) => {
    content = shown;
    view = shown.plane || "3d";
    drawAll();
  };
  window.slamhiveRun = window.slamhiveDraw;
})();
