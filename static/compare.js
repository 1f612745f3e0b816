// The page of a comparison: a tick on a chip hides the curves and the path of its run, a sentence shows its moment, and
// another protocol is shown as soon as it is chosen.
"use strict";
(() => {
  const boxes = [...document.querySelectorAll("[data-shows]")];

  function hide() {
    const hidden = new Set(boxes.filter((box) => !box.checked).map((box) => Number(box.dataset.shows)));
    document.dispatchEvent(new CustomEvent("hideruns", { detail: hidden }));
  }

  for (const box of boxes) {
    box.checked = true; // a reload would keep a tick, and draw what it hides
    box.addEventListener("change", hide);
  }
  for (const form of document.querySelectorAll("[data-at-once]")) {
    form.querySelector("button").hidden = true;
    form.addEventListener("change", () => form.requestSubmit());
  }
  document.addEventListener("timeline", ({ detail: { origin_s: origin } }) => {
    for (const link of document.querySelectorAll("[data-moment-of]")) {
      link.onclick = (event) => {
        if (event.ctrlKey || event.metaKey || event.shiftKey) return;
        event.preventDefault();
        document.dispatchEvent(new CustomEvent("moment", { detail: origin + Number(link.dataset.momentOf) }));
        document.getElementById("figure-time").scrollIntoView({ block: "nearest" });
      };
    }
  });
})();
