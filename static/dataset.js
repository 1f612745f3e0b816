// Shows the frames and sweeps of a dataset at the time of the slider, without loading the page again.
"use strict";
(() => {
  const WAIT_MS = 120;
  const { loadSweep, watchImage } = slamhiveRecording;
  const part = document.querySelector("[data-recording]");
  if (!part) return;
  const slider = part.querySelector("input[name=time]");
  const text = part.querySelector("output");
  const at = (address) => `${address}?time=${encodeURIComponent(slider.value)}`;
  const loadSweeps = () => part.querySelectorAll("[data-sweep]").forEach((place) => loadSweep(place, at(place.dataset.sweep)));
  let timer = null;

  part.querySelector("button").hidden = true;

  function load() {
    for (const image of part.querySelectorAll("[data-frame]")) image.src = at(image.dataset.frame);
    loadSweeps();
  }

  function show() {
    text.textContent = `${Number(slider.value).toFixed(2)} s`;
    clearTimeout(timer);
    timer = setTimeout(load, WAIT_MS);
  }

  part.querySelectorAll("img").forEach(watchImage);
  slider.addEventListener("input", show);
  part.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-time]");
    if (!link) return;
    event.preventDefault();
    slider.value = link.dataset.time;
    show();
  });
  loadSweeps();
})();
