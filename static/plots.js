// What all plots share: light or dark colours, the numbers of a figure, Plotly on demand, and the table below a plot.
"use strict";
(() => {
  const MOST_ROWS = 200;
  const preferred = window.matchMedia("(prefers-color-scheme: dark)");
  let onPaper = false;
  const dark = () => !onPaper && (document.documentElement.dataset.bsTheme || (preferred.matches ? "dark" : "light")) === "dark";
  const paper = () => getComputedStyle(document.body).backgroundColor;
  const inks = () => dark()
    ? { text: "#d7dbe0", grid: "#3a4047", truth: "#c3c9d0", modebar: "#7b838c", page: onPaper ? "#ffffff" : paper() }
    : { text: "#2b3035", grid: "#e3e6ea", truth: "#3d4247", modebar: "#9aa1a8", page: onPaper ? "#ffffff" : paper() };

  const ARRAYS = { f4: Float32Array, i4: Int32Array };
  const unpacked = new WeakMap();

  /** The typed array that a figure holds in base64; it is unpacked once. */
  function numbers(packed) {
    if (!unpacked.has(packed)) {
      unpacked.set(packed, new ARRAYS[packed.dtype](Uint8Array.from(atob(packed.bdata), (letter) => letter.charCodeAt(0)).buffer));
    }
    return unpacked.get(packed);
  }

  const list = (values) => values?.bdata ? [...numbers(values)] : Array.isArray(values) ? values.flat() : [];
  const plain = (text) => String(text ?? "").replace(/<br>/g, " ").replace(/<[^>]*>/g, "");
  const short = (value) => typeof value === "number" ? (Number.isFinite(value) ? String(Number(value.toPrecision(5))) : "–") : plain(value ?? "–");

  /** The series of a plot: [{name, axes: [[title, values]]}]; a matrix names the row and the column of each value. */
  function seriesOf({ data, layout }) {
    const scene = layout.scene || {};
    const title = (axis) => plain((scene[axis] || layout[axis])?.title?.text || axis[0]);
    return data.map((trace) => {
      const name = plain(trace.name);
      if (trace.dimensions) return { name, axes: trace.dimensions.map(({ label, values }) => [plain(label), list(values)]) };
      let [x, y, z] = [trace.x, trace.y, trace.z].map(list);
      if (z.length && x.length * y.length === z.length && !trace.type.startsWith("scatter")) {
        [x, y] = [z.map((_, place) => x[place % x.length]), z.map((_, place) => y[Math.floor(place / x.length)])];
      }
      const axes = [[title("xaxis"), x], [title("yaxis"), y], [scene.zaxis ? title("zaxis") : "value", z]];
      return { name, axes: axes.filter(([, values]) => values.length) };
    }).filter(({ axes }) => axes.length);
  }

  /** {head, rows} of a plot: every value of a small one, otherwise how many values each series has and their range. */
  function tableOf(figure) {
    const series = seriesOf(figure);
    const titles = [...new Set(series.flatMap(({ axes }) => axes.map(([title]) => title)))];
    const valuesOf = ({ axes }, title) => axes.find(([other]) => other === title)?.[1] || [];
    const count = ({ axes }) => Math.max(...axes.map(([, values]) => values.length));
    if (series.reduce((sum, entry) => sum + count(entry), 0) <= MOST_ROWS) {
      const rows = series.flatMap((entry) => Array.from({ length: count(entry) }, (_, place) =>
        [entry.name, ...titles.map((title) => short(valuesOf(entry, title)[place]))]));
      return { head: ["Series", ...titles], rows };
    }
    const range = (values) => {
      const known = values.filter(Number.isFinite);
      return known.length ? [known.reduce((a, b) => Math.min(a, b)), known.reduce((a, b) => Math.max(a, b))].map(short) : ["–", "–"];
    };
    const known = (entry) => entry.axes[0][1].filter((value) => value !== null && !Number.isNaN(value)).length;
    return {
      head: ["Series", "Points", ...titles.flatMap((title) => [`lowest ${title}`, `highest ${title}`])],
      rows: series.map((entry) => [entry.name, String(known(entry)), ...titles.flatMap((title) => range(valuesOf(entry, title)))]),
    };
  }

  function element(tag, text = "", attributes = {}) {
    const made = document.createElement(tag);
    made.textContent = text;
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    return made;
  }

  function fill(details, figure) {
    const { head, rows } = tableOf(figure);
    const table = element("table");
    table.createTHead().insertRow().append(...head.map((text) => element("th", text, { scope: "col" })));
    const body = table.createTBody();
    for (const [name, ...cells] of rows) {
      body.insertRow().append(element("th", name, { scope: "row" }), ...cells.map((text) => element("td", text, { class: "number" })));
    }
    const frame = element("div", "", { class: "table-wrap table-frame", tabindex: "0", role: "region", "aria-label": `Table: ${figure.label}` });
    frame.append(table);
    details.replaceChildren(details.firstElementChild, frame);
  }

  /** Below a plot, the table that says the same; it is made when somebody opens it. */
  function withTable(place, figure) {
    let details = place.nextElementSibling;
    if (!details?.matches("details.plot-table")) {
      details = element("details", "", { class: "plot-table" });
      details.append(element("summary", "Data as a table"));
      details.addEventListener("toggle", () => { if (details.open) fill(details, details.figure); });
      place.after(details);
    }
    details.figure = { ...figure, label: place.ariaLabel || place.dataset.figure };
    if (details.open) fill(details, details.figure);
  }

  /** Opens or closes the table below a plot. */
  function toggleTable(place) {
    const details = place.nextElementSibling;
    details.open = !details.open;
    if (details.open) details.querySelector("summary").focus();
  }

  const MOST_ZEROS = 0.05;
  const checked = new WeakMap();

  /** Whether the heights of a plot can be shown on a logarithmic axis: numbers above zero, but for a few. */
  function canBeLog({ data, layout }) {
    const { scaleanchor, type } = layout.yaxis || {};
    if (layout.scene || layout.yaxis2 || scaleanchor || type === "category" || type === "date") return false;
    if (!data.length || data.some((trace) => !["scatter", "scattergl", undefined].includes(trace.type))) return false;
    const values = data.flatMap(({ y }) => list(y)).filter((value) => value !== null && !Number.isNaN(value));
    if (!values.length || !values.every((value) => typeof value === "number" && value >= 0)) return false;
    return values.filter((value) => value === 0).length <= MOST_ZEROS * values.length;
  }

  /** As canBeLog, which reads all values of a figure once. */
  function offersLog(figure) {
    if (!checked.has(figure)) checked.set(figure, canBeLog(figure));
    return checked.get(figure);
  }

  let loading = null;

  /** Plotly, which is loaded when the first plot needs it: it is as heavy as all the rest of a page together. */
  function plotly() {
    if (window.Plotly) return Promise.resolve(window.Plotly);
    loading ??= new Promise((resolve, reject) => {
      const script = document.createElement("script");
      script.src = document.querySelector("[data-plotly]").dataset.plotly;
      script.onload = () => resolve(window.Plotly);
      script.onerror = () => { loading = null; reject(new Error("the plotting library could not be loaded")); };
      document.head.append(script);
    });
    return loading;
  }

  /** Runs a function with true before the page is printed, while plots have light colours, and with false afterwards. */
  function whenPrinting(act) {
    window.addEventListener("beforeprint", () => { onPaper = true; act(true); });
    window.addEventListener("afterprint", () => { onPaper = false; act(false); });
  }

  /** A picture to keep; its name is made of the title of the page and what it shows. */
  function savePicture(canvas, what) {
    const link = document.createElement("a");
    link.download = `${document.title.split(" – ")[0]} ${what}`.replace(/\W+/g, "-").toLowerCase() + ".png";
    link.href = canvas.toDataURL("image/png");
    link.click();
  }

  window.slamhivePlots = { dark, inks, numbers, list, plain, short, element, withTable, offersLog, plotly, preferred, savePicture, toggleTable, whenPrinting };
})();
