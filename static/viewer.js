// Opens the 3D view of a page when it is asked for. Only then are three.js and the parts of the view loaded.
"use strict";
(() => {
  const NO_WEBGL = "This browser offers no WebGL 2, so there is no 3D view here. The plots of this page show the same in 2D.";

  function say(panel, text) {
    panel.querySelector("[data-says]").textContent = text;
  }

  function hasWebgl() {
    try {
      return Boolean(document.createElement("canvas").getContext("webgl2"));
    } catch {
      return false;
    }
  }

  /** The address of a module; a static site makes it of a script. */
  const moduleOf = window.slamhiveModuleOf ?? ((address) => address);

  async function show(panel, button) {
    if (!hasWebgl()) {
      button.hidden = true;
      say(panel, NO_WEBGL);
      return;
    }
    button.disabled = true;
    say(panel, "Loading the 3D view.");
    try {
      const { open } = await import(await moduleOf(panel.dataset.module));
      await open(panel, (text) => say(panel, text));
      button.hidden = true;
    } catch (error) {
      button.disabled = false;
      say(panel, `The 3D view could not be opened: ${error.message}`);
    }
  }

  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    if (!document.documentElement.dataset.bsTheme) document.dispatchEvent(new Event("themechange"));
  });

  for (const panel of document.querySelectorAll("[data-viewer]")) {
    const button = panel.querySelector("[data-open]");
    button.hidden = false;
    button.addEventListener("click", () => show(panel, button));
  }
})();
