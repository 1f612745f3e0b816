"""Write tables and text as Markdown."""

from __future__ import annotations

import re

from slamhive.analysis.result import Cell, ResultTable


def table_markdown(table: ResultTable) -> str:
    """A table of GitHub's Markdown with escaped text, numbers with four significant digits, and the caption below."""
    rules = ["---:" if number else "---" for number in numeric_columns(table)]
    rows = [
        [escaped(column.heading) for column in table.columns],
        rules,
        *([escaped(_cell_text(cell)) for cell in row] for row in table.rows),
    ]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([*lines, *(["", escaped(table.caption)] if table.caption else []), ""])


def numeric_columns(table: ResultTable) -> list[bool]:
    """Which columns hold numbers alone."""
    return [
        all(isinstance(row[place], int | float | None) for row in table.rows) for place in range(len(table.columns))
    ]


def _cell_text(cell: Cell) -> str:
    return "–" if cell is None else f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def escaped(text: str) -> str:
    """Text escaped for Markdown: neither HTML nor a new cell, line or link."""
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"([\\`*_{}\[\]<>|])", r"\\\1", plain)
