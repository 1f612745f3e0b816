"""Text escaped for LaTeX."""

from __future__ import annotations

_ESCAPED = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "²": r"\textsuperscript{2}", "°": r"\textdegree{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}", "±": r"$\pm$", '"': "''", "×": r"$\times$",
    "–": "--", "…": r"\ldots{}", "≤": r"$\leq$", "≥": r"$\geq$", "→": r"$\to$", "µ": r"$\mu$", "ω": r"$\omega$",
    "Δ": r"$\Delta$", "·": r"$\cdot$", "★": r"$\star$",
}  # fmt: skip
"""No entry needs a package."""


def latex(text: str) -> str:
    """``text`` as LaTeX prints it: in one line, without commands."""
    return "".join(_ESCAPED.get(letter, letter) if letter.isprintable() else " " for letter in text)
