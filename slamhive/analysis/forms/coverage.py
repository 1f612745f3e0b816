"""Accuracy-coverage curve: the share of all runs, failed ones included, whose error is below each bound."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Array, Axis, Chart, Line
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    caption,
    number_column,
    raw_table,
    require_runs,
    result_of,
    spans_decades,
    with_values,
)
from slamhive.analysis.result import Cell, FormResult, ResultTable, TableColumn
from slamhive.analysis.table import FAILED, RunTable
from slamhive.domain.metrics import Direction
from slamhive.errors import InvalidInput

_QUANTILES = (0.25, 0.5, 0.75, 0.9)


class CoverageOptions(FormOptions):
    """``metric`` is an error: less is better."""

    metric: str = Field(default="ate.rmse", description="The error that is bounded.")


class Coverage(Form[CoverageOptions]):
    """The plot type ``coverage``."""

    key = "coverage"
    title = "Accuracy and coverage"
    description = "Share of all runs whose error is below each bound; failed runs never are, so no failure flatters."
    options = CoverageOptions

    def needs(self, options: CoverageOptions) -> frozenset[str]:
        """The metric."""
        return frozenset({options.metric})

    def build(self, data: FormData, options: CoverageOptions) -> FormResult:
        """One curve for each algorithm, the bounds that given shares of runs keep, the raw data."""
        table = data.table
        require_runs(table)
        column = table.numeric(options.metric, "a bound")
        if column.direction is not Direction.LOWER:
            raise InvalidInput(f"{column.key!r} is no error", "choose a metric of which less is better")
        protocol = table.one_protocol([column.key])
        shown = number_column(with_values(table, [column.key]), column.key)
        chart = Chart(
            key=f"coverage_{column.key}",
            title=options.title or f"Share of runs below a bound of {column.label}",
            x=Axis(f"bound of {column.label}", column.unit, spans_decades(shown)),
            y=Axis("runs below", "%"),
            marks=tuple(_curves(table, column.key)),
            caption=caption(table, int(np.isfinite(shown).sum()), protocol, "Shares are of all runs, failed included."),
        )
        tables = (_bounds(table, column.key), raw_table("coverage_raw", table, [column.key]))
        return result_of(table, protocol, (chart,), tables, lacking=[column.key])


def _curves(table: RunTable, key: str) -> Iterator[Line]:
    """Each from nothing at the least error of all on, to the same bound beyond the largest."""
    everything = _errors(table.frame, key)
    if not len(everything):
        return
    first, last = everything[0], everything[-1] * 1.05
    for algorithm, rows in table.frame.groupby("algorithm", sort=True):
        values = _errors(rows, key)
        shares = 100 * np.arange(len(values) + 1) / len(rows)
        name = f"{algorithm} ({len(values)} of {len(rows)})"
        places = np.concatenate([[first], values, [last]])
        heights = np.concatenate([shares, shares[-1:]])
        yield Line(name, places, heights, colour=table.colours[str(algorithm)], steps=True)


def _errors(rows: pd.DataFrame, key: str) -> Array:
    frame = rows[rows[FAILED].isna()]
    values = number_column(frame, key)
    return np.sort(values[np.isfinite(values)])


def _bounds(table: RunTable, key: str) -> ResultTable:
    column = table.column(key)
    columns = [TableColumn("algorithm", "Algorithm"), TableColumn("runs", "Runs"), TableColumn("failed", "Failed")]
    columns += [TableColumn(f"q{share:g}", f"{100 * share:g} % of runs below", column.unit) for share in _QUANTILES]
    rows: list[tuple[Cell, ...]] = []
    for algorithm, group in table.frame.groupby("algorithm", sort=True):
        values = _errors(group, key)
        places = [int(np.ceil(share * len(group))) - 1 for share in _QUANTILES]
        bounds = [float(values[place]) if place < len(values) else None for place in places]
        rows.append((str(algorithm), len(group), int(group[FAILED].notna().sum()), *bounds))
    note = "None is given where so many runs failed that no bound keeps that share."
    return ResultTable("coverage", "Bounds", tuple(columns), tuple(rows), note)


FORMS.register(Coverage.key, Coverage())
