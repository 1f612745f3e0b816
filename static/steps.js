// Shows pre-processing steps as a list with fields, and writes what is typed there into the text, which is what is sent.
// What the text says appears in the list. Steps, options and their bounds come from the templates of the page.
"use strict";
(() => {
  /** {kind, sensors, options} of a line, null for one that is no known step; the grammar of `--step`. */
  function parsed(line, kinds) {
    const [head, ...settings] = line.trim().split(/\s+/);
    const [kind, ...rest] = head.split("@");
    const known = kinds.get(kind);
    if (!known || rest.length > 1) return null;
    const options = new Map();
    for (const setting of settings) {
      const at = setting.indexOf("=");
      const name = setting.slice(0, at);
      if (at < 1 || options.has(name) || !known.options.has(name)) return null;
      options.set(name, setting.slice(at + 1));
    }
    return { kind, sensors: (rest[0] ?? "").split(",").filter(Boolean), options };
  }

  function start(root) {
    const list = root.querySelector("[data-list]");
    const adder = root.querySelector("[data-adder]");
    const choice = adder.querySelector("select");
    const text = root.querySelector("textarea");
    const sensors = root.dataset.sensors.split(" ").filter(Boolean).map((entry) => entry.split(":"));
    const kinds = new Map([...root.querySelectorAll("template")].map((template) => [template.dataset.kind, {
      template,
      options: new Set([...template.content.querySelectorAll("[data-option]")].map((field) => field.dataset.option)),
    }]));
    let shown = null;

    function lineOf(item) {
      if (item.dataset.line !== undefined) return item.dataset.line;
      const ticked = [...item.querySelectorAll("[data-sensor]:checked")].map((box) => box.dataset.sensor);
      const typed = [...item.querySelectorAll("[data-option]")].map((field) => [field.dataset.option, field.value.trim()]);
      const head = ticked.length ? `${item.dataset.kind}@${ticked.join(",")}` : item.dataset.kind;
      return [head, ...typed.filter(([, value]) => value).map(([name, value]) => `${name}=${value}`)].join(" ");
    }

    function write() {
      shown = [...list.children].map(lineOf).join("\n");
      text.value = shown;
      text.dispatchEvent(new Event("input", { bubbles: true }));
      name();
    }

    /** Number the steps, for those who cannot see their order. */
    function name() {
      [...list.children].forEach((item, place, all) => {
        item.querySelector("fieldset").setAttribute("aria-label", `Step ${place + 1}: ${item.dataset.kind || "unknown"}`);
        item.querySelector("[data-do=earlier]").disabled = place === 0;
        item.querySelector("[data-do=later]").disabled = place === all.length - 1;
      });
      list.hidden = !list.children.length;
    }

    /** Offer the sensors of the dataset that a step treats, and those that the text names besides. */
    function offer(place, wanted) {
      const treated = place.dataset.sensorChoice.split(" ");
      const names = sensors.filter(([, kind]) => treated.includes(kind)).map(([sensor]) => sensor);
      for (const sensor of new Set([...names, ...wanted])) {
        const label = document.createElement("label");
        const box = document.createElement("input");
        label.className = "tickbox";
        Object.assign(box, { type: "checkbox", checked: wanted.includes(sensor) });
        box.dataset.sensor = sensor;
        label.append(box, ` ${sensor}`);
        place.insertBefore(label, place.querySelector("small"));
      }
    }

    function item(line) {
      const step = parsed(line, kinds);
      const made = kinds.get(step?.kind ?? "").template.content.firstElementChild.cloneNode(true);
      if (!step) {
        made.dataset.line = line;
        made.querySelector("[data-line]").textContent = line;
        return made;
      }
      made.dataset.kind = step.kind;
      offer(made.querySelector("[data-sensor-choice]"), step.sensors);
      for (const [name_, value] of step.options) {
        const field = made.querySelector(`[data-option="${CSS.escape(name_)}"]`);
        if (field.tagName === "SELECT" && ![...field.options].some((entry) => entry.value === value)) field.add(new Option(value));
        field.value = value;
      }
      return made;
    }

    function read() {
      if (text.value === shown) return;
      shown = text.value;
      list.replaceChildren(...text.value.split("\n").filter((line) => line.trim()).map(item));
      name();
    }

    choice.addEventListener("change", (event) => {
      event.stopPropagation();
      if (!choice.value) return;
      const made = item(choice.value);
      list.append(made);
      choice.value = "";
      write();
      made.querySelector("[data-option]")?.focus();
    });
    choice.addEventListener("input", (event) => event.stopPropagation());
    list.addEventListener("input", (event) => { event.stopPropagation(); write(); });
    list.addEventListener("click", (event) => {
      const button = event.target.closest("[data-do]");
      if (!button) return;
      const moved = button.closest("li");
      if (button.dataset.do === "drop") moved.remove();
      else if (button.dataset.do === "earlier") moved.previousElementSibling?.before(moved);
      else moved.nextElementSibling?.after(moved);
      write();
      (button.isConnected && !button.disabled ? button : choice).focus();
    });
    text.addEventListener("input", read);
    adder.hidden = false;
    root.querySelector("[data-text]").open = false;
    read();
  }

  document.querySelectorAll("[data-steps]").forEach(start);
})();
