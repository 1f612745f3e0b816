// The run table of a static site: search, sort and paging happen here. Cells are always text, never markup.
"use strict";
(() => {
  const PAGE = 100;
  const { columns, rows } = window.slamhiveRuns;
  const texts = rows.map((row) => row.map((value) => value === null ? "" : String(value)).join("\n").toLowerCase());
  const numeric = columns.map((_, place) => rows.some((row) => typeof row[place] === "number"));
  const table = document.getElementById("runs");
  const search = document.getElementById("search");
  let sorted = { column: 0, descending: false };
  let shown = [];
  let first = 0;

  function compare(a, b) {
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
      place.textContent = Number(value.toPrecision(5)).toString();
      place.title = value;
    } else place.textContent = value;
    if (numeric[index]) place.className = "number";
    return place;
  }

  function show() {
    table.tBodies[0].replaceChildren(...shown.slice(first, first + PAGE).map((index) => {
      const line = document.createElement("tr");
      line.append(...rows[index].map(cell));
      return line;
    }));
    const last = Math.min(first + PAGE, shown.length);
    document.getElementById("found").textContent = shown.length ? `${first + 1} to ${last} of ${shown.length}` : "no run matches";
    document.getElementById("back").disabled = first === 0;
    document.getElementById("on").disabled = last >= shown.length;
    [...table.tHead.rows[0].cells].forEach((head, place) => {
      if (place === sorted.column) head.setAttribute("aria-sort", sorted.descending ? "descending" : "ascending");
      else head.removeAttribute("aria-sort");
    });
  }

  function find() {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    shown = rows.map((_, index) => index).filter((index) => words.every((word) => texts[index].includes(word))).sort(compare);
    first = 0;
    show();
  }

  const heads = table.tHead.insertRow();
  columns.forEach((column, place) => {
    const head = document.createElement("th");
    const button = document.createElement("button");
    head.scope = "col";
    button.type = "button";
    button.textContent = column.unit ? `${column.label} [${column.unit}]` : column.label;
    button.addEventListener("click", () => {
      sorted = { column: place, descending: sorted.column === place && !sorted.descending };
      find();
    });
    head.append(button);
    heads.append(head);
  });
  search.addEventListener("input", find);
  document.getElementById("back").addEventListener("click", () => { first -= PAGE; show(); });
  document.getElementById("on").addEventListener("click", () => { first += PAGE; show(); });
  find();
})();
