// The editor of analysis files: line numbers, a check and the list of plots while typing, and previews of a text that is
// valid. Also reloads a page that waits for its report.
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
      document.getElementById("plots").replaceChildren(...new DOMParser().parseFromString(listed, "text/html").body.childNodes);
    }
    verdict.textContent = [found.message, found.remedy].filter(Boolean).join("; ");
    verdict.classList.toggle("bad", !found.ok);
    text.toggleAttribute("aria-invalid", !found.ok);
    number();
    if (found.ok && previews && !part.hidden) preview();
  }

  // One request at a time: a text that changed meanwhile is previewed after it.
  const previews = document.getElementById("previews");
  const part = document.getElementById("previews-part");
  let shown = null;
  let busy = false;
  async function preview() {
    const wanted = text.value;
    if (busy || wanted === shown) return;
    busy = true;
    part.hidden = false;
    part.setAttribute("aria-busy", "true");
    try {
      const body = new FormData();
      body.set("csrf_token", form.elements.csrf_token.value);
      body.set("yaml", wanted);
      const answer = await fetch(previews.dataset.previews, { method: "POST", body });
      const fresh = new DOMParser().parseFromString(await answer.text(), "text/html");
      if (answer.ok) previews.replaceChildren(...fresh.body.children);
      shown = wanted;
    } finally {
      busy = false;
      part.setAttribute("aria-busy", "false");
    }
    if (text.value !== wanted) plan();
  }

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
    part.hidden = false;
    check();
  });
  number();
  if (!verdict.textContent || !part?.hidden) plan();
})();
