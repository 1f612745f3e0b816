// Draws the plots of a page from the JSON at data-figures, and keeps them at one moment: a click in any of them chooses
// it, it stands in the address as ?t=, and each plot over the time of the recording shows it.
"use strict";
(() => {
  const WHILE_ACTIVE_MS = 5000;
  const PLANES = ["xy", "xz", "yz"];
  const { clear: clearCurves, draw: drawCurves } = slamhiveCurves;
  const { clear: clearPlane, draw: drawPlane, draws: isPlane } = slamhivePlanes;
  let content = null;
  let plane = null;
  let chosen = null;

  const places = () => document.querySelectorAll("[data-figure]");
  const nameOf = (key) => (key === "path" ? `path_${plane}` : key);
  const timeline = () => content?.timeline ?? null;
  const announce = (timestamp) => document.dispatchEvent(new CustomEvent("moment", { detail: timestamp }));

  function say(place, text) {
    clearCurves(place);
    clearPlane(place);
    if (place.nextElementSibling?.matches("details.plot-table")) place.nextElementSibling.remove();
    place.replaceChildren(slamhivePlots.element("p", text, { class: "quiet" }));
  }

  /** Whether the axis of a plot is the time of the recording, so that its clicks are moments. */
  const isTimed = (key) => Boolean(timeline() && (key in timeline().origins || key.startsWith("path")));

  function draw(place) {
    const key = place.dataset.figure;
    const figure = content.figures[nameOf(key)];
    const panel = place.closest("[data-shown-with-data]");
    if (panel) panel.hidden = !figure;
    if (!figure) {
      say(place, content.reasons[key === "path" ? "estimate" : key] || "No data for this plot.");
      place.classList.add("without");
      return;
    }
    place.classList.remove("without");
    const pick = isTimed(key) ? (x) => announce(timeline().origin_s + x) : undefined;
    if (isPlane(figure)) drawPlane(place, figure, { pick });
    else drawCurves(place, figure, { pick });
    place.setAttribute("role", "group");
    place.setAttribute("aria-label", document.querySelector(`[data-caption="${key}"]`)?.textContent || key);
  }

  /** A line, or a place on the path, at the chosen moment. */
  function mark() {
    if (!timeline() || chosen === null) return;
    const x = chosen - timeline().origin_s;
    for (const place of places()) {
      if (!isTimed(place.dataset.figure)) continue;
      slamhiveCurves.mark(place, x);
      slamhivePlanes.mark(place, x);
    }
  }

  /** Panels of a failed run without data are hidden; one sentence for each reason says which they are. */
  function sayWhatIsMissing() {
    const place = document.querySelector("[data-no-plots]");
    if (!place) return;
    const titles = {};
    for (const panel of document.querySelectorAll("[data-shown-with-data][hidden]:not([data-shown-with-data=''])")) {
      const key = panel.querySelector("[data-figure]").dataset.figure;
      const reason = content.reasons[key === "path" ? "estimate" : key] || "This run has no data for it.";
      (titles[reason] ??= []).push(panel.dataset.shownWithData);
    }
    place.textContent = Object.entries(titles).map(([reason, names]) => `No plot of ${names.join(", ")}: ${reason}`).join(" ");
    place.hidden = !place.textContent;
  }

  function drawAll() {
    if (!content) return;
    for (const place of document.querySelectorAll("[data-caption]")) {
      place.textContent = content.captions[place.dataset.caption] || "";
    }
    places().forEach(draw);
    sayWhatIsMissing();
    const pattern = document.querySelector("[data-data]")?.dataset.data;
    for (const link of document.querySelectorAll("[data-csv]")) {
      const key = link.dataset.csv;
      link.hidden = !content.figures[nameOf(key)];
      link.href = pattern.replace("FIGURE", key);
    }
    for (const button of document.querySelectorAll("[data-view]")) {
      button.setAttribute("aria-pressed", button.dataset.view === plane);
      button.disabled = !content.figures.path_xy;
    }
    for (const button of document.querySelectorAll("button[data-worst]")) button.hidden = (timeline()?.worst_s ?? null) === null;
    mark();
  }

  /** The address with one more argument, which a reload or a colleague opens at the same place. */
  function keepInAddress(name, value) {
    const address = new URL(location.href);
    address.searchParams.set(name, value);
    history.replaceState(history.state, "", address);
  }

  function firstMoment() {
    const { origin_s: origin, from_s: from, worst_s: worst } = timeline();
    const asked = Number.parseFloat(new URLSearchParams(location.search).get("t"));
    if (Number.isFinite(asked)) return announce(origin + asked);
    window.slamhiveMoment = chosen = worst ?? from;
    return document.dispatchEvent(new CustomEvent("moment", { detail: chosen }));
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
      places().forEach((place) => say(place, `The plot could not be drawn: ${error.message}`));
      return;
    }
    plane ??= new URLSearchParams(location.search).get("plane");
    if (!PLANES.includes(plane)) plane = content.best_plane;
    drawAll();
    if (!timeline()) return;
    document.dispatchEvent(new CustomEvent("timeline", { detail: timeline() }));
    if (chosen === null) firstMoment();
  }

  document.addEventListener("DOMContentLoaded", () => {
    for (const button of document.querySelectorAll("[data-view]")) {
      button.addEventListener("click", () => {
        if (!content) return;
        plane = button.dataset.view;
        keepInAddress("plane", plane);
        drawAll();
      });
    }
    document.addEventListener("click", (event) => {
      const asked = event.target.closest("[data-worst]");
      if (!asked || (timeline()?.worst_s ?? null) === null || event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      announce(timeline().worst_s);
    });
    load();
    setInterval(() => { if (document.querySelector("[data-active]")) load(); }, WHILE_ACTIVE_MS);
  });
  document.addEventListener("moment", ({ detail }) => {
    if (!timeline()) return;
    if (chosen !== detail) keepInAddress("t", String(Number((detail - timeline().origin_s).toFixed(3))));
    window.slamhiveMoment = chosen = detail;
    mark();
  });
  document.addEventListener("hideruns", ({ detail }) => {
    for (const place of places()) {
      slamhiveCurves.hide(place, detail);
      slamhivePlanes.hide(place, detail);
    }
  });
  document.addEventListener("pageswap", load);
})();
