// The list of runs of a static site: search, order, pages and selection happen here. Cells are always text, never markup.
"use strict";
(() => {
  const PAGE = 100;
  const { columns, rows, uses, used } = window.slamhiveRuns;
  const texts = rows.map((row) => row.map((value) => value === null ? "" : String(value)).join("\n").toLowerCase());
  const numeric = columns.map((_, place) => rows.some((row) => typeof row[place] === "number"));
  const table = document.getElementById("runs");
  const search = document.getElementById("search");
  const compare = document.getElementById("compare");
  const MOST = Number(table.dataset.most);
  const CONDITION = /^([a-z0-9_.]+)(<=|>=|!=|=|<|>)(.+)$/i;
  const HOLDS = { "<": (a, b) => a < b, ">": (a, b) => a > b, "<=": (a, b) => a <= b, ">=": (a, b) => a >= b, "=": (a, b) => a === b, "!=": (a, b) => a !== b };
  const selected = new Set();
  let sorted = { column: 0, descending: false };
  let shown = [];
  let first = 0;

  function compareRows(a, b) {
    const [left, right] = [rows[a][sorted.column], rows[b][sorted.column]];
    if (left === null || right === null) return (left === null) - (right === null);
    const order = typeof left === "number" && typeof right === "number" ? left - right : String(left).localeCompare(String(right));
    return (sorted.descending ? -order : order) || a - b;
  }

  function cell(value, index) {
    const place = document.createElement("td");
    if (value === null) place.textContent = "–";
    else if (columns[index].key === "id") {
      const link = document.createElement("a");
      link.href = `runs/${Number(value)}.html`;
      link.textContent = value;
      place.append(link);
    } else if (typeof value === "number") {
      place.textContent = Number.isInteger(value) ? String(value) : Math.abs(value) < 1000 ? value.toPrecision(3) : Math.round(value).toLocaleString("en");
      place.title = value;
    } else {
      place.textContent = value;
      place.className = "clip";
      place.title = value;
    }
    if (numeric[index]) place.className = "number";
    return place;
  }

  function box(id) {
    const place = document.createElement("td");
    const input = document.createElement("input");
    input.type = "checkbox";
    input.checked = selected.has(id);
    input.setAttribute("aria-label", `Run ${id}`);
    input.addEventListener("change", () => {
      if (input.checked) selected.add(id);
      else selected.delete(id);
      count();
    });
    place.append(input);
    return place;
  }

  /** What is selected, and why it cannot be compared. */
  function count() {
    const missing = 2 - selected.size;
    const why = missing > 0 ? `Select ${missing === 1 ? "another run" : "2 runs"} to compare.` : selected.size > MOST ? `At most ${MOST} runs can be compared.` : "";
    compare.disabled = Boolean(why);
    document.getElementById("why-not").textContent = why || `${selected.size} runs are selected.`;
  }

  /** A test of one word of the search: a condition on a column that is there, or else a text in any column. */
  function wanted(word) {
    const [, key, operator, text] = word.match(CONDITION) || [];
    const place = columns.findIndex((column) => [column.key, column.label.toLowerCase()].includes(key?.toLowerCase()));
    if (place < 0) return (index) => texts[index].includes(word.toLowerCase());
    const number = numeric[place] && Number.isFinite(Number(text)) ? Number(text) : null;
    return (index) => {
      const value = rows[index][place];
      if (number !== null) return value !== null && HOLDS[operator](value, number);
      return HOLDS[operator](String(value ?? "").toLowerCase(), text.toLowerCase());
    };
  }

  function show() {
    table.tBodies[0].replaceChildren(...shown.slice(first, first + PAGE).map((index) => {
      const line = document.createElement("tr");
      line.append(box(rows[index][0]), ...rows[index].map(cell));
      return line;
    }));
    const last = Math.min(first + PAGE, shown.length);
    document.getElementById("found").textContent = shown.length ? `${first + 1} to ${last} of ${shown.length}` : "no run matches";
    document.getElementById("back").disabled = first === 0;
    document.getElementById("on").disabled = last >= shown.length;
    [...table.tHead.rows[0].cells].forEach((head, place) => {
      if (place - 1 === sorted.column) head.setAttribute("aria-sort", sorted.descending ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
  }

  function find() {
    const tests = search.value.split(/\s+/).filter(Boolean).map(wanted);
    shown = rows.map((_, index) => index).filter((index) => tests.every((holds) => holds(index))).sort(compareRows);
    first = 0;
    slamhiveProtocols.show(shown.filter((index) => used[index] !== null).map((index) => uses[used[index]]));
    show();
  }

  /** The address holds what is shown, so that it can be sent to somebody. */
  function keep() {
    const state = new URLSearchParams();
    if (search.value) state.set("find", search.value);
    if (sorted.column || sorted.descending) state.set("sort", `${sorted.descending ? "-" : ""}${columns[sorted.column].key}`);
    window.history.replaceState(null, "", `#${state}`);
  }

  function restore() {
    const state = new URLSearchParams(window.location.hash.slice(1));
    const order = state.get("sort") || "";
    const column = columns.findIndex(({ key }) => key === order.replace(/^-/, ""));
    search.value = state.get("find") || "";
    sorted = { column: Math.max(0, column), descending: order.startsWith("-") };
    find();
  }

  const heads = table.tHead.insertRow();
  const select = document.createElement("th");
  select.scope = "col";
  select.textContent = "Select";
  heads.append(select);
  columns.forEach((column, place) => {
    const head = document.createElement("th");
    const button = document.createElement("button");
    head.scope = "col";
    if (numeric[place]) head.className = "number";
    button.type = "button";
    button.textContent = column.unit ? `${column.label} [${column.unit}]` : column.label;
    button.addEventListener("click", () => {
      sorted = { column: place, descending: sorted.column === place && !sorted.descending };
      find();
      keep();
    });
    head.append(button);
    heads.append(head);
  });
  search.addEventListener("input", () => {
    find();
    keep();
  });
  window.addEventListener("hashchange", restore);
  compare.addEventListener("click", () => { window.location.href = `compare.html?runs=${[...selected].join(",")}`; });
  document.getElementById("back").addEventListener("click", () => { first -= PAGE; show(); });
  document.getElementById("on").addEventListener("click", () => { first += PAGE; show(); });
  document.querySelector("[data-list]").hidden = false;
  count();
  restore();
})();
