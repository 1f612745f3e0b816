"""The report of an experiment as a table: one row for each cell and protocol."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from slamhive.domain.parameters import Value
from slamhive.services.experiments.status import METRICS
from slamhive.services.experiments.views import Cell, CellFigures, Phase

NO_FIGURES = CellFigures(None, 0, 0, {})
_HEAD = ("cell", "name")
_COUNTS = ("runs", "good", "failed", "failures", "protocol", "evaluated", "disturbed")


def csv_text(cells: Iterable[Cell], axes: Sequence[str]) -> str:
    """The whole report as CSV: exact values in stored units, missing values empty."""
    stream = io.StringIO()
    writer = csv.writer(stream)
    figures = [column for key in METRICS for column in (f"{key}.mean", f"{key}.std", f"{key}.n", f"{key}.median")]
    writer.writerow([*_HEAD, *axes, *_COUNTS, *figures])
    for cell in cells:
        for row in csv_rows(cell, axes):
            writer.writerow(row)
    return stream.getvalue()


def csv_rows(cell: Cell, axes: Sequence[str]) -> Iterator[list[Any]]:
    """One row for each protocol under which runs of the cell were evaluated."""
    for figures in cell.figures or (NO_FIGURES,):
        row: list[Any] = [cell.number, cell.name, *(_text(cell.values.get(axis)) for axis in axes)]
        row += [len(cell.runs), cell.counts[Phase.GOOD], sum(cell.failures.values()), failures_text(cell)]
        row += [figures.protocol, figures.runs, figures.disturbed]
        for key in METRICS:
            found = figures.metrics.get(key)
            row += [None, None, 0, None] if found is None else [found.mean, found.std, found.n, found.median]
        yield row


def failures_text(cell: Cell) -> str | None:
    """``timeout 2, lost 1``, None without failures."""
    return ", ".join(f"{reason.value} {count}" for reason, count in cell.failures.items()) or None


def varying(axes: dict[str, tuple[Value, ...]]) -> list[str]:
    """The axes with more than one value."""
    return [axis for axis, values in axes.items() if len(values) > 1]


def _text(value: Value | None) -> Any:
    return " ".join(map(str, value)) if isinstance(value, tuple) else value
