// Loads the part of a page that takes long to compute, and refreshes it now and then while runs are active.
"use strict";
(() => {
  const SLOWER = 10;
  const LEAST_MS = 5000;

  async function fetchPart(id, address) {
    const began = performance.now();
    const answer = await fetch(address, { headers: { Accept: "text/html" } });
    if (!answer.ok) throw new Error(String(answer.status));
    const fresh = new DOMParser().parseFromString(await answer.text(), "text/html").getElementById(id);
    fresh.removeAttribute("data-swap");
    document.getElementById(id).replaceWith(document.adoptNode(fresh));
    setTimeout(() => keep(id, address), Math.max(LEAST_MS, SLOWER * (performance.now() - began)));
  }

  function keep(id, address) {
    fetchPart(id, address).catch(() => setTimeout(() => keep(id, address), 2 * LEAST_MS));
  }

  for (const place of document.querySelectorAll("[data-later]")) keep(place.id, place.dataset.later);
})();
