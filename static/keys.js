// Keyboard of every page: / and Ctrl-K open the palette, ? lists the keys, g and a letter open a page of the rail.
"use strict";
(() => {
  const WAIT_MS = 1200;
  let goesUntil = 0;

  const typing = (target) => target.isContentEditable || /^(INPUT|TEXTAREA|SELECT)$/.test(target.tagName);

  document.addEventListener("keydown", (event) => {
    if ((event.ctrlKey || event.metaKey) && event.key === "k") { event.preventDefault(); open(); return; }
    if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target)) return;
    const going = event.timeStamp < goesUntil;
    const page = going && document.querySelector(`.rail [data-key="${CSS.escape(event.key)}"]`);
    goesUntil = 0;
    if (event.key === "/") open();
    else if (event.key === "?") document.getElementById("keys").showModal();
    else if (page) page.click();
    else if (event.key === "g") goesUntil = event.timeStamp + WAIT_MS;
    else return;
    event.preventDefault();
  });

  // Menus close with Escape, and with a click beside them.
  const menus = () => document.querySelectorAll("details.menu[open]");
  document.addEventListener("click", (event) => {
    for (const menu of menus()) if (!menu.contains(event.target)) menu.open = false;
  });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape") return;
    for (const menu of menus()) { menu.open = false; menu.querySelector("summary").focus(); }
  });

  // The palette: what this page can do, where one can go, and what the server finds.
  const DELAY_MS = 120;
  const palette = document.getElementById("palette");
  const field = palette.querySelector("input");
  const list = document.getElementById("palette-list");
  let local = [];
  let options = [];
  let chosen = 0;
  let asked = 0;
  let waiting = false;
  let enter = false;
  let timer = null;

  const wordsOf = (element) => {
    const twin = element.cloneNode(true);
    twin.querySelectorAll("small, kbd, svg").forEach((part) => part.remove());
    return twin.textContent.replace(/\s+/g, " ").trim();
  };
  const shown = (element) => element.checkVisibility() && !element.disabled;

  function gather() {
    const entry = (group, title) => (element) => ({
      group, title: title(element), words: element.querySelector("small")?.textContent ?? "", act: () => element.click(),
    });
    const here = [...document.querySelectorAll("main :is(.actions, .act) :is(a.btn, button:not([type=button]))")].filter(shown);
    return [
      ...here.map(entry("On this page", wordsOf)),
      ...[...document.querySelectorAll("[data-new]")].map(entry("New", (element) => `New ${wordsOf(element).toLowerCase()}`)),
      ...[...document.querySelectorAll(".rail li a")].map(entry("Go to", wordsOf)),
      ...[...document.querySelectorAll('.top [rel="help"]')].map(entry("Go to", () => "Help on this page")),
      ...[...document.querySelectorAll(".top .menu li a:not([data-new])")].map(entry("Go to", wordsOf)),
      { group: "Do", title: "Switch between light and dark", words: "", act: () => { palette.close(); document.getElementById("theme").click(); } },
      { group: "Do", title: "Show the keyboard shortcuts", words: "", act: () => { palette.close(); document.getElementById("keys").showModal(); } },
    ];
  }

  function show(found) {
    const text = field.value.trim().toLowerCase();
    const fits = (entry) => text.split(/\s+/).every((word) => entry.title.toLowerCase().split(/[\s-]+/).some((part) => part.startsWith(word)));
    options = text ? [...local.filter(fits), ...found] : local;
    if (text) options.push({ group: "", title: `Find “${field.value.trim()}” everywhere`, words: "", act: () => { location.href = `${palette.dataset.all}?q=${encodeURIComponent(field.value.trim())}`; } });
    list.replaceChildren();
    let group = null;
    let box = null;
    options.forEach((entry, place) => {
      if (entry.group !== group || !box) {
        group = entry.group;
        box = list.appendChild(document.createElement("div"));
        box.setAttribute("role", "group");
        box.ariaLabel = group || "Everywhere";
        if (group) box.appendChild(Object.assign(document.createElement("div"), { className: "group", textContent: group, ariaHidden: "true" }));
      }
      const option = box.appendChild(document.createElement("div"));
      option.setAttribute("role", "option");
      option.id = `palette-${place}`;
      option.append(entry.title);
      if (entry.words) option.appendChild(Object.assign(document.createElement("small"), { textContent: entry.words }));
      option.addEventListener("click", () => entry.act());
    });
    choose(0);
  }

  function choose(place) {
    if (!options.length) { field.removeAttribute("aria-activedescendant"); return; }
    chosen = (place + options.length) % options.length;
    field.setAttribute("aria-activedescendant", `palette-${chosen}`);
    for (const option of list.querySelectorAll("[role=option]")) option.ariaSelected = String(option.id === `palette-${chosen}`);
    document.getElementById(`palette-${chosen}`).scrollIntoView({ block: "nearest" });
  }

  async function ask() {
    const text = field.value.trim();
    const number = ++asked;
    let found = [];
    try {
      const answer = await fetch(`${palette.dataset.find}?q=${encodeURIComponent(text)}`, { headers: { Accept: "application/json" } });
      if (answer.ok) found = (await answer.json()).found;
    } catch { /* what this page knows is still offered */ }
    if (number !== asked) return;
    waiting = false;
    show(found.map((entry) => ({ ...entry, act: () => { location.href = entry.url; } })));
    if (enter) { enter = false; options[chosen].act(); }
  }

  function open() {
    if (palette.open) return;
    local = gather();
    field.value = "";
    waiting = enter = false;
    show([]);
    palette.showModal();
    field.focus();
  }

  field.addEventListener("input", () => {
    clearTimeout(timer);
    enter = false;
    asked += 1;
    waiting = field.value.trim() !== "";
    show([]);
    if (waiting) timer = setTimeout(ask, DELAY_MS);
  });
  field.addEventListener("keydown", (event) => {
    if (event.key === "ArrowDown") choose(chosen + 1);
    else if (event.key === "ArrowUp") choose(chosen - 1);
    else if (event.key === "Enter" && !event.isComposing) {
      // What is typed fast is looked up before it is opened.
      if (waiting && options.length === 1) enter = true;
      else options[chosen]?.act();
    } else return;
    event.preventDefault();
  });
  palette.addEventListener("click", (event) => { if (event.target === palette) palette.close(); });
  document.getElementById("find-open").addEventListener("click", open);
})();
