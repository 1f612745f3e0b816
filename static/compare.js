// The page of a comparison: a tick on a chip hides the curves and the path of its run, and a sentence shows its
// moment.
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
