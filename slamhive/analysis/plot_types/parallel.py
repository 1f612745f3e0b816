"""Parallel coordinates: one line per run through its parameters and metrics."""

from __future__ import annotations

import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Axis, Chart, Dimension, Parallel
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import places_on, value_words
from slamhive.analysis.report import PlotResult
from slamhive.analysis.table import Column
from slamhive.base.errors import InvalidInput

MOST_LINES = 20_000
MOST_PARAMETERS = 10


class ParallelOptions(base.PlotOptions):
    """``dimensions`` default to algorithm, dataset and parameters that vary."""

    dimensions: list[str] = Field(default_factory=list, max_length=15, description="Axes from left to right.")
    metric: str = Field(default="ate.rmse", description="Metric of the last axis and of the colour.")


class ParallelCoordinates(base.PlotType[ParallelOptions]):
    """The plot type ``parallel``."""

    key = "parallel"
    title = "Parallel coordinates"
    description = "Each run as a line through its parameters and a metric; select ranges on each axis."
    options = ParallelOptions
    column_options = ("dimensions", "metric")

    def build(self, data: base.PlotData, options: ParallelOptions) -> PlotResult:
        """One plot and its raw data."""
        table = data.table.require_runs()
        metric = table.numeric(options.metric, "the colour")
        # Without a choice: the first parameters that vary, and the algorithm if nothing does.
        names = [name for name in ("algorithm", "dataset") if table.frame[name].nunique() > 1]
        keys = options.dimensions or (
            [*names, *(column.key for column in table.varied()[:MOST_PARAMETERS])] or ["algorithm"]
        )
        columns = [table.column(key) for key in keys if key != metric.key]
        protocol = table.one_protocol([column.key for column in (*columns, metric)])
        shown = base.with_values(table, [metric.key])
        if len(shown) > MOST_LINES:
            raise InvalidInput(f"{len(shown)} lines are too many to read", f"select at most {MOST_LINES} runs")
        shades = base.number_column(shown, metric.key)
        marks = Parallel(
            dimensions=(*(_dimension(column, shown) for column in columns), _dimension(metric, shown)),
            shades=shades,
            shade_axis=Axis(metric.label, metric.unit, log=base.spans_decades(shades)),
            runs=shown["run_id"].to_numpy(dtype=int),
        )
        chart = Chart(
            key=f"parallel_{metric.key}",
            title=options.title or f"{metric.label} and what it may depend on",
            x=Axis(""),
            y=Axis(""),
            marks=(marks,),
            caption=base.caption(table, len(shown), protocol, "Failed runs have no line."),
            height=1.1,
        )
        raw = base.raw_table("parallel_raw", table, [*keys, metric.key])
        return base.result_of(table, protocol, (chart,), (raw,), lacking=[metric.key])


def _dimension(column: Column, shown: pd.DataFrame) -> Dimension:
    """Numbers as they are; text, and numbers that some runs lack, as categories with "none" among them."""
    if column.numeric and shown[column.key].notna().all():
        return Dimension(Axis(column.label, column.unit), base.number_column(shown, column.key))
    words = shown[column.key].map(lambda value: "none" if pd.isna(value) else value_words(value))
    order = sorted(set(words), key=lambda word: (word != "none", _number(word), word))
    axis = Axis(column.label, column.unit, categories=tuple(order))
    return Dimension(axis, places_on(axis, words))


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        return 0.0
