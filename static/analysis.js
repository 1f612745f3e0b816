// The editor of analysis files: line numbers and a check while typing. Also reloads a page that waits for its report.
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
    verdict.textContent = [found.message, found.remedy].filter(Boolean).join("; ");
    verdict.classList.toggle("bad", !found.ok);
    text.toggleAttribute("aria-invalid", !found.ok);
    number();
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
  number();
  if (!verdict.textContent) plan();
})();
