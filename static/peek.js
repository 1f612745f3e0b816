// A click on a row of the list of runs shows that run beside the list. Arrow keys go to the row above or below, Escape
// closes. The number of the run stays a link to its page, with and without this script.
"use strict";
(() => {
  const aside = document.getElementById("peek");
  if (!aside) return;
  let shown = null;
  let asked = 0;
  const rows = () => [...document.querySelectorAll("#list tr[data-peek]")];
  const mark = () => rows().forEach((row) => row.classList.toggle("peeked", row.dataset.peek === shown));

  async function show(row) {
    shown = row.dataset.peek;
    mark();
    row.scrollIntoView({ block: "nearest" });
    const number = ++asked;
    const answer = await fetch(shown, { headers: { Accept: "text/html" }, credentials: "same-origin" }).catch(() => null);
    if (number !== asked) return;
    if (!answer?.ok) { location.href = row.querySelector("a[href]").href; return; }
    const page = new DOMParser().parseFromString(await answer.text(), "text/html");
    aside.replaceChildren(...page.body.childNodes);
    aside.hidden = false;
    document.body.classList.add("peeking");
  }

  function close() {
    shown = null;
    asked++;
    aside.hidden = true;
    document.body.classList.remove("peeking");
    mark();
  }

  document.addEventListener("click", (event) => {
    if (event.target.closest("#peek .btn-close")) { close(); return; }
    const row = event.target.closest("#list tr[data-peek]");
    if (!row || event.target.closest("a, button, input, label, textarea, .grip") || getSelection().toString()) return;
    if (row.dataset.peek === shown) close(); else show(row);
  });
  document.addEventListener("keydown", (event) => {
    if (aside.hidden || event.target.closest("input, textarea, select, dialog")) return;
    if (event.key === "Escape") { close(); return; }
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    const next = step && rows()[rows().findIndex((row) => row.dataset.peek === shown) + step];
    if (!next) return;
    event.preventDefault();
    show(next);
  });
  document.addEventListener("pageswap", mark);
})();
