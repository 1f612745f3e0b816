// Forms that show what is chosen as soon as it is chosen; their button is for browsers without scripts.
"use strict";
for (const form of document.querySelectorAll("form[data-at-once]")) {
  form.querySelector("button").hidden = true;
  form.addEventListener("change", () => form.requestSubmit());
}
