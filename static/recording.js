// Draws LiDAR sweeps and minds missing images, for the pages of datasets and of runs. A sweep is seen from above at
// first; dragging, or the arrow keys, turn it.
"use strict";
(() => {
  const RAMP = ["#440154", "#3e4989", "#26828e", "#35b779", "#b5de2b"];
  const DARKEST = 0.15;
  const STEP_RAD = 0.1;
  const FROM_ABOVE = { turn: 0, tilt: Math.PI / 2, zoom: 1 };
  const { element, inks, numbers, whenPrinting } = slamhivePlots;
  const drawn = new Map();

  function say(place, words) {
    drawn.delete(place);
    place.replaceChildren(element("p", words, { class: "quiet" }));
  }

  function colourAt(share) {
    const at = (slamhivePlots.dark() ? DARKEST + (1 - DARKEST) * share : share * 0.9) * (RAMP.length - 1);
    const first = Math.min(RAMP.length - 2, Math.floor(at));
    const parts = (colour) => [1, 3, 5].map((place) => parseInt(colour.slice(place, place + 2), 16));
    const [low, high] = [parts(RAMP[first]), parts(RAMP[first + 1])];
    return `rgb(${low.map((part, place) => Math.round(part + (at - first) * (high[place] - part))).join(",")})`;
  }

  const LEVELS = 16;

  /** Half of the extent that nearly all points lie within, and the heights between which colours are spread. */
  function measure(points) {
    const [far, heights] = [[], []];
    for (let at = 0; at < points.length; at += 3) {
      if (!Number.isFinite(points[at])) continue;
      far.push(Math.hypot(points[at], points[at + 1]));
      heights.push(points[at + 2]);
    }
    const share = (values, part) => values.sort((one, other) => one - other)[Math.floor(part * (values.length - 1))] ?? 1;
    return { reach: share(far, 0.98) * 1.05 || 1, low: share(heights, 0.02), high: share(heights, 0.98) };
  }

  function paint(place) {
    const { canvas, points, extent, look } = drawn.get(place);
    if (!canvas.clientWidth) return;
    const ratio = devicePixelRatio;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const scale = (look.zoom * Math.min(width, height)) / (2 * extent.reach);
    const [sin, cos, up, along] = [Math.sin(look.turn), Math.cos(look.turn), Math.cos(look.tilt), Math.sin(look.tilt)];
    const colours = Array.from({ length: LEVELS }, (_, level) => colourAt(level / (LEVELS - 1)));
    // x points ahead, so ahead is up on the page.
    for (let at = 0; at < points.length; at += 3) {
      const [x, y, z] = [points[at], points[at + 1], points[at + 2]];
      const share = (z - extent.low) / (extent.high - extent.low || 1);
      context.fillStyle = colours[Math.max(0, Math.min(LEVELS - 1, Math.floor(share * LEVELS)))];
      const [right, ahead] = [x * sin - y * cos, x * cos + y * sin];
      context.fillRect(width / 2 + right * scale - 0.75, height / 2 - (ahead * along + z * up) * scale - 0.75, 1.6, 1.6);
    }
    context.strokeStyle = inks().text;
    context.lineWidth = 2;
    context.beginPath();
    context.arc(width / 2, height / 2, 4, 0, 2 * Math.PI);
    context.stroke();
  }

  function listen(place, canvas) {
    const look = () => drawn.get(place).look;
    let last = null;
    const turn = (across, down) => {
      look().turn += across;
      look().tilt = Math.min(Math.PI / 2, Math.max(0, look().tilt + down));
      paint(place);
    };
    canvas.addEventListener("pointerdown", (event) => {
      last = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      turn((last[0] - event.clientX) / 150, (event.clientY - last[1]) / 150);
      last = [event.clientX, event.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { last = null; });
    canvas.addEventListener("dblclick", () => { Object.assign(look(), FROM_ABOVE); paint(place); });
    canvas.addEventListener("keydown", (event) => {
      const acts = {
        ArrowLeft: () => turn(-STEP_RAD, 0), ArrowRight: () => turn(STEP_RAD, 0), ArrowUp: () => turn(0, -STEP_RAD), ArrowDown: () => turn(0, STEP_RAD),
        "+": () => { look().zoom *= 1.25; paint(place); }, "-": () => { look().zoom /= 1.25; paint(place); },
      };
      if (event.ctrlKey || event.metaKey || event.altKey || !Object.hasOwn(acts, event.key)) return;
      event.preventDefault();
      acts[event.key]();
    });
  }

  function draw(place, points, caption) {
    let entry = drawn.get(place);
    if (!entry) {
      const canvas = element("canvas", "", { class: "sweep", tabindex: "0", role: "img" });
      place.replaceChildren(canvas);
      entry = { canvas, look: { ...FROM_ABOVE } };
      drawn.set(place, entry);
      listen(place, canvas);
      new ResizeObserver(() => { if (drawn.get(place) === entry) paint(place); }).observe(canvas);
    }
    Object.assign(entry, { points, extent: measure(points) });
    entry.canvas.setAttribute("aria-label", `${caption} Arrow keys turn it, + and - zoom.`);
    place.closest("figure").querySelector("figcaption").textContent = `${caption} Coloured by height; drag to turn, double click for the view from above.`;
    paint(place);
  }

  /** Load the sweep at an address into a place; an answer that is no longer wanted is dropped. */
  async function loadSweep(place, address) {
    place.dataset.wanted = address;
    try {
      const answer = await fetch(address, { headers: { Accept: "application/json" } });
      const content = await answer.json();
      if (place.dataset.wanted !== address) return;
      if (!answer.ok) throw new Error(content.error.message);
      draw(place, numbers(content.points_m), content.caption);
    } catch (error) {
      if (place.dataset.wanted === address) say(place, `The sweep could not be shown: ${error.message}`);
    }
  }

  /** A camera may have no frame at a time; its place stays empty. `whenAbsent` gets the address that gave none. */
  function watchImage(image, whenAbsent = () => {}) {
    const mark = () => image.classList.toggle("absent", image.complete && image.naturalWidth === 0);
    image.addEventListener("error", () => { mark(); whenAbsent(image.src); });
    image.addEventListener("load", mark);
    mark();
  }

  const again = () => [...drawn.keys()].forEach(paint);
  document.addEventListener("themechange", again);
  whenPrinting(again);
  window.slamhiveRecording = { loadSweep, watchImage };
})();
