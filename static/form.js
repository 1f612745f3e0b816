// The web form that starts runs: parameters of the selected algorithm, and the preview.
"use strict";
(() => {
  const form = document.getElementById("start");
  if (!form) return;
  // A field is called "dataset", so form.dataset is that field and not the data attributes.
  const { preview: previewUrl, form: formUrl } = Object.fromEntries(
    ["preview", "form"].map((name) => [name, form.getAttribute(`data-${name}`)]));
  const touched = new Set();
  let timer = null;
  let last = 0;

  function filled() {
    const data = new URLSearchParams();
    for (const [name, value] of new FormData(form)) {
      if (name === "csrf_token") continue;
      const field = form.elements[name];
      if (value === (field?.dataset?.default ?? "")) continue;
      data.append(name, value);
    }
    return data;
  }

  function show(name, text) {
    const place = form.querySelector(`[data-error="${CSS.escape(name)}"]`);
    const field = form.elements[name];
    if (!place || !field) return;
    place.textContent = text || "";
    place.hidden = !text;
    if (text) field.setAttribute("aria-invalid", "true");
    else field.removeAttribute("aria-invalid");
  }

  async function preview() {
    const number = ++last;
    const answer = await fetch(`${previewUrl}?${filled()}`);
    if (number !== last) return;
    if (!answer.ok) throw new Error(String(answer.status));
    const { preview: text, errors, bound, used } = await answer.json();
    for (const place of form.querySelectorAll("[data-used]")) {
      place.textContent = (used || {})[place.dataset.used] || "–";
    }
    for (const place of form.querySelectorAll("[data-bound]")) {
      const found = (bound || {})[place.dataset.bound];
      if (!found) continue;
      place.textContent = found.words;
      form.elements[place.dataset.bound].placeholder = found.value;
    }
    for (const place of form.querySelectorAll("[data-error]")) {
      const name = place.dataset.error;
      if (touched.has(name) || !errors[name]) show(name, errors[name]);
    }
    const problems = Object.keys(errors).length;
    document.getElementById("preview").textContent =
      text || (form.elements.algorithm.value && form.elements.dataset.value
        ? `${problems} ${problems === 1 ? "field has" : "fields have"} an invalid value.` : "Select an algorithm and a dataset.");
  }

  form.addEventListener("input", (event) => {
    touched.add(event.target.name);
    if (event.target.matches("[data-reload]")) {
      location.assign(`${formUrl}?${filled()}`);
      return;
    }
    clearTimeout(timer);
    timer = setTimeout(() => preview().catch(() => {
      document.getElementById("preview").textContent = "The server does not respond.";
    }), 250);
  });
  form.addEventListener("submit", () => {
    form.querySelectorAll("button").forEach((button) => setTimeout(() => { button.disabled = true; }));
  });
  addEventListener("pageshow", () => form.querySelectorAll("button").forEach((button) => { button.disabled = false; }));
})();
