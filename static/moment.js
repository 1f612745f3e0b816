// Shows what the sensors of a run saw at a moment: of a click on a plot over time, or of the slider.
"use strict";
(() => {
  const WAIT_MS = 150;
  const { loadSweep, watchImage } = slamhiveRecording;
  const panel = document.querySelector("[data-moment]");
  if (!panel) return;
  const slider = panel.querySelector("input");
  const text = panel.querySelector("output");
  const words = panel.querySelector("[data-words]");
  const frames = panel.querySelector(".frames");
  const places = new Map();
  let from = 0;
  let wanted = null;
  let timer = null;

  const announce = (timestamp) => document.dispatchEvent(new CustomEvent("moment", { detail: timestamp }));
  const say = (timestamp) => { text.textContent = `${(timestamp - from).toFixed(2)} s`; };

  /** The figure of a sensor, made once, so that its last image stays until the next one has come. */
  function figureOf(sensor, isSweep) {
    if (places.has(sensor)) return places.get(sensor);
    const figure = document.createElement("figure");
    const view = document.createElement(isSweep ? "div" : "img");
    if (isSweep) {
      figure.className = "whole";
      view.className = "plot tall";
    } else {
      view.alt = `What ${sensor} saw`;
      watchImage(view);
    }
    figure.append(view, document.createElement("figcaption"));
    frames.append(figure);
    places.set(sensor, figure);
    return figure;
  }

  function show({ sensor, frame, sweep, problem }) {
    const figure = figureOf(sensor, Boolean(sweep));
    const caption = figure.querySelector("figcaption");
    caption.textContent = problem ? `${sensor}: ${problem}` : sensor;
    if (frame) figure.querySelector("img").src = frame;
    if (sweep) loadSweep(figure.firstElementChild, sweep);
  }

  async function load(timestamp) {
    wanted = timestamp;
    waiting = null;
    try {
      const address = new URL(panel.dataset.moment, location.href);
      address.searchParams.set("timestamp", timestamp);
      const answer = await fetch(address, { headers: { Accept: "application/json" } });
      const content = await answer.json();
      if (wanted !== timestamp) return;
      if (!answer.ok) throw new Error(content.error.message);
      words.textContent = content.words;
      content.views.forEach(show);
    } catch (error) {
      if (wanted === timestamp) words.textContent = `This moment cannot be shown: ${error.message}`;
    }
  }

  document.addEventListener("timeline", ({ detail }) => {
    from = detail.origin_s;
    slider.min = detail.from_s - from;
    slider.max = detail.until_s - from;
    panel.hidden = false;
  });
  // What the sensors saw is loaded when somebody can see it.
  let isSeen = false;
  let waiting = null;
  new IntersectionObserver((entries) => {
    isSeen = entries.some(({ isIntersecting }) => isIntersecting);
    if (isSeen && waiting !== null) load(waiting);
  }).observe(panel);

  document.addEventListener("moment", ({ detail }) => {
    slider.value = detail - from;
    say(detail);
    waiting = detail;
    if (isSeen) load(detail);
  });
  slider.addEventListener("input", () => {
    const timestamp = from + Number(slider.value);
    say(timestamp);
    clearTimeout(timer);
    timer = setTimeout(() => announce(timestamp), WAIT_MS);
  });
})();
