"""Accuracy-coverage curve: the share of all runs, failed ones included, with an error below each bound."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from slamhive.analysis.chart import Axis, Chart, Line
from slamhive.analysis.plot_types import base
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import RunTable
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import explained
from slamhive.domain.metrics import Direction

_QUANTILES = (0.25, 0.5, 0.75, 0.9)


class CoverageOptions(base.PlotOptions):
    """``metric`` must be an error, where lower is better."""

    metric: str = Field(default="ate.rmse", description="The error that is bounded.")


class Coverage(base.PlotType[CoverageOptions]):
    """The plot type ``coverage``."""

    key = "coverage"
    title = "Accuracy and coverage"
    description = "Share of all runs with an error below each bound. A failed run is below no bound."
    options = CoverageOptions
    column_options = ("metric",)

    def build(self, data: base.PlotData, options: CoverageOptions) -> PlotResult:
        """One curve per algorithm, a table of the bounds that given shares of the runs keep, the raw data."""
        table = data.table.require_runs()
        column = table.numeric(options.metric, "a bound")
        if column.direction is not Direction.LOWER:
            raise InvalidInput(f"{column.key!r} is not an error", "choose a metric where lower is better")
        protocol = table.one_protocol([column.key])
        shown = base.number_column(base.with_values(table, [column.key]), column.key)
        chart = Chart(
            key=f"coverage_{column.key}",
            title=options.title or f"Share of runs below a bound of {column.label}",
            x=Axis(f"bound of {column.label}", column.unit, base.spans_decades(shown)),
            y=Axis("runs below", "%"),
            marks=tuple(_curves(table, column.key)),
            caption=base.caption(
                table, int(np.isfinite(shown).sum()), protocol, "Shares are of all runs, failed included."
            ),
        )
        tables = (_bounds(table, column.key), base.raw_table("coverage_raw", table, [column.key]))
        return base.result_of(table, protocol, (chart,), tables, lacking=[column.key])


def _curves(table: RunTable, key: str) -> Iterator[Line]:
    """All curves begin at the lowest error of all runs and end beyond the highest."""
    everything = np.sort(base.good_values(table.frame, key))
    if not len(everything):
        return
    first, last = everything[0], everything[-1] * 1.05
    for algorithm, rows in table.frame.groupby("algorithm", sort=True):
        values = np.sort(base.good_values(rows, key))
        shares = 100 * np.arange(len(values) + 1) / len(rows)
        name = f"{algorithm} ({len(values)} of {len(rows)})"
        places = np.concatenate([[first], values, [last]])
        heights = np.concatenate([shares, shares[-1:]])
        yield Line(name, places, heights, colour=table.colours[str(algorithm)], steps=True)


def _bounds(table: RunTable, key: str) -> ResultTable:
    column = table.column(key)
    columns = [TableColumn("algorithm", "Algorithm"), TableColumn("runs", "Runs"), TableColumn("failed", "Failed")]
    columns += [TableColumn(f"q{share:g}", f"{100 * share:g} % of runs below", column.unit) for share in _QUANTILES]
    rows: list[tuple[Cell, ...]] = []
    for algorithm, group in table.frame.groupby("algorithm", sort=True):
        values = np.sort(base.good_values(group, key))
        places = [int(np.ceil(share * len(group))) - 1 for share in _QUANTILES]
        bounds = [float(values[place]) if place < len(values) else None for place in places]
        rows.append((str(algorithm), len(group), base.failed_count(group), *bounds))
    note = "A cell is empty if so many runs failed that no bound keeps that share."
    return ResultTable("coverage", "Bounds", tuple(columns), tuple(rows), note)


# Errors scaled up for runs that cover little of their sequence, as in the extended scatter plots of the paper.


Share = Annotated[float, Field(ge=0, le=1)]
Multiple = Annotated[float, Field(ge=1, le=1000)]


class CoverageScaleOptions(base.PlotOptions):
    """``coverage_multiples[k]`` applies from ``coverage_thresholds[k]`` up, the last one below all thresholds."""

    coverage_thresholds: list[Share] = Field(
        default_factory=list, max_length=20, description="Descending: 0.75, 0.5 ..."
    )
    coverage_multiples: list[Multiple] = Field(default_factory=list, max_length=21, description="1, 2, 2.5 ...")

    @model_validator(mode="after")
    def _matching(self) -> CoverageScaleOptions:
        thresholds, multiples = self.coverage_thresholds, self.coverage_multiples
        if (thresholds or multiples) and len(multiples) != len(thresholds) + 1:
            found = f"{len(thresholds)} thresholds and {len(multiples)} multiples"
            raise explained(InvalidInput(f"there must be one more multiple than thresholds, found {found}"))
        if sorted(thresholds, reverse=True) != thresholds:
            raise explained(InvalidInput(f"coverage_thresholds must descend, found {thresholds}"))
        return self

    @property
    def scaled(self) -> bool:
        """True if errors are scaled."""
        return bool(self.coverage_multiples)


def scaled_by_coverage(table: RunTable, keys: list[str], options: CoverageScaleOptions) -> tuple[RunTable, str]:
    """The table with errors among ``keys`` scaled by the tracked fraction, and a sentence for the caption."""
    errors = [
        key for key in keys if table.column(key).needs_protocol and table.column(key).direction is Direction.LOWER
    ]
    if not options.scaled or not errors:
        return table, ""
    covered = base.number_column(table.frame, "tracked_fraction")
    steps = np.array(options.coverage_thresholds[::-1])
    multiples = np.array(options.coverage_multiples[::-1])
    factor = multiples[np.searchsorted(steps, np.nan_to_num(covered), side="right")]
    frame = table.frame.assign(**{key: base.number_column(table.frame, key) * factor for key in errors})
    pairs = zip([*options.coverage_thresholds, 0], options.coverage_multiples, strict=True)
    words = ", ".join(f"{multiple:g} from {100 * threshold:g} %" for threshold, multiple in pairs)
    return table.with_rows(frame), f"{', '.join(errors)} multiplied by the share tracked: {words}."
