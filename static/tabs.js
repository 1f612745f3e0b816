// Shows one part of a page at a time: the one that the address names, or that holds what it names. Without scripts all
// parts stand below each other, and the tabs lead to them. Also filters the metrics, and brings the log of a live run.
"use strict";
(() => {
  const LOG_MS = 2000;
  const parts = [...document.querySelectorAll("[data-tab]")];
  const links = [...document.querySelectorAll(".tabbar a[href^='#']")];
  const first = parts.find((part) => "shown" in part.dataset);

  function show(part) {
    for (const other of parts) other.toggleAttribute("data-shown", other === part);
    for (const link of links) {
      if (link.hash === `#${part.id}`) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
  }

  /** The part that the address means; what lies inside of it is scrolled to. */
  function follow() {
    const named = location.hash.length > 1 ? document.getElementById(decodeURIComponent(location.hash.slice(1))) : null;
    const part = named?.closest("[data-tab]") ?? (location.hash ? null : first);
    if (!part) return;
    show(part);
    if (named === part) window.scrollTo(0, 0);
    else named?.scrollIntoView();
  }

  for (const link of links) {
    link.addEventListener("click", (event) => {
      if (event.ctrlKey || event.metaKey || event.shiftKey) return;
      event.preventDefault();
      const address = new URL(location.href);
      address.hash = link.hash;
      history.pushState(null, "", address);
      show(document.getElementById(link.hash.slice(1)));
    });
  }
  window.addEventListener("hashchange", follow);
  window.addEventListener("popstate", follow);
  follow();

  /** Only the rows that hold every word; a group without such a row is not shown. */
  function filter(input) {
    const words = input.value.toLowerCase().split(/\s+/).filter(Boolean);
    const scope = document.getElementById(input.dataset.findIn);
    let found = 0;
    for (const row of scope.querySelectorAll("tbody tr")) {
      const text = `${row.closest("details")?.querySelector("summary").textContent ?? ""} ${row.textContent} ${row.cells[0].title}`.toLowerCase();
      row.hidden = !words.every((word) => text.includes(word));
      found += row.hidden ? 0 : 1;
    }
    for (const group of scope.querySelectorAll("details:has(tbody)")) {
      group.hidden = !group.querySelector("tbody tr:not([hidden])");
      if (words.length) group.open = true;
    }
    input.closest("p").querySelector("[role=status]").textContent = words.length ? `${found} found` : "";
  }

  for (const input of document.querySelectorAll("[data-find-in]")) {
    input.addEventListener("input", () => filter(input));
    document.addEventListener("pageswap", () => filter(input));
  }

  /** The end of the log, which stays in view unless somebody has scrolled up. */
  async function bringLog(place) {
    try {
      const answer = await fetch(place.dataset.liveLog, { headers: { Accept: "application/json" } });
      if (!answer.ok) return;
      const { log } = await answer.json();
      const isAtEnd = place.scrollHeight - place.scrollTop - place.clientHeight < 8;
      if (place.textContent !== log) place.textContent = log;
      if (isAtEnd) place.scrollTop = place.scrollHeight;
    } catch { /* the server is away: the page says so elsewhere, and asks again */ }
  }

  const live = document.querySelector("[data-live-log]");
  if (live) {
    live.scrollTop = live.scrollHeight;
    setInterval(() => { if (document.querySelector("[data-active]") && !document.hidden) bringLog(live); }, LOG_MS);
  }
})();
