// Shows the frames and sweeps of a dataset at the time of the slider, without loading the page again.
"use strict";
(() => {
  const WAIT_MS = 120;
  const MARGIN = { l: 0, r: 0, t: 8, b: 0 };
  const part = document.querySelector("[data-recording]");
  if (!part) return;
  const slider = part.querySelector("input[name=time]");
  const text = part.querySelector("output");
  const at = (address) => `${address}?time=${encodeURIComponent(slider.value)}`;
  const drawn = new Map();
  let timer = null;

  part.querySelector("button").hidden = true;

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
    place.nextElementSibling.textContent = caption;
    place.setAttribute("role", "img");
    place.setAttribute("aria-label", caption);
  }

  async function loadSweep(place) {
    const address = at(place.dataset.sweep);
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
  function watch(image) {
    const mark = () => image.classList.toggle("absent", image.complete && image.naturalWidth === 0);
    image.addEventListener("error", mark);
    image.addEventListener("load", mark);
    mark();
  }

  function load() {
    for (const image of part.querySelectorAll("[data-frame]")) image.src = at(image.dataset.frame);
    part.querySelectorAll("[data-sweep]").forEach(loadSweep);
  }

  function show() {
    text.textContent = `${Number(slider.value).toFixed(2)} s`;
    clearTimeout(timer);
    timer = setTimeout(load, WAIT_MS);
  }

  part.querySelectorAll("img").forEach(watch);
  slider.addEventListener("input", show);
  part.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-time]");
    if (!link) return;
    event.preventDefault();
    slider.value = link.dataset.time;
    show();
  });
  document.addEventListener("themechange", () => [...drawn.keys()].forEach(draw));
  part.querySelectorAll("[data-sweep]").forEach(loadSweep);
})();
