"""Write tables of analyses as CSV, Parquet, LaTeX and Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from importlib.util import find_spec

import pandas as pd

from slamhive.analysis.result import Cell, ResultTable
from slamhive.domain.latex import latex
from slamhive.errors import Unavailable
from slamhive.services.exports import safe_cell
from slamhive.services.markdown_table import numeric_columns, ranked, table_markdown

LATEX_ROWS = 500
"""Most rows of a printed table; the CSV file has all rows."""

WITHOUT_PARQUET = "Parquet needs pyarrow, which is not installed"
PARQUET_REMEDY = "pip install slamhive[parquet]"

_LATEX_RANKS: Mapping[int | None, str] = {1: r"\textbf{%s}", 2: r"\underline{%s}"}


RAW_ENDINGS = ("csv", "parquet")
ENDINGS = (*RAW_ENDINGS, "tex", "md")
"""File formats of tables; raw data has the first two."""


def endings_of(table: ResultTable) -> tuple[str, ...]:
    """The file formats of a table."""
    return RAW_ENDINGS if table.raw else ENDINGS


def table_file(table: ResultTable, ending: str) -> bytes:
    """The table in the format ``ending``, one of :data:`ENDINGS`; raises Unavailable for Parquet without pyarrow."""
    if ending == "parquet":
        return table_parquet(table)
    return {"csv": table_csv, "tex": table_latex, "md": table_markdown}[ending](table).encode()


def table_csv(table: ResultTable) -> str:
    """Comma-separated text with units in the heading; spreadsheets take no cell for a formula."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([safe_cell(column.heading) for column in table.columns])
    for row in table.rows:
        writer.writerow(["" if value is None else safe_cell(value) for value in row])
    return text.getvalue()


def parquet_there() -> bool:
    """Whether pyarrow is installed, which writes Parquet files."""
    return find_spec("pyarrow") is not None


def table_parquet(table: ResultTable) -> bytes:
    """A Parquet file; raises Unavailable without pyarrow."""
    frame = pd.DataFrame(list(table.rows), columns=[column.key for column in table.columns])
    for name in frame.columns:
        if any(isinstance(value, str) for value in frame[name]):  # a column of Parquet has one type
            frame[name] = frame[name].map(lambda value: None if pd.isna(value) else str(value))
    buffer = io.BytesIO()
    try:
        frame.to_parquet(buffer, engine="pyarrow", index=False)
    except ImportError:
        raise Unavailable(WITHOUT_PARQUET, PARQUET_REMEDY) from None
    return buffer.getvalue()


def table_latex(table: ResultTable) -> str:
    """A ``tabular`` with booktabs rules, escaped text, numbers with four significant digits, and the caption below."""
    numeric = numeric_columns(table)
    lines = [
        f"% {_comment(table.title)}",
        r"% \usepackage{booktabs}",
        f"\\begin{{tabular}}{{{''.join('r' if number else 'l' for number in numeric)}}}",
        r"\toprule",
        " & ".join(latex(column.heading) for column in table.columns) + r" \\",
        r"\midrule",
    ]
    for place, row in enumerate(table.rows[:LATEX_ROWS]):
        cells = (ranked(_latex_cell(cell), table.rank(place, at), _LATEX_RANKS) for at, cell in enumerate(row))
        lines.append(" & ".join(cells) + r" \\")
    if len(table.rows) > LATEX_ROWS:
        lines.append(f"% {len(table.rows) - LATEX_ROWS} more rows are in the CSV file")
    lines += [r"\bottomrule", r"\end{tabular}"]
    if table.caption:
        lines += ["", r"\smallskip", rf"\parbox{{\linewidth}}{{\footnotesize {latex(table.caption)}}}"]
    return "\n".join([*lines, ""])


def _latex_cell(cell: Cell) -> str:
    if cell is None:
        return "--"
    if isinstance(cell, float):
        return f"{cell:.4g}"
    return latex(str(cell))


def _comment(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)
