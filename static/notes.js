// Notes and tags are edited in the cell that shows them: Enter stores, Escape leaves them as they were. Without scripts
// the same link leads to the form on the page of the run.
"use strict";
(() => {
  const FIELDS = {
    tags: { element: "input", longest: 2000, show: (tags) => tags.join(", "), edit: (tags) => tags.join(" ") },
    note: { element: "textarea", longest: 10000, show: (note) => note.replace(/\s+/g, " ").trim(), edit: (note) => note },
  };
  const NONE = "–";

  function element(name, attributes = {}, text = "") {
    const made = document.createElement(name);
    made.textContent = text;
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    return made;
  }

  function show(cell, link, value) {
    const { show: shown, edit } = FIELDS[link.dataset.edit];
    const text = shown(value);
    cell.classList.toggle("missing", !text);
    cell.title = link.dataset.edit === "note" ? value : text;
    cell.querySelector(".clip").textContent = text || NONE;
    link.dataset.value = edit(value);
  }

  /** Send one field; the server keeps the other one. Returns what is stored then. */
  async function store(link, token, text) {
    const body = new FormData();
    body.set("csrf_token", token);
    body.set(link.dataset.edit, text);
    const answer = await fetch(`${new URL(link.href).pathname}/notes`, { method: "POST", body, headers: { Accept: "application/json" } });
    const said = await answer.json();
    if (!answer.ok) throw new Error([said.detail, said.remedy].filter(Boolean).join("; "));
    return said[link.dataset.edit];
  }

  function open(link, token) {
    const cell = link.closest("td");
    const kind = FIELDS[link.dataset.edit];
    const field = element(kind.element, { class: "form-control form-control-sm", maxlength: kind.longest, "aria-label": link.dataset.label });
    const [save, leave] = [["Store", "primary"], ["Cancel", "secondary"]].map(([text, look]) => element("button", { type: "button", class: `btn btn-sm btn-outline-${look}` }, text));
    const verdict = element("span", { role: "alert" });
    const editor = element("span", { class: "cell-editor", "data-editing": "" });
    editor.append(field, save, leave, verdict);
    field.value = link.dataset.value;
    cell.classList.add("open");
    cell.append(editor);
    field.focus();

    function close() {
      editor.remove();
      cell.classList.remove("open");
      link.focus();
    }

    async function send() {
      if (save.disabled) return;
      save.disabled = true;
      verdict.textContent = "";
      try {
        show(cell, link, await store(link, token, field.value));
        close();
      } catch (error) {
        verdict.textContent = error instanceof TypeError || error instanceof SyntaxError ? "The server does not respond." : error.message;
        field.focus();
      }
      save.disabled = false;
    }

    save.addEventListener("click", send);
    leave.addEventListener("click", close);
    editor.addEventListener("keydown", (event) => {
      if (event.key === "Escape") close();
      else if (event.key === "Enter" && event.target === field && !event.shiftKey && !event.isComposing) send();
      else return;
      event.preventDefault(); // Enter would send the form around the table
    });
  }

  document.addEventListener("click", (event) => {
    const link = event.target.closest?.("a[data-edit]");
    const token = document.querySelector("[name=csrf_token]")?.value;
    if (!link || !token || event.ctrlKey || event.metaKey || event.shiftKey) return;
    event.preventDefault();
    open(link, token);
  });
})();
