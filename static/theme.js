// Light or dark: the choice stored in this browser, else the system's. Loaded before anything is drawn.
"use strict";
(() => {
  document.documentElement.classList.add("scripted");
  const system = matchMedia("(prefers-color-scheme: dark)");
  let chosen = null;
  try { chosen = localStorage.getItem("theme"); } catch { /* storage may be forbidden: the system's choice holds */ }
  const apply = () => {
    document.documentElement.dataset.bsTheme = chosen || (system.matches ? "dark" : "light");
    document.dispatchEvent(new Event("themechange"));
  };
  system.addEventListener("change", apply);
  apply();
  document.addEventListener("DOMContentLoaded", () => {
    const button = document.getElementById("theme");
    button.hidden = false;
    button.addEventListener("click", () => {
      chosen = document.documentElement.dataset.bsTheme === "dark" ? "light" : "dark";
      try { localStorage.setItem("theme", chosen); } catch { /* holds for this page only */ }
      apply();
    });
  });
})();
