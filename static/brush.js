// Below parallel coordinates, a table of the runs that lie within all ranges that are selected on the axes.
"use strict";
(() => {
  const MOST_ROWS = 200;
  const MOST_LISTED = 500;
  const { run: runAddress, list: listAddress } = document.getElementById("figures").dataset;

  /** The ranges of an axis: none, one as [low, high], or several. */
  function ranges({ constraintrange: chosen }) {
    if (!chosen?.length) return [];
    return Array.isArray(chosen[0]) ? chosen : [chosen];
  }

  /** The places of the lines that lie within a range of every axis that has one. */
  function within(axes, count) {
    const limited = axes.filter((axis) => axis.ranges.length);
    const fits = (place) => limited.every(({ values, ranges: own }) => own.some(([low, high]) => values[place] >= low && values[place] <= high));
    return Array.from({ length: count }, (_, place) => place).filter(fits);
  }

  /** The word or the number of a line on an axis. Plotly's text is escaped; a parser of HTML reads it, runs nothing. */
  function textOf({ values, words }, place) {
    if (words) return words[values[place]];
    return Number(values[place].toPrecision(4)).toString();
  }

  const plain = (text) => new DOMParser().parseFromString(text, "text/html").body.textContent;

  function axesOf(trace) {
    return trace.dimensions.map((entry) => ({
      label: plain(entry.label), values: slamhivePlots.list(entry.values), words: entry.ticktext?.map(plain), ranges: ranges(entry),
    }));
  }

  function element(name, text = "", attributes = {}) {
    const made = document.createElement(name);
    made.textContent = text;
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  }

  function tableOf(axes, runs, shown) {
    const table = element("table");
    const head = table.createTHead().insertRow();
    const kind = (axis) => (axis.words ? {} : { class: "number" });
    head.append(element("th", "Run", { scope: "col", class: "number" }), ...axes.map((axis) => element("th", axis.label, { scope: "col", ...kind(axis) })));
    const body = table.createTBody();
    for (const place of shown.slice(0, MOST_ROWS)) {
      const row = body.insertRow();
      const link = element("a", runs[place], { href: runAddress.replace("RUN", runs[place]) });
      row.append(element("td", "", { class: "number" }), ...axes.map((axis) => element("td", textOf(axis, place), kind(axis))));
      row.cells[0].append(link);
    }
    return table;
  }

  function fill(part, chart) {
    const [trace] = chart.data;
    const runs = slamhivePlots.list(trace.customdata);
    const axes = axesOf(trace);
    const shown = within(axes, runs.length);
    const more = shown.length > MOST_ROWS ? `, the first ${MOST_ROWS} in the table` : "";
    part.querySelector("[role=status]").textContent = `${shown.length} of ${runs.length} runs within the selected ranges${more}.`;
    const link = part.querySelector("[data-all-runs]");
    link.hidden = !shown.length || shown.length > MOST_LISTED;
    link.href = `${listAddress}?${new URLSearchParams({ where: `id in (${shown.slice(0, MOST_LISTED).map((place) => runs[place]).join(", ")})` })}`;
    part.querySelector("table").replaceWith(tableOf(axes, runs, shown));
  }

  document.addEventListener("chartdrawn", ({ target: chart }) => {
    if (chart.data?.[0]?.type !== "parcoords" || !chart.data[0].customdata) return;
    const part = element("div", "", { class: "brushed" });
    const said = element("p", "", { class: "quiet" });
    said.append("Drag along an axis to select a range, click it to select all. ", element("span", "", { role: "status" }), " ", element("a", "Show them in the list of runs", { "data-all-runs": "" }));
    const frame = element("div", "", { class: "table-wrap", tabindex: "0", role: "region", "aria-label": "Table: Runs within the selected ranges" });
    frame.append(element("table"));
    part.append(said, frame);
    chart.closest("figure").after(part);
    fill(part, chart);
    chart.on("plotly_restyle", () => fill(part, chart));
  });
})();
