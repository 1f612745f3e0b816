"""A metric over two parameters: the mean of each cell, with the runs and failures that it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Axis, Cells, Chart
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
    summary_table,
    with_values,
)
from slamhive.analysis.forms.places import value_words
from slamhive.analysis.result import FormResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import FAILED, Column, RunTable
from slamhive.domain.metrics import Direction
from slamhive.errors import InvalidInput

MOST_VALUES = 60


class HeatmapOptions(FormOptions):
    """``x`` and ``y`` are parameters or facts with few values."""

    x: str = Field(description="Parameter across.")
    y: str = Field(description="Parameter upwards.")
    metric: str = Field(default="ate.rmse", description="What is averaged in each cell.")


class Heatmap(Form[HeatmapOptions]):
    """The plot type ``heatmap``."""

    key = "heatmap"
    title = "Heat map"
    description = "The mean of a metric over two parameters, one map for each algorithm, failures in each cell."
    options = HeatmapOptions

    def needs(self, options: HeatmapOptions) -> frozenset[str]:
        """Both parameters and the metric."""
        return frozenset({options.x, options.y, options.metric})

    def build(self, data: FormData, options: HeatmapOptions) -> FormResult:
        """One plot for each algorithm, the table of cells, the raw data."""
        table = data.table
        require_runs(table)
        if options.x == options.y:
            raise InvalidInput(f"x and y are both {options.x!r}", "choose two different parameters")
        x, y, metric = table.column(options.x), table.column(options.y), table.numeric(options.metric, "a mean")
        protocol = table.one_protocol([options.x, options.y, options.metric])
        if len(table.good()):
            with_values(table, [metric.key])
        x_values, y_values = (distinct_values(table.frame[key], key) for key in (options.x, options.y))
        parts = _parts(table, (options.x, options.y))
        maps = _on_one_scale([_cells(part, options, (x_values, y_values)) for part in parts.values()])
        charts = [
            Chart(
                key="_".join(filter(None, ("heatmap", algorithm))),
                title=", ".join(filter(None, (options.title or metric.label, algorithm))),
                x=_axis(x, x_values),
                y=_axis(y, y_values),
                marks=(cells,),
                caption=caption(part, len(part.good().dropna(subset=[metric.key])), protocol, _CELL),
            )
            for (algorithm, part), cells in zip(parts.items(), maps, strict=True)
        ]
        tables = (
            summary_table("heatmap", table, [metric.key], ["algorithm", options.x, options.y]),
            raw_table("heatmap_raw", table, [options.x, options.y, metric.key]),
        )
        return result_of(table, protocol, charts, tables, lacking=[options.x, options.y, metric.key])


def _parts(table: RunTable, axes: tuple[str, str]) -> dict[str, RunTable]:
    """The runs of each map, by algorithm; one map of all, called "", where the algorithms are an axis themselves."""
    if "algorithm" in axes:
        return {"": table}
    return {str(algorithm): table.with_rows(rows) for algorithm, rows in table.frame.groupby("algorithm", sort=True)}


_CELL = (
    "Cells: mean over runs, then failed of all runs where any failed; empty: not run, or all failed. The maps of all "
    "algorithms share one scale of colours."
)


def distinct_values(values: pd.Series, key: str) -> list[object]:
    """The values of a column in order; raises InvalidInput for more than can be told apart, and for none."""
    found = sorted(values.dropna().unique(), key=lambda value: (isinstance(value, str), value))
    if not found:
        raise InvalidInput(f"no selected run has a value of {key!r}", "choose a parameter that they have")
    if len(found) > MOST_VALUES:
        raise InvalidInput(
            f"{key!r} has {len(found)} values, {MOST_VALUES} can be told apart", "choose a parameter, or use a scatter"
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
        failed = int(rows[FAILED].notna().sum())
        summary = summarise(number_column(rows[rows[FAILED].isna()], options.metric))
        row, place = positions[1][y], positions[0][x]
        parts = [] if summary is None else [f"{summary.mean:.3g}"]
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


def _on_one_scale(maps: list[Cells]) -> list[Cells]:
    """The maps with colours that mean the same in each."""
    values = np.concatenate([cells.values.ravel() for cells in maps])
    finite = values[np.isfinite(values)]
    span = (float(finite.min()), float(finite.max())) if len(finite) else None
    return [replace(cells, log=spans_decades(values), span=span) for cells in maps]


FORMS.register(Heatmap.key, Heatmap())
