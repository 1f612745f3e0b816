// Enables the buttons that act on selected rows only while the selection fits, and says why they are disabled. The box
// in the heading selects all rows of the table. The box of a configuration stands for several runs: its value names them.
"use strict";
(() => {
  function update(form) {
    const chosen = [...form.querySelectorAll("input[name=run]:checked")];
    const count = chosen.length;
    const runs = chosen.reduce((sum, box) => sum + box.value.split(",").length, 0);
    const rows = form.dataset.select || "runs";
    let why = "";
    for (const button of form.querySelectorAll("[data-needs]")) {
      const needs = Number(button.dataset.needs);
      const most = Number(button.dataset.most || Infinity);
      button.disabled = count < needs || runs > most;
      if (count < needs && needs > 1) why = count ? `Select another ${rows.slice(0, -1)} to compare.` : `Select ${needs} ${rows === "runs" ? `to ${most}` : "or more"} ${rows} to compare.`;
      if (runs > most) why = `${runs} runs are selected, at most ${most} can be compared.`;
    }
    const all = form.querySelector("[data-all]");
    if (all) {
      all.checked = count > 0 && count === form.querySelectorAll("input[name=run]:enabled").length;
      all.indeterminate = count > 0 && !all.checked;
    }
    const selected = form.querySelector("[data-count]");
    if (selected) selected.textContent = `${runs} selected`;
    const place = form.querySelector("[data-why]");
    if (place && place.textContent !== why) place.textContent = why;
  }
  const updateAll = () => document.querySelectorAll("form[data-select]").forEach(update);
  document.addEventListener("change", (event) => {
    const form = event.target.closest?.("form[data-select]");
    if (!form) return;
    if ("all" in event.target.dataset) form.querySelectorAll("input[name=run]:enabled").forEach((box) => { box.checked = event.target.checked; });
    update(form);
  });
  document.addEventListener("pageswap", updateAll);
  window.addEventListener("pageshow", updateAll);
  updateAll();
})();
