// Keeps the page up to date. Each event updates the progress. When the set of runs or their states change, the page
// is fetched once, and those parts marked data-swap that the server makes differently now replace the old ones, without
// a reload or a jump.
"use strict";
(() => {
  const POLL_MS = 5000;
  const REFRESH_MS = 2000;
  let version = null;
  let fetching = false;
  let polling = null;
  let wanted = false;

  // The parts as the server made them. What scripts have drawn into them since, such as widths of columns, is no change,
  // and neither is the token of a form, which is another one in each answer.
  const made = new Map();
  const asMade = (part) => part.innerHTML.replace(/name="csrf_token" value="[^"]*"/g, "");
  // This script comes first, so no other one has changed anything yet.
  for (const part of document.querySelectorAll("[data-swap]")) made.set(part.id, asMade(part));

  const connection = (text) => {
    const place = document.getElementById("connection");
    if (place && place.textContent !== text) place.textContent = text;
  };

  function putProgress(run) {
    for (const place of document.querySelectorAll(`[data-run="${run.id}"]`)) {
      const value = run[place.dataset.field];
      if (place.dataset.field === "percent") {
        place.querySelector("rect").setAttribute("width", value ?? 0);
        if (value === null) place.removeAttribute("aria-valuenow");
        else place.setAttribute("aria-valuenow", value);
      } else if (value !== undefined && place.textContent !== value) {
        place.textContent = value;
      }
    }
  }

  function keepState(old, fresh) {
    for (const details of old.querySelectorAll("details[open]")) {
      const place = [...old.querySelectorAll("details")].indexOf(details);
      const twin = fresh.querySelectorAll("details")[place];
      if (twin) twin.open = true;
    }
    for (const box of old.querySelectorAll("input[type=checkbox]:checked")) {
      const twin = box.id && fresh.querySelector(`#${CSS.escape(box.id)}`);
      if (twin) twin.checked = true;
    }
    for (const choice of old.querySelectorAll("select[id]")) {
      const twin = fresh.querySelector(`#${CSS.escape(choice.id)}`);
      if (twin) twin.value = choice.value;
    }
  }

  // Puts a part that the document did not have yet, such as the first answers, beside a neighbour in the new page.
  function putNew(fresh, ids) {
    const place = ids.indexOf(fresh.id);
    made.set(fresh.id, asMade(fresh));
    const before = ids.slice(0, place).reverse().map((id) => document.getElementById(id)).find(Boolean);
    const after = ids.slice(place + 1).map((id) => document.getElementById(id)).find(Boolean);
    if (before) before.after(document.adoptNode(fresh));
    else if (after) after.before(document.adoptNode(fresh));
    return Boolean(before || after);
  }

  function swap(page) {
    let swapped = false;
    const ids = [...page.querySelectorAll("[data-swap]")].map((part) => part.id);  // parts leave the page below
    for (const old of document.querySelectorAll("[data-swap]")) {
      const fresh = page.getElementById(old.id);
      // What was watched has ended, and the page is another one by now.
      if (!fresh && "refresh" in old.dataset) { location.reload(); return; }
      const text = fresh && asMade(fresh);
      if (!fresh || text === made.get(old.id)) continue;
      if (old.querySelector("[data-editing]")) continue;
      if (old.contains(document.activeElement) && /^(SELECT|INPUT)$/.test(document.activeElement.tagName)) continue;
      const focused = old.contains(document.activeElement) ? document.activeElement : null;
      const scrolled = [...old.querySelectorAll(".table-wrap, .log")].map((box) => [box.scrollTop, box.scrollLeft]);
      const twinOf = focused && [...old.querySelectorAll("a, button")].indexOf(focused);
      made.set(old.id, text);
      keepState(old, fresh);
      old.replaceWith(document.adoptNode(fresh));
      swapped = true;
      [...fresh.querySelectorAll(".table-wrap, .log")].forEach((box, place) => {
        if (scrolled[place]) [box.scrollTop, box.scrollLeft] = scrolled[place];
      });
      if (focused) fresh.querySelectorAll("a, button")[twinOf]?.focus({ preventScroll: true });
    }
    for (const id of ids) {
      if (!document.getElementById(id) && putNew(page.getElementById(id), ids)) swapped = true;
    }
    if (swapped) document.dispatchEvent(new Event("pageswap"));
  }

  async function refresh() {
    if (fetching) { wanted = true; return; }
    if (!document.querySelector("[data-swap]")) return;
    fetching = true;
    try {
      const answer = await fetch(location.href, { headers: { Accept: "text/html" }, credentials: "same-origin" });
      if (answer.ok) swap(new DOMParser().parseFromString(await answer.text(), "text/html"));
    } catch { connection("connection lost, trying again"); }
    fetching = false;
    if (wanted) { wanted = false; refresh(); }
    else if (document.querySelector("[data-refresh]")) setTimeout(refresh, REFRESH_MS);
  }

  function receive(state) {
    connection("live");
    const changed = version !== state.version;
    version = state.version;
    // The first event counts too: between the making of this page and that event, a run may have ended.
    if (changed) refresh();
    state.active.forEach(putProgress);
  }

  async function poll() {
    try {
      const answer = await fetch(document.body.dataset.live);
      if (!answer.ok) throw new Error(String(answer.status));
      receive(await answer.json());
      connection("live, every 5 s");
    } catch { connection("connection lost, trying again"); }
  }

  function startPolling() { if (polling === null) { poll(); polling = setInterval(poll, POLL_MS); } }

  document.addEventListener("DOMContentLoaded", () => {
    if (!document.querySelector("[data-swap]")) return;
    if (document.querySelector("[data-refresh]")) setTimeout(refresh, REFRESH_MS);
    if (!window.EventSource) { startPolling(); return; }
    const source = new EventSource(document.body.dataset.events);
    source.addEventListener("state", (event) => receive(JSON.parse(event.data)));
    source.addEventListener("error", () => {
      if (source.readyState === EventSource.CLOSED) startPolling();
      else connection("connection lost, trying again");
    });
    addEventListener("pagehide", () => source.close());
  });
})();
