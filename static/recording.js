// Draws LiDAR sweeps and minds missing images, for the pages of datasets and of runs.
"use strict";
(() => {
  const MARGIN = { l: 0, r: 0, t: 8, b: 0 };
  const drawn = new Map();

  function say(place, words) {
    Plotly.purge(place);
    const line = document.createElement("p");
    line.className = "quiet";
    line.textContent = words;
    place.replaceChildren(line);
  }

  function draw(place) {
    const { figure, caption } = drawn.get(place);
    if (!place.classList.contains("js-plotly-plot")) place.replaceChildren();
    slamhiveShow(place, figure, MARGIN, { showTips: false });
    place.closest("figure").querySelector("figcaption").textContent = caption;
    place.setAttribute("role", "img");
    place.setAttribute("aria-label", caption);
  }

  /** Load the sweep at an address into a place; an answer that is no longer wanted is dropped. */
  async function loadSweep(place, address) {
    place.dataset.wanted = address;
    try {
      const answer = await fetch(address, { headers: { Accept: "application/json" } });
      const content = await answer.json();
      if (place.dataset.wanted !== address) return;
      if (!answer.ok) throw new Error(content.error.message);
      drawn.set(place, content);
      draw(place);
    } catch (error) {
      if (place.dataset.wanted === address) say(place, `The sweep could not be shown: ${error.message}`);
    }
  }

  /** A camera may have no frame at a time; its place stays empty. */
  function watchImage(image) {
    const mark = () => image.classList.toggle("absent", image.complete && image.naturalWidth === 0);
    image.addEventListener("error", mark);
    image.addEventListener("load", mark);
    mark();
  }

  document.addEventListener("themechange", () => [...drawn.keys()].forEach(draw));
  window.slamhiveRecording = { loadSweep, watchImage };
})();
