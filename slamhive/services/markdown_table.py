"""Write tables and text as Markdown."""

from __future__ import annotations

import re
from collections.abc import Mapping

from slamhive.analysis.result import Cell, ResultTable

_RANKS: Mapping[int | None, str] = {1: "**%s**", 2: "<ins>%s</ins>"}


def table_markdown(table: ResultTable) -> str:
    """A table of GitHub's Markdown with escaped text, numbers with four significant digits, and the caption below."""
    rules = ["---:" if number else "---" for number in numeric_columns(table)]
    rows = [
        [escaped(column.heading) for column in table.columns],
        rules,
        *(
            [ranked(escaped(_cell_text(cell)), table.rank(place, at), _RANKS) for at, cell in enumerate(row)]
            for place, row in enumerate(table.rows)
        ),
    ]
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([*lines, *(["", escaped(table.caption)] if table.caption else []), ""])


def numeric_columns(table: ResultTable) -> list[bool]:
    """Which columns hold numbers, or texts that are numbers."""
    return [table.is_number(place) for place in range(len(table.columns))]


def ranked(text: str, rank: int | None, styles: Mapping[int | None, str]) -> str:
    """``text`` as values of this rank are printed; ``styles`` contains ``%s`` for the text."""
    return styles[rank] % text if rank in styles else text


def _cell_text(cell: Cell) -> str:
    return "–" if cell is None else f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def escaped(text: str) -> str:
    """Text escaped for Markdown: neither HTML nor a new cell, line or link."""
    plain = "".join(letter if letter.isprintable() else " " for letter in text)
    return re.sub(r"([\\`*_{}\[\]<>|])", r"\\\1", plain)
