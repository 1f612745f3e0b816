// The editor of reports: line numbers, a check and the list of plots while typing, and pictures of the plots of a text
// that is valid. Also reloads a page that waits for its report.
"use strict";
(() => {
  const DELAY_MS = 500;
  document.addEventListener("pageswap", () => { if (document.getElementById("ready")) location.reload(); });

  const form = document.getElementById("analysis");
  if (!form) return;
  const text = document.getElementById("yaml");
  const gutter = document.getElementById("gutter");
  const verdict = document.getElementById("verdict");
  let timer = null;
  let last = 0;
  let bad = null;
  let listed = null;

  function number() {
    const count = text.value.split("\n").length;
    gutter.replaceChildren(...Array.from({ length: count }, (_, place) => {
      const line = document.createElement("span");
      line.textContent = place + 1;
      if (place + 1 === bad) line.className = "bad";
      return line;
    }));
    gutter.scrollTop = text.scrollTop;
  }

  async function check() {
    if (!form.dataset.check) return;
    const turn = ++last;
    const body = new FormData();
    body.set("csrf_token", form.elements.csrf_token.value);
    body.set("yaml", text.value);
    const answer = await fetch(form.dataset.check, { method: "POST", body, headers: { Accept: "application/json" } });
    if (turn !== last) return;
    const said = await answer.json();
    const found = said.error ? { ok: false, line: null, ...said.error } : said;
    bad = found.line;
    if (found.plots && found.plots !== listed) {
      listed = found.plots;
      list(partOf(listed));
    }
    verdict.textContent = found.message.endsWith(".") && found.remedy ? `${found.message} ${found.remedy[0].toUpperCase()}${found.remedy.slice(1)}` : [found.message, found.remedy].filter(Boolean).join("; ");
    verdict.classList.toggle("bad", !found.ok);
    text.toggleAttribute("aria-invalid", !found.ok);
    number();
    if (found.ok && live) preview();
  }

  const plots = document.getElementById("plots");
  const partOf = (markup) => new DOMParser().parseFromString(markup, "text/html").body;

  /** Shows the list of plots anew; a plot keeps its picture until there is another one. */
  function list(fresh) {
    const pictures = new Map([...plots.querySelectorAll("li:has(figure)")].map((entry) => [entry.dataset.plot, entry.querySelector("figure")]));
    for (const entry of fresh.querySelectorAll("li:not(:has(figure))")) {
      const kept = pictures.get(entry.dataset.plot);
      if (kept) entry.append(kept.cloneNode(true));
    }
    plots.replaceChildren(...fresh.childNodes);
  }

  // One request at a time: a text that changed meanwhile is previewed after it.
  let live = "live" in form.dataset;
  let shown = null;
  let busy = false;
  async function preview() {
    const wanted = text.value;
    if (busy || wanted === shown) return;
    busy = true;
    plots.setAttribute("aria-busy", "true");
    try {
      const body = new FormData();
      body.set("csrf_token", form.elements.csrf_token.value);
      body.set("yaml", wanted);
      const answer = await fetch(form.dataset.previews, { method: "POST", body });
      if (answer.ok && text.value === wanted) list(partOf(await answer.text()));
      shown = wanted;
    } finally {
      busy = false;
      plots.setAttribute("aria-busy", "false");
    }
    if (text.value !== wanted) plan();
  }

  // What changes the list of plots does so in place, by the answer that a browser without scripts would show.
  const IN_PLACE = /^(insert|remove|earlier|later):/;
  document.addEventListener("click", async (event) => {
    const button = event.target.closest("button[name=do]");
    if (!button || !IN_PLACE.test(button.value)) return;
    event.preventDefault();
    const body = new FormData(form);
    body.set("do", button.value);
    body.delete("file");
    try {
      const answer = await fetch(form.action, { method: "POST", body });
      const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
      text.value = fresh.getElementById("yaml").value;
      verdict.textContent = fresh.getElementById("verdict").textContent;
      verdict.classList.toggle("bad", !answer.ok);
      if (!answer.ok) return;
      list(fresh.getElementById("plots"));
      listed = null;
      number();
      if (button.value.startsWith("insert:")) plots.querySelector("li:last-child")?.scrollIntoView({ block: "nearest" });
      if (live) preview();
    } catch {
      verdict.textContent = "The server does not respond.";
    }
  });

  const plan = () => {
    clearTimeout(timer);
    timer = setTimeout(() => check().catch(() => { verdict.textContent = "The server does not respond."; }), DELAY_MS);
  };
  text.addEventListener("input", () => { number(); plan(); });
  text.addEventListener("scroll", () => { gutter.scrollTop = text.scrollTop; });
  document.getElementById("file").addEventListener("change", async (event) => {
    const [file] = event.target.files;
    if (!file) return;
    text.value = await file.text();
    event.target.value = "";
    number();
    plan();
  });
  document.getElementById("preview")?.addEventListener("click", (event) => {
    event.preventDefault();
    live = true;
    check();
  });
  number();
  if (live || !verdict.textContent) plan();
})();
