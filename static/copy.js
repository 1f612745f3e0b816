// Copies the table above a group of buttons as CSV, Markdown or LaTeX, the address of the page, or the text of a button.
"use strict";
(() => {
  const SAID_MS = 2000;

  const textOf = (cell) => cell.innerText.replace(/[▾▴]/g, "").replace(/\s+/g, " ").trim();
  const isNumber = (cell) => cell.classList.contains("number");

  /** The cells of a table, row by row, without those of check boxes and sparklines. */
  function rowsOf(table) {
    return [...table.rows].map((row) => [...row.cells].filter((cell) => !cell.matches(".tick, .spark")));
  }

  /** Numbers in full, as their tooltip has them; commas, quotes and line ends in quotes. */
  function csv(rows) {
    const field = (cell) => {
      const exact = cell.tagName === "TD" && isNumber(cell) && cell.title.match(/^-?\d+(\.\d+)?(e[+-]?\d+)?(?= |$)/i);
      const text = exact ? exact[0] : textOf(cell);
      return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
    };
    return rows.map((row) => row.map(field).join(",")).join("\n");
  }

  function markdown([head, ...body]) {
    const line = (parts) => `| ${parts.join(" | ")} |`;
    const cells = (row) => row.map((cell) => textOf(cell).replaceAll("|", "\\|"));
    return [line(cells(head)), line(head.map((cell) => isNumber(cell) ? "---:" : "---")), ...body.map((row) => line(cells(row)))].join("\n");
  }

  const LATEX = { "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "±": "$\\pm$", "–": "--", "×": "$\\times$", "²": "$^2$", "°": "$^\\circ$", "µ": "$\\mu$" };

  /** The words of a cell without what is written smaller beside them, such as a median. */
  function mainText(cell) {
    const copy = cell.cloneNode(true);
    copy.querySelectorAll("small, svg, .visually-hidden").forEach((part) => part.remove());
    return copy.textContent.replace(/[▾▴]/g, "").replace(/\s+/g, " ").trim();
  }

  function latex([head, ...body], table) {
    const safe = (text) => text.replace(/[\\&%$#_{}~^±–×²°µ]/g, (sign) => LATEX[sign] ?? `\\${sign}`).trim();
    const power = (text) => text.replace(/e([-+]\d+)/g, (_, exponent) => ` \\times 10^{${Number(exponent)}}`);
    const value = (text) => /^-?[\d.,]+ ± [\d.,]+(e-\d+)?$/.test(text) ? `$${power(text.replace("±", "\\pm"))}$` : safe(text);
    const line = (row) => `${row.map((cell) => value(mainText(cell))).join(" & ")} \\\\`;
    const columns = head.map((cell) => isNumber(cell) ? "r" : "l").join("");
    const caption = table.dataset.latexCaption ? [`\\caption{${safe(table.dataset.latexCaption)}}`] : [];
    return [
      "% \\usepackage{booktabs}", "\\begin{table}", "\\centering", ...caption, `\\begin{tabular}{${columns}}`, "\\toprule",
      line(head), "\\midrule", ...body.map(line), "\\bottomrule", "\\end{tabular}", "\\end{table}",
    ].join("\n");
  }

  const KINDS = { csv, markdown, latex };

  /** Pages that are not served from this machine over https have no clipboard, but can copy what is selected. */
  async function copy(text) {
    if (navigator.clipboard) return navigator.clipboard.writeText(text);
    const area = document.createElement("textarea");
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    if (!done) throw new Error("the browser does not allow it");
  }

  document.addEventListener("click", async (event) => {
    const button = event.target.closest("[data-copy-link], [data-copy-text]");
    if (!button) return;
    const words = button.textContent;
    try { await copy(button.dataset.copyText ?? location.href); button.textContent = "Copied"; } catch { button.textContent = "Not copied"; }
    setTimeout(() => { button.textContent = words; }, SAID_MS);
  });

  document.addEventListener("click", async (event) => {
    const button = event.target.closest("[data-copy]");
    if (!button) return;
    event.preventDefault();
    const group = button.closest(".copy");
    const table = group.previousElementSibling.querySelector("table");
    const rows = rowsOf(table);
    const status = group.querySelector("[role=status]");
    try {
      await copy(KINDS[button.dataset.copy](rows, table));
      status.textContent = `Copied ${rows.length - 1} rows.`;
    } catch (error) {
      status.textContent = `Not copied: ${error.message}`;
    }
    setTimeout(() => { status.textContent = ""; }, SAID_MS);
  });
})();
