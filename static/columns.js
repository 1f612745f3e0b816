// The list of runs as its user arranged it: columns and their order, pinned columns, colours, and widths. The address
// holds all but the widths; this browser keeps them for addresses that name none. Runs before the page is drawn.
"use strict";
(() => {
  const IN_ADDRESS = ["columns", "pinned", "colours", "sparks"];
  const LEAST_PX = 40;
  const MOST_PX = 1200;
  const MOST_PINNED_SHARE = 0.6;
  const KEY = `runs.layout.${document.currentScript.dataset.account}`;
  const TRIED = `${KEY}.tried`;

  function read(storage = localStorage, key = KEY) {
    try { return JSON.parse(storage.getItem(key)) ?? {}; } catch { return {}; }
  }

  /** Storage may be forbidden or full: the layout then holds for this address only. */
  function write(layout, storage = localStorage, key = KEY) {
    try { storage.setItem(key, JSON.stringify(layout)); } catch { /* nothing is kept */ }
  }

  /** Keep what an address says about the layout; what it does not name is as for everybody. */
  function keep(asked) {
    const layout = read();
    for (const name of IN_ADDRESS) {
      const text = asked.getAll(name).map((part) => part.trim()).filter(Boolean).join(",");
      if (text) layout[name] = text;
      else delete layout[name];
    }
    write(layout);
  }

  /** Go to the same list with the layout that is kept, unless the address names one. */
  async function apply() {
    const layout = read();
    const here = new URL(location.href);
    const missing = IN_ADDRESS.filter((name) => typeof layout[name] === "string" && !here.searchParams.has(name));
    const tried = read(sessionStorage, TRIED).tried;
    write({}, sessionStorage, TRIED);
    if (!missing.length) return;
    for (const name of missing) here.searchParams.set(name, layout[name]);
    // The last attempt did not arrive here: a column may no longer exist. Then everybody's columns are better than none.
    if (tried && !(await fetch(here, { method: "HEAD" }).catch(() => ({ ok: false }))).ok) {
      write({ widths: layout.widths });
      return;
    }
    write({ tried: true }, sessionStorage, TRIED);
    location.replace(here);
  }
  apply();

  const sheet = new CSSStyleSheet();
  const table = () => document.querySelector("#list table[data-pinned]");
  const heads = () => [...table().tHead.rows[0].cells];
  const column = (place) => `#list table[data-pinned] > * > tr > :nth-child(${place + 1})`;

  function widthRules() {
    const widths = read().widths ?? {};
    return heads().flatMap((head, place) => {
      const px = Number(widths[head.dataset.column]);
      if (!(px >= LEAST_PX && px <= MOST_PX)) return [];
      return [`${column(place)} { width: ${px}px; min-width: ${px}px; max-width: ${px}px; overflow: hidden; text-overflow: ellipsis; }`];
    });
  }

  /** Where each pinned column stays. On a narrow window some of them scroll, so that there is room for the others. */
  function pinRules() {
    const pinned = Number(table().dataset.pinned);
    const room = MOST_PINNED_SHARE * table().parentElement.clientWidth;
    const ticks = Number(heads()[0].classList.contains("tick"));
    const rules = [];
    let left = 0;
    for (const [place, head] of heads().slice(0, pinned ? pinned + ticks : 0).entries()) {
      const px = head.getBoundingClientRect().width;
      if (left + px > room) break;
      const cell = column(place).replace("> * >", "> tbody >");
      rules.push(`${column(place)} { position: sticky; left: ${left}px; z-index: 1; } ${column(place).replace("> * >", "> thead >")} { z-index: 2; }`);
      rules.push(`${cell}:not([class*="heat-"]) { background: var(--bs-body-bg); } ${cell.replace("> tr >", "> tr:hover >")}:not([class*="heat-"]) { background: var(--soft); }`);
      left += px;
    }
    return rules;
  }

  function arrange() {
    if (!table()) return;
    const widths = widthRules().join("\n");
    sheet.replaceSync(widths);
    sheet.replaceSync(`${widths}\n${pinRules().join("\n")}`);
    for (const head of heads()) if (head.dataset.column && !head.querySelector(".grip")) equip(head);
  }

  function setWidth(key, px) {
    const layout = read();
    const { [key]: _, ...others } = layout.widths ?? {};
    const whole = Math.round(px);
    layout.widths = whole >= LEAST_PX ? { ...others, [key]: Math.min(whole, MOST_PX) } : others;
    write(layout);
    arrange();
    showWidths();
  }

  function showWidths() {
    const widths = read().widths ?? {};
    for (const field of document.querySelectorAll("[data-width]")) field.value = widths[field.dataset.width] ?? "";
  }

  function go(columns) {
    const there = new URL(location.href);
    there.searchParams.set("columns", columns.join(","));
    there.hash = "";
    keep(there.searchParams);
    location.assign(there);
  }

  /** Move a column next to another one, by its heading. */
  function drop(key, target) {
    if (key === target.dataset.column) return;
    const columns = table().dataset.columns.split(",").filter((other) => other !== key);
    columns.splice(columns.indexOf(target.dataset.column) + Number(target.dataset.drop === "after"), 0, key);
    go(columns);
  }

  function equip(head) {
    const grip = document.createElement("span");
    grip.className = "grip";
    grip.setAttribute("aria-hidden", "true");
    grip.title = "Drag to change the width, double-click for the normal one";
    head.append(grip);
    grip.addEventListener("pointerdown", (event) => {
      event.preventDefault();
      head.draggable = false;
      grip.setPointerCapture(event.pointerId);
      const [from, width] = [event.clientX, head.getBoundingClientRect().width];
      grip.onpointermove = (moved) => setWidth(head.dataset.column, Math.max(LEAST_PX, width + moved.clientX - from));
    });
    grip.addEventListener("lostpointercapture", () => { grip.onpointermove = null; head.draggable = "movable" in head.dataset; });
    grip.addEventListener("dblclick", () => setWidth(head.dataset.column, 0));
    if (!("movable" in head.dataset)) return;
    head.draggable = true;
    head.querySelectorAll("a").forEach((link) => { link.draggable = false; });
    head.addEventListener("dragstart", (event) => event.dataTransfer.setData("text/x-column", head.dataset.column));
    head.addEventListener("dragover", (event) => {
      if (!event.dataTransfer.types.includes("text/x-column")) return;
      event.preventDefault();
      const { left, width } = head.getBoundingClientRect();
      head.dataset.drop = event.clientX < left + width / 2 ? "before" : "after";
    });
    head.addEventListener("dragleave", () => { delete head.dataset.drop; });
    head.addEventListener("drop", (event) => {
      event.preventDefault();
      drop(event.dataTransfer.getData("text/x-column"), head);
      delete head.dataset.drop;
    });
  }

  /** After a step in the list of columns, go on from there; the address does not keep that the list was open. */
  function goOn() {
    const here = new URL(location.href);
    if (!here.searchParams.has("open")) return;
    const pressed = document.getElementById(decodeURIComponent(here.hash.slice(1)))?.closest(".order-tools > *");
    (pressed?.matches("a") ? pressed : pressed?.parentElement.querySelector("a"))?.focus();
    here.searchParams.delete("open");
    here.hash = "";
    history.replaceState(null, "", here);
  }

  /** Offer the columns whose name, key or group has each typed word, and those that are selected. */
  function find(field) {
    const words = field.value.toLowerCase().split(/\s+/).filter(Boolean);
    let offered = 0;
    for (const group of field.form.querySelectorAll("details.choices")) {
      const title = group.querySelector("summary").textContent;
      for (const label of group.querySelectorAll("label")) {
        const box = label.querySelector("input");
        const text = `${title} ${label.textContent} ${box.value}`.toLowerCase();
        label.hidden = !box.checked && !words.every((word) => text.includes(word));
      }
      const some = Boolean(group.querySelector("label:not([hidden])"));
      offered += Number(some);
      group.hidden = !some;
      group.open = some && words.length > 0;
    }
    field.form.querySelector("[data-none]").hidden = offered > 0;
  }

  document.addEventListener("input", (event) => {
    if (event.target.matches?.("[data-find-column]")) find(event.target);
  });
  document.addEventListener("keydown", (event) => {
    if (event.key === "Enter" && event.target.matches?.("[data-find-column]")) event.preventDefault();
  });
  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[data-layout]");
    if (!link) return;
    if (link.dataset.layout === "standard") write({});
    else keep(new URL(link.href).searchParams);
  });
  document.addEventListener("submit", (event) => {
    if (event.target.matches("form[data-layout]")) keep(new URLSearchParams(new FormData(event.target)));
  });
  document.addEventListener("change", (event) => {
    if (event.target.dataset?.width) setWidth(event.target.dataset.width, Number(event.target.value));
  });
  document.addEventListener("pageswap", arrange);
  document.addEventListener("DOMContentLoaded", () => {
    document.adoptedStyleSheets.push(sheet);
    arrange();
    showWidths();
    goOn();
    addEventListener("resize", arrange);
  });
  addEventListener("load", arrange);
})();
