"""A metric over two parameters: the mean of each cell, with its runs and failures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Axis, Cells, Chart
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import value_words
from slamhive.analysis.report import PlotResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import Column, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction

MOST_VALUES = 60


class HeatmapOptions(base.PlotOptions):
    """``x`` and ``y`` are parameters or facts with few values."""

    x: str = Field(description="Parameter on the x axis.")
    y: str = Field(description="Parameter on the y axis.")
    metric: str = Field(default="ate.rmse", description="Metric to average in each cell.")


class Heatmap(base.PlotType[HeatmapOptions]):
    """The plot type ``heatmap``."""

    key = "heatmap"
    title = "Heat map"
    description = "The mean of a metric over two parameters, one map per algorithm, with failures in each cell."
    options = HeatmapOptions
    column_options = ("x", "y", "metric")

    def build(self, data: base.PlotData, options: HeatmapOptions) -> PlotResult:
        """One plot per algorithm, a table of cells, the raw data."""
        table = data.table.require_runs()
        if options.x == options.y:
            raise InvalidInput(f"x and y are both {options.x!r}", "choose two different parameters")
        x, y, metric = table.column(options.x), table.column(options.y), table.numeric(options.metric, "a mean")
        protocol = table.one_protocol([options.x, options.y, options.metric])
        if len(table.good()):
            base.with_values(table, [metric.key])
        x_values, y_values = (distinct_values(table.frame[key], key) for key in (options.x, options.y))
        parts = _parts(table, (options.x, options.y))
        maps = [_cells(part, options, (x_values, y_values)) for part in parts.values()]
        values = np.concatenate([cells.values.ravel() for cells in maps])
        finite = values[np.isfinite(values)]
        span = (float(finite.min()), float(finite.max())) if len(finite) else None
        maps = [replace(cells, log=base.spans_decades(values), span=span) for cells in maps]
        charts = [
            Chart(
                key="_".join(filter(None, ("heatmap", algorithm))),
                title=", ".join(filter(None, (options.title or metric.label, algorithm))),
                x=_axis(x, x_values),
                y=_axis(y, y_values),
                marks=(cells,),
                caption=base.caption(part, len(part.good().dropna(subset=[metric.key])), protocol, _CELL),
            )
            for (algorithm, part), cells in zip(parts.items(), maps, strict=True)
        ]
        tables = (
            base.summary_table("heatmap", table, [metric.key], ["algorithm", options.x, options.y]),
            base.raw_table("heatmap_raw", table, [options.x, options.y, metric.key]),
        )
        return base.result_of(table, protocol, charts, tables, lacking=[options.x, options.y, metric.key])


def _parts(table: RunTable, axes: tuple[str, str]) -> dict[str, RunTable]:
    """The runs of each map by algorithm; a single map called "" if an axis shows the algorithms."""
    if "algorithm" in axes:
        return {"": table}
    return {str(algorithm): table.with_rows(rows) for algorithm, rows in table.frame.groupby("algorithm", sort=True)}


_CELL = (
    "Cells: mean over runs, and how many failed, if any; empty: not run, or all failed. The maps of all algorithms "
    "share one colour scale."
)


def distinct_values(values: pd.Series, key: str) -> list[object]:
    """The values of a column in order; raises InvalidInput if there are none or too many."""
    found = sorted(values.dropna().unique(), key=lambda value: (isinstance(value, str), value))
    if not found:
        raise InvalidInput(f"no selected run has a value of {key!r}", "choose a parameter that the runs have")
    if len(found) > MOST_VALUES:
        raise InvalidInput(
            f"{key!r} has {len(found)} values, a map shows at most {MOST_VALUES}",
            "choose a parameter, or use a scatter",
        )
    return found


def _axis(column: Column, values: list[object]) -> Axis:
    return Axis(column.label, column.unit, categories=tuple(value_words(value) for value in values))


def _cells(table: RunTable, options: HeatmapOptions, values: tuple[list[object], list[object]]) -> Cells:
    column = table.column(options.metric)
    x_values, y_values = values
    means = np.full((len(y_values), len(x_values)), np.nan)
    texts = [["" for _ in x_values] for _ in y_values]
    positions = [{value: place for place, value in enumerate(entries)} for entries in values]
    for (x, y), rows in table.frame.groupby([options.x, options.y], sort=False):
        failed = base.failed_count(rows)
        summary = summarise(base.good_values(rows, options.metric))
        row, place = positions[1][y], positions[0][x]
        parts = [] if summary is None else [f"{summary.mean:#.3g}".rstrip(".")]
        if failed:
            parts.append(f"{failed} of {len(rows)} failed")
        texts[row][place] = "\n".join(parts)
        means[row, place] = np.nan if summary is None else summary.mean
    return Cells(
        values=means,
        texts=tuple(tuple(row) for row in texts),
        label=f"{column.label}, mean",
        unit=column.unit,
        lower_is_better=column.direction is not Direction.HIGHER,
    )
