// Draws paths in a plane on a canvas, metres on both axes equally long, from the same figures that Plotly reads. A path
// that knows its errors is coloured by them; one that knows its times shows where the body is at the chosen moment.
"use strict";
(() => {
  const { element, inks, list, numbers, plain, savePicture, short, toggleTable, whenPrinting, withTable } = slamhivePlots;
  const PADDING = { left: 46, right: 12, top: 10, bottom: 34 };
  const NEAR_PX = 24;
  const CLICK_PX = 4;
  const LEVELS = 24;
  const TICK_PX = 70;
  const COLOURED = 0.95;
  const STEPS = [1, 2, 5, 10];
  const DASHES = { dash: [7, 5], dot: [2, 4] };
  const FONT = "11px system-ui, sans-serif";
  // matplotlib's plasma without the ends that are hard to see on a light or on a dark page, as in the 3D view.
  const RAMPS = {
    light: ["#0d0887", "#46039f", "#7201a8", "#9c179e", "#bd3786", "#d8576b", "#ed7953", "#fb9f3a"],
    dark: ["#6a00d0", "#8b1fb8", "#9c179e", "#bd3786", "#d8576b", "#ed7953", "#fb9f3a", "#fdca26"],
  };
  const drawn = new Map();

  const draws = ({ data, layout }) => Boolean(layout.yaxis?.scaleanchor) && data.every(({ type }) => type === "scatter");

  /** A colour of the ramp for a share, 0 to 1, in steps. */
  function colourAt(share) {
    const stops = RAMPS[slamhivePlots.dark() ? "dark" : "light"];
    const at = Math.min(1, Math.max(0, share)) * (stops.length - 1);
    const first = Math.min(stops.length - 2, Math.floor(at));
    const parts = (colour) => [1, 3, 5].map((place) => parseInt(colour.slice(place, place + 2), 16));
    const [low, high] = [parts(stops[first]), parts(stops[first + 1])];
    return `rgb(${low.map((part, place) => Math.round(part + (at - first) * (high[place] - part))).join(",")})`;
  }

  function lineOf(trace, figure) {
    const ink = inks();
    const own = trace.line?.color ?? trace.marker?.color;
    const colour = trace.meta === "theme:groundtruth" || !own ? ink.truth : (slamhivePlots.dark() && figure.layout.meta?.dark?.[own]) || own;
    return {
      name: plain(trace.name),
      run: trace.run,
      colour,
      x: list(trace.x),
      y: list(trace.y),
      times: trace.times_s ? numbers(trace.times_s) : null,
      errors: trace.errors_m ? numbers(trace.errors_m) : null,
      dash: DASHES[trace.line?.dash] ?? [],
      width: trace.line?.width ?? 1.5,
      symbol: (trace.mode ?? "").includes("lines") ? null : String(trace.marker?.symbol ?? "circle"),
    };
  }

  /** The box around everything, with the shape of the place, in metres: [left, bottom, right, top]. */
  function boxOf(entry) {
    const ends = [Infinity, Infinity, -Infinity, -Infinity];
    for (const { x, y } of entry.lines) {
      for (let place = 0; place < x.length; place += 1) {
        if (!Number.isFinite(x[place]) || !Number.isFinite(y[place])) continue;
        ends[0] = Math.min(ends[0], x[place]);
        ends[1] = Math.min(ends[1], y[place]);
        ends[2] = Math.max(ends[2], x[place]);
        ends[3] = Math.max(ends[3], y[place]);
      }
    }
    if (!Number.isFinite(ends[0])) return [0, 0, 1, 1];
    const room = Math.max(ends[2] - ends[0], ends[3] - ends[1], 0.1) * 0.05;
    return [ends[0] - room, ends[1] - room, ends[2] + room, ends[3] + room];
  }

  /** Pixels for a metre and the middle: what the view is made of. */
  function fit(entry) {
    const [left, bottom, right, top] = boxOf(entry);
    const { width, height } = areaOf(entry);
    entry.view = { x: (left + right) / 2, y: (bottom + top) / 2, scale: Math.min(width / (right - left), height / (top - bottom)) };
    entry.resetButton.hidden = true;
  }

  function areaOf({ canvas }) {
    return { width: Math.max(10, canvas.clientWidth - PADDING.left - PADDING.right), height: Math.max(10, canvas.clientHeight - PADDING.top - PADDING.bottom) };
  }

  function projection(entry) {
    const { width, height } = areaOf(entry);
    const { x, y, scale } = entry.view;
    const middle = [PADDING.left + width / 2, PADDING.top + height / 2];
    return {
      width,
      height,
      toX: (metres) => middle[0] + (metres - x) * scale,
      toY: (metres) => middle[1] - (metres - y) * scale,
      fromX: (pixels) => x + (pixels - middle[0]) / scale,
      fromY: (pixels) => y - (pixels - middle[1]) / scale,
    };
  }

  /** Round values between two ends, so far apart that their labels have room. */
  function ticks(low, high, pixels) {
    const wanted = (high - low) / Math.max(2, pixels / TICK_PX);
    const power = 10 ** Math.floor(Math.log10(wanted));
    const step = STEPS.find((factor) => factor * power >= wanted) * power;
    const first = Math.ceil(low / step);
    return Array.from({ length: Math.max(0, Math.floor(high / step) - first + 1) }, (_, place) => Number(((first + place) * step).toPrecision(10)));
  }

  function grid(entry, context, at, ink) {
    const { layout } = entry.figure;
    context.font = FONT;
    context.lineWidth = 1;
    context.strokeStyle = ink.grid;
    context.fillStyle = ink.text;
    context.textAlign = "center";
    context.textBaseline = "top";
    const [left, right, top, bottom] = [PADDING.left, PADDING.left + at.width, PADDING.top, PADDING.top + at.height];
    context.beginPath();
    for (const value of ticks(at.fromX(left), at.fromX(right), at.width)) {
      const x = Math.round(at.toX(value)) + 0.5;
      context.moveTo(x, top);
      context.lineTo(x, bottom);
      context.fillText(short(value), x, bottom + 4);
    }
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const value of ticks(at.fromY(bottom), at.fromY(top), at.height)) {
      const y = Math.round(at.toY(value)) + 0.5;
      context.moveTo(left, y);
      context.lineTo(right, y);
      context.fillText(short(value), left - 5, y);
    }
    context.stroke();
    context.textAlign = "center";
    context.textBaseline = "bottom";
    context.fillText(plain(layout.xaxis.title?.text), left + at.width / 2, bottom + PADDING.bottom - 2);
    context.save();
    context.translate(11, top + at.height / 2);
    context.rotate(-Math.PI / 2);
    context.fillText(plain(layout.yaxis.title?.text), 0, 0);
    context.restore();
  }

  function trace(context, at, { x, y }, from = 0, to = x.length) {
    context.beginPath();
    let pen = false;
    for (let place = from; place < to; place += 1) {
      if (Number.isFinite(x[place]) && Number.isFinite(y[place])) {
        if (pen) context.lineTo(at.toX(x[place]), at.toY(y[place]));
        else context.moveTo(at.toX(x[place]), at.toY(y[place]));
        pen = true;
      } else pen = false;
    }
    context.stroke();
  }

  /** The path in pieces of nearly the same error, each in its colour. */
  function traceByError(context, at, line, most) {
    const level = (error) => Math.min(LEVELS - 1, Math.floor((LEVELS * error) / most));
    const levels = Array.from(line.errors, level);
    for (let from = 0; from < levels.length - 1;) {
      let to = from + 1;
      while (to < levels.length && (levels[to] === levels[from] || Number.isNaN(levels[to]))) to += 1;
      context.strokeStyle = Number.isNaN(levels[from]) ? line.colour : colourAt(levels[from] / (LEVELS - 1));
      trace(context, at, line, from, Math.min(to + 1, levels.length));
      from = to;
    }
  }

  function symbol(context, at, { x, y, symbol: kind, colour }) {
    const [left, top] = [at.toX(x[0]), at.toY(y[0])];
    context.strokeStyle = context.fillStyle = colour;
    context.lineWidth = 2;
    context.beginPath();
    if (kind.startsWith("square")) context.fillRect(left - 3.5, top - 3.5, 7, 7);
    else {
      context.arc(left, top, 6, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  /** The pose nearest to a time, as a place in the line; null if the line has none. */
  function placeAt({ times, x }, time) {
    let best = null;
    for (let place = 0; times && place < times.length; place += 1) {
      if (Number.isFinite(x[place]) && (best === null || Math.abs(times[place] - time) < Math.abs(times[best] - time))) best = place;
    }
    return best;
  }

  function body(context, at, line, place, ink) {
    context.beginPath();
    context.arc(at.toX(line.x[place]), at.toY(line.y[place]), 6, 0, 2 * Math.PI);
    context.fillStyle = line.errors ? ink.text : line.colour;
    context.strokeStyle = ink.page;
    context.lineWidth = 2;
    context.fill();
    context.stroke();
  }

  const shownLines = (entry) => entry.lines.filter(({ run }) => run === undefined || !entry.hidden.has(run));

  function paint(entry) {
    const { canvas, place } = entry;
    if (!canvas.clientWidth || !place.isConnected) return;
    const ratio = devicePixelRatio;
    [canvas.width, canvas.height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio];
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    if (!entry.view) fit(entry);
    const [at, ink] = [projection(entry), inks()];
    grid(entry, context, at, ink);
    context.save();
    context.beginPath();
    context.rect(PADDING.left, PADDING.top, at.width, at.height);
    context.clip();
    context.lineJoin = "round";
    const lines = shownLines(entry);
    for (const line of lines.filter((other) => !other.symbol)) {
      context.strokeStyle = line.colour;
      context.lineWidth = line.width;
      context.setLineDash(line.dash);
      if (line.errors && entry.most > 0) {
        context.lineWidth = 3;
        traceByError(context, at, line, entry.most);
      } else trace(context, at, line);
    }
    context.setLineDash([]);
    for (const line of lines.filter((other) => other.symbol)) symbol(context, at, line);
    if (entry.moment !== null) {
      for (const line of lines) {
        const near = placeAt(line, entry.moment);
        if (near !== null) body(context, at, line, near, ink);
      }
    }
    context.restore();
  }

  /** The pose nearest to the pointer: [line, place], or null. */
  function pointed(entry, event) {
    const at = projection(entry);
    const { left, top } = entry.canvas.getBoundingClientRect();
    const [wantedX, wantedY] = [event.clientX - left, event.clientY - top];
    let [best, distance] = [null, NEAR_PX];
    for (const line of shownLines(entry)) {
      if (!line.times) continue;
      for (let place = 0; place < line.x.length; place += 1) {
        const away = Math.hypot(at.toX(line.x[place]) - wantedX, at.toY(line.y[place]) - wantedY);
        if (away < distance) [best, distance] = [[line, place], away];
      }
    }
    return best;
  }

  function tell(entry, found) {
    if (!found) return entry.readout.replaceChildren();
    const [{ name, x, y, times, errors }, place] = found;
    const metres = [x[place], y[place]].map((value) => short(Number(value.toPrecision(4)))).join(", ");
    const error = errors && Number.isFinite(errors[place]) ? `error ${short(Number(errors[place].toPrecision(3)))} m` : "";
    return entry.readout.replaceChildren(...[`${Number(times[place].toFixed(2))} s`, name, `${metres} m`, error].filter(Boolean).map((text) => element("span", text)));
  }

  function zoom(entry, factor, [x, y] = [entry.view.x, entry.view.y]) {
    const { view } = entry;
    Object.assign(view, { x: x + (view.x - x) / factor, y: y + (view.y - y) / factor, scale: view.scale * factor });
    entry.resetButton.hidden = false;
    paint(entry);
  }

  function listen(entry) {
    const { canvas } = entry;
    let drag = null;
    canvas.addEventListener("pointerdown", (event) => {
      drag = { x: event.clientX, y: event.clientY, view: { ...entry.view }, moved: false };
      if (event.pointerType === "mouse") canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (!drag || event.pointerType !== "mouse") return tell(entry, pointed(entry, event));
      const [x, y] = [event.clientX - drag.x, event.clientY - drag.y];
      if (!drag.moved && Math.hypot(x, y) <= CLICK_PX) return undefined;
      drag.moved = true;
      Object.assign(entry.view, { x: drag.view.x - x / drag.view.scale, y: drag.view.y + y / drag.view.scale });
      entry.resetButton.hidden = false;
      return paint(entry);
    });
    canvas.addEventListener("pointerup", (event) => {
      const found = drag && !drag.moved && pointed(entry, event);
      drag = null;
      if (found) entry.options.pick?.(found[0].times[found[1]]);
    });
    canvas.addEventListener("pointercancel", () => { drag = null; });
    canvas.addEventListener("pointerleave", () => tell(entry, null));
    canvas.addEventListener("dblclick", () => { fit(entry); paint(entry); });
    canvas.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      const at = projection(entry);
      const { left, top } = canvas.getBoundingClientRect();
      zoom(entry, event.deltaY < 0 ? 1.25 : 0.8, [at.fromX(event.clientX - left), at.fromY(event.clientY - top)]);
    }, { passive: false });
  }

  function tool(text, title, act) {
    const button = element("button", text, { type: "button", class: "plot-tool", title, "aria-label": title });
    button.addEventListener("click", act);
    return button;
  }

  /** The scale of the errors: a bar from 0 to the largest one that has a colour of its own. */
  function scaleBar(entry) {
    const bar = element("span", "", { class: "plot-ramp" });
    const ramp = element("i");
    const stops = Array.from({ length: 8 }, (_, place) => colourAt(place / 7));
    ramp.style.background = `linear-gradient(to right, ${stops.join(",")})`;
    bar.append("error 0", ramp, `${entry.beyond ? "≥ " : ""}${short(Number(entry.most.toPrecision(3)))} m`);
    return bar;
  }

  function frame(entry) {
    const head = element("div", "", { class: "plot-head" });
    entry.readout = element("output", "", { class: "plot-values" });
    entry.canvas = element("canvas", "", { class: "plot-body" });
    entry.resetButton = tool("All", "Show the whole path again (double click)", () => { fit(entry); paint(entry); });
    const tools = element("span", "", { class: "plot-tools", role: "group", "aria-label": "Tools of the plot" });
    tools.append(
      entry.resetButton,
      tool("+", "Zoom in (Ctrl and wheel)", () => zoom(entry, 1.4)),
      tool("−", "Zoom out (Ctrl and wheel)", () => zoom(entry, 1 / 1.4)),
      tool("Table", "Data as a table", () => toggleTable(entry.place)),
      tool("PNG", "Save this plot as a picture", () => save(entry)),
    );
    if (entry.most > 0) head.append(scaleBar(entry));
    head.append(entry.readout, tools);
    entry.place.replaceChildren(head, entry.canvas);
  }

  function save(entry) {
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [entry.canvas.width, entry.canvas.height];
    const context = canvas.getContext("2d");
    context.fillStyle = inks().page;
    context.fillRect(0, 0, canvas.width, canvas.height);
    context.drawImage(entry.canvas, 0, 0);
    savePicture(canvas, entry.place.dataset.figure ?? "path");
  }

  const sizes = new ResizeObserver((changes) => {
    for (const { target } of changes) {
      const entry = drawn.get(target.parentElement);
      if (!entry) continue;
      if (entry.resetButton.hidden) entry.view = null;
      paint(entry);
    }
  });

  function redraw(entry) {
    entry.lines = entry.figure.data.map((trace) => lineOf(trace, entry.figure));
    const errors = entry.lines.flatMap((line) => (line.errors ? [...line.errors].filter(Number.isFinite) : []));
    // A few poses that are far away would make all others look alike.
    entry.most = errors.sort((one, other) => one - other)[Math.floor(COLOURED * (errors.length - 1))] ?? 0;
    entry.beyond = errors.length > 0 && errors[errors.length - 1] > entry.most;
    const view = entry.resetButton && !entry.resetButton.hidden ? entry.view : null;
    frame(entry);
    entry.view = view;
    entry.resetButton.hidden = !view;
    listen(entry);
    paint(entry);
    sizes.observe(entry.canvas);
    entry.place.dataset.drawn = "plane";
  }

  /** Draws a figure into a place. ``pick`` is called with the time of a pose that is clicked. */
  function draw(place, figure, options = {}) {
    const known = drawn.get(place);
    const entry = known ?? { place, moment: null, hidden: new Set() };
    // Another plane has other axes: what was zoomed into says nothing there.
    if (known && known.figure.layout.xaxis.title?.text + known.figure.layout.yaxis.title?.text !== figure.layout.xaxis.title?.text + figure.layout.yaxis.title?.text) entry.resetButton = null;
    Object.assign(entry, { figure, options });
    drawn.set(place, entry);
    place.classList.add("curves");
    redraw(entry);
    withTable(place, figure);
  }

  function clear(place) {
    drawn.delete(place);
    place.classList.remove("curves");
    delete place.dataset.drawn;
  }

  /** Shows where the body is at a time; null for none. */
  function mark(place, time) {
    const entry = drawn.get(place);
    if (!entry) return;
    entry.moment = time;
    if (time === null) delete place.dataset.moment; else place.dataset.moment = time;
    paint(entry);
  }

  function hide(place, runs) {
    const entry = drawn.get(place);
    if (!entry) return;
    entry.hidden = runs;
    paint(entry);
  }

  const again = () => drawn.forEach((entry) => { if (entry.place.isConnected) redraw(entry); else drawn.delete(entry.place); });
  document.addEventListener("themechange", again);
  whenPrinting(again);
  window.slamhivePlanes = { clear, draw, draws, hide, mark };
})();
