// The filter field of the runs page: completes names and values from the one list of fields, and submits only what is
// filled in. Arrow keys choose, Enter or Tab takes the choice, Escape closes the list.
"use strict";
(() => {
  const MOST = 12;
  const PART = /[^\s()<>=!~,"']*$/;
  const VALUE_OF = /([^\s()<>=!~,"']+)\s*(?:!?[=~]|(?:not\s+)?in\s*\([^)]*)\s*$/i;
  const input = document.querySelector("input[data-fields]");
  if (!input) return;

  const list = document.createElement("ul");
  list.id = "completions";
  list.className = "completions";
  list.setAttribute("role", "listbox");
  list.setAttribute("aria-label", "Names and values");
  list.hidden = true;
  input.after(list);
  for (const [name, value] of Object.entries({
    role: "combobox", "aria-autocomplete": "list", "aria-expanded": "false", "aria-controls": list.id,
  })) input.setAttribute(name, value);

  let fields = null;
  let active = -1;

  async function load() {
    if (fields) return;
    const answer = await fetch(input.dataset.fields, { headers: { Accept: "application/json" } });
    if (answer.ok) fields = (await answer.json()).fields;
  }

  /** What is typed before the caret: the unfinished word, and the field whose value it is, if it is one. */
  function typed() {
    const before = input.value.slice(0, input.selectionStart);
    const word = before.match(PART)[0];
    const name = before.slice(0, before.length - word.length).match(VALUE_OF)?.[1];
    return { word, field: name && fields.find((field) => field.name === name) };
  }

  function suggestions(always) {
    const { word, field } = typed();
    if (!word && !field && !always) return [];
    const offered = field
      ? field.values.map((value) => ({ name: value, label: "" }))
      : fields.map((entry) => ({ name: entry.name, label: entry.unit ? `${entry.label} [${entry.unit}]` : entry.label }));
    const low = word.toLowerCase();
    const starts = offered.filter((entry) => entry.name.toLowerCase().startsWith(low));
    const holds = offered.filter((entry) => !starts.includes(entry)
      && `${entry.name} ${entry.label}`.toLowerCase().includes(low));
    const found = [...starts, ...holds].slice(0, MOST);
    return found.length === 1 && found[0].name === word ? [] : found;
  }

  function close() {
    list.hidden = true;
    active = -1;
    input.setAttribute("aria-expanded", "false");
    input.removeAttribute("aria-activedescendant");
  }

  function choose(place) {
    const options = list.children;
    active = (place + options.length) % options.length;
    [...options].forEach((option, index) => option.setAttribute("aria-selected", String(index === active)));
    input.setAttribute("aria-activedescendant", options[active].id);
    options[active].scrollIntoView({ block: "nearest" });
  }

  function show(always = false) {
    const found = fields ? suggestions(always) : [];
    if (!found.length) { close(); return; }
    list.replaceChildren(...found.map((entry, place) => {
      const option = document.createElement("li");
      option.id = `completion-${place}`;
      option.setAttribute("role", "option");
      option.setAttribute("aria-selected", "false");
      const name = document.createElement("code");
      name.textContent = entry.name;
      option.append(name, ` ${entry.label}`);
      option.dataset.name = entry.name;
      option.addEventListener("mousedown", (event) => { event.preventDefault(); take(entry.name); });
      return option;
    }));
    active = -1;
    list.hidden = false;
    input.setAttribute("aria-expanded", "true");
    input.removeAttribute("aria-activedescendant");
  }

  function take(name) {
    const caret = input.selectionStart;
    const start = caret - typed().word.length;
    const text = /[\s()<>=!~,"']/.test(name) ? `"${name.replaceAll('"', '""')}"` : name;
    input.setRangeText(`${text} `, start, caret, "end");
    close();
    input.focus();
  }

  input.addEventListener("focus", () => { load().catch(() => {}); });
  input.addEventListener("input", () => { load().then(() => show(), () => {}); });
  input.addEventListener("blur", close);
  input.addEventListener("keydown", (event) => {
    if (event.key === "ArrowDown" && list.hidden) {
      event.preventDefault();
      load().then(() => show(true), () => {});
    } else if (list.hidden) {
      return;
    } else if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      event.preventDefault();
      choose(event.key === "ArrowDown" ? active + 1 : Math.max(active, 0) - 1);
    } else if ((event.key === "Enter" || event.key === "Tab") && active >= 0) {
      event.preventDefault();
      take(list.children[active].dataset.name);
    } else if (event.key === "Escape") {
      event.preventDefault();
      close();
    }
  });

  const form = input.form;
  const empty = () => [...form.elements].filter((field) => field.name && field.value === "" && !field.disabled);
  form.addEventListener("submit", () => {
    const left = empty();
    left.forEach((field) => { field.disabled = true; });
    setTimeout(() => left.forEach((field) => { field.disabled = false; }));
  });
})();
