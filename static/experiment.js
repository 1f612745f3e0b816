// The experiment builder: the server turns fields into YAML and YAML into fields, and returns the preview.
// One request at a time; input typed meanwhile wins over a pending response.
"use strict";
(() => {
  const builder = document.getElementById("builder");
  const editor = document.getElementById("editor");
  if (!builder) return;
  const DELAY_MS = 350;
  const WRITE = "write";
  const NO_ANSWER = "The server does not respond.";
  const fields = document.getElementById("fields");
  const text = document.getElementById("yaml");
  const gutter = document.getElementById("gutter");
  const preview = document.getElementById("preview");
  const file = document.getElementById("file");
  const most = Number(text.dataset.most);
  const served = new Map();
  const settled = [];
  let timer = null;
  let planned = null;
  let busy = false;
  let badLine = null;

  const parts = (root) => [...root.querySelectorAll("[data-part]")];
  const remember = () => parts(fields).forEach((part) => served.set(part.id, part.innerHTML));

  function numberLines() {
    const count = text.value.split("\n").length;
    gutter.replaceChildren(...Array.from({ length: count }, (_, place) => {
      const line = document.createElement("span");
      line.textContent = place + 1;
      if (place + 1 === badLine) line.className = "bad";
      return line;
    }));
    gutter.scrollTop = text.scrollTop;
  }

  function goTo(line) {
    const lines = text.value.split("\n");
    const start = lines.slice(0, line - 1).reduce((sum, before) => sum + before.length + 1, 0);
    text.focus();
    text.setSelectionRange(start, start + (lines[line - 1] ?? "").length);
    text.scrollTop = Math.max(0, (line - 4) * (text.scrollHeight / lines.length));
  }

  function replaceParts(html, everything) {
    const fresh = new DOMParser().parseFromString(html, "text/html");
    if (!fields.firstElementChild) {
      fields.append(...parts(fresh));
      remember();
      return;
    }
    for (const part of parts(fresh)) {
      const content = part.innerHTML;
      const old = document.getElementById(part.id);
      const typing = old.contains(document.activeElement);
      if ((typing && !everything) || served.get(part.id) === content) continue;
      for (const details of old.querySelectorAll("details[open][id]")) {
        const twin = part.querySelector(`#${CSS.escape(details.id)}`);
        if (twin) twin.open = true;
      }
      served.set(part.id, content);
      old.replaceWith(document.adoptNode(part));
    }
  }

  function showErrors({ field, error }) {
    for (const place of fields.querySelectorAll("[data-error]")) {
      const hit = place.dataset.error === field;
      place.hidden = !hit;
      place.textContent = hit ? error : "";
      const input = builder.elements[place.dataset.error];
      if (!(input instanceof HTMLElement)) continue;
      if (hit) input.setAttribute("aria-invalid", "true");
      else input.removeAttribute("aria-invalid");
    }
    if (error) text.setAttribute("aria-invalid", "true");
    else text.removeAttribute("aria-invalid");
  }

  function show(state, asked) {
    if (asked.form === builder && text.value !== state.yaml) text.value = state.yaml;
    document.getElementById("stale").hidden = state.builder !== null;
    if (state.builder !== null) replaceParts(state.builder, asked.form === editor || asked.action !== WRITE);
    preview.innerHTML = state.preview;
    badLine = state.line;
    numberLines();
    showErrors(state);
    if (asked.action === "add") fields.querySelector("#part-steps fieldset:last-of-type input:not([type=hidden])")?.focus();
    else if (asked.form === builder && asked.action !== WRITE) document.getElementById("add-kind")?.focus();
  }

  function say(message) {
    const line = document.createElement("p");
    line.className = "alert alert-danger py-2";
    line.textContent = message;
    preview.replaceChildren(line);
  }

  async function ask(asked) {
    const data = new FormData(asked.form);
    data.delete("file");
    data.set("do", asked.action);
    const answer = await fetch(asked.form.action, { method: "POST", body: data, headers: { Accept: "application/json" } });
    const state = await answer.json().catch(() => ({}));
    if (answer.ok) return state;
    throw new Error(state.error ? [state.error.message, state.error.remedy].filter(Boolean).join("; ") : NO_ANSWER);
  }

  async function work() {
    clearTimeout(timer);
    if (busy) return;
    busy = true;
    preview.setAttribute("aria-busy", "true");
    while (planned) {
      const asked = planned;
      planned = null;
      try {
        const state = await ask(asked);
        builder.inert = false;
        if (!planned) show(state, asked);
      } catch (error) {
        say(error instanceof TypeError ? NO_ANSWER : error.message);
      }
      builder.inert = false;
    }
    busy = false;
    preview.removeAttribute("aria-busy");
    settled.splice(0).forEach((go) => go());
  }

  function plan(form, action, delay = 0) {
    planned = { form, action };
    builder.inert = form === builder && action !== WRITE;
    clearTimeout(timer);
    timer = setTimeout(work, delay);
  }

  const settle = () => new Promise((go) => { settled.push(go); work(); });

  builder.addEventListener("input", (event) => { if (event.target.id !== "add-kind") plan(builder, WRITE, DELAY_MS); });
  builder.addEventListener("submit", (event) => {
    event.preventDefault();
    plan(builder, event.submitter?.value ?? WRITE);
  });
  text.addEventListener("input", () => {
    badLine = null;
    numberLines();
    plan(editor, "preview", DELAY_MS);
  });
  text.addEventListener("scroll", () => { gutter.scrollTop = text.scrollTop; });
  file.addEventListener("change", async () => {
    const [chosen] = file.files;
    if (!chosen) return;
    if (chosen.size > most) { say(`${chosen.name} has more than ${most} characters. Is it the right file?`); return; }
    text.value = await chosen.text();
    file.value = "";
    plan(editor, "preview");
  });
  editor.addEventListener("submit", async (event) => {
    const button = event.submitter;
    if (button?.value !== "start") {
      event.preventDefault();
      plan(editor, "preview");
    } else if (planned || busy) {
      event.preventDefault();
      await settle();
      editor.requestSubmit(button);
    } else {
      setTimeout(() => { button.disabled = true; });
    }
  });
  preview.addEventListener("click", (event) => {
    if (event.target.dataset.line) goTo(Number(event.target.dataset.line));
  });
  addEventListener("pageshow", () => { document.getElementById("begin").disabled = false; });

  badLine = Number(preview.querySelector("[data-line]")?.dataset.line) || null;
  remember();
  numberLines();
})();
