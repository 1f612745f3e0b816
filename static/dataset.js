// Shows the frames and sweeps of a dataset at the time of the slider, without loading the page again. They are loaded when
// they come into view, or when the page is printed.
"use strict";
(() => {
  const WAIT_MS = 120;
  const NEAR = "200px";
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

  /** Says below a strip why its frames are missing; the first reason stands for all. */
  async function sayWhy(strip, address) {
    const place = strip?.nextElementSibling;
    if (!place || place.dataset.asked) return;
    place.dataset.asked = address;
    try {
      const answer = await fetch(address, { headers: { Accept: "application/json" } });
      if (answer.ok) return;
      place.textContent = `Frames could not be shown: ${(await answer.json()).error.message}`;
    } catch (error) {
      place.textContent = `Frames could not be shown: ${error.message}`;
    }
    place.hidden = false;
  }

  /** Loads the pictures of the recording, once. */
  function begin() {
    near.disconnect();
    for (const image of part.querySelectorAll("img[data-src]:not([src])")) {
      watchImage(image, (address) => sayWhy(image.closest(".thumbnails"), address));
      image.src = image.dataset.src;
    }
    loadSweeps();
  }

  const near = new IntersectionObserver((entries) => { if (entries.some((entry) => entry.isIntersecting)) begin(); }, { rootMargin: NEAR });
  near.observe(part);
  window.addEventListener("beforeprint", begin);
  slider.addEventListener("input", show);
  part.addEventListener("click", (event) => {
    const link = event.target.closest("a[data-time]");
    if (!link) return;
    event.preventDefault();
    slider.value = link.dataset.time;
    show();
  });
})();
