"""Repeatability: all runs of one configuration, and how much their metrics differ."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, Axis, Chart, FailedRuns, Line, Mark, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.places import disturbed_rings
from slamhive.analysis.result import PlotResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput

_TICK_LABELS = 30


class RepeatabilityOptions(base.PlotOptions):
    """Each of ``metrics`` gets its own plot."""

    metrics: list[str] = Field(
        default_factory=lambda: ["ate.rmse"], min_length=1, max_length=20, description="Metrics to show."
    )


class Repeatability(base.PlotType[RepeatabilityOptions]):
    """The plot type ``repeatability``."""

    key = "repeatability"
    title = "Repeatability"
    description = "All repeats of one configuration with the mean, its interval and the spread."
    options = RepeatabilityOptions
    column_options = ("metrics",)

    def build(self, data: base.PlotData, options: RepeatabilityOptions) -> PlotResult:
        """A plot for each metric, a summary, the raw data."""
        table = data.table.require_runs()
        base.one_value(table, "configuration_id", "repeatability")
        if len(table.frame) < 2:
            raise InvalidInput("repeatability needs two runs of the configuration, found 1", "add repeats")
        for key in options.metrics:
            table.numeric(key, "repeatability")
        protocol = table.one_protocol(options.metrics)
        charts = [_chart(table, key, protocol, options.title) for key in options.metrics]
        tables = (
            base.summary_table("repeatability", table, options.metrics, ["algorithm", "dataset"]),
            base.raw_table("repeatability_raw", table, ["seed", *options.metrics]),
        )
        return base.result_of(table, protocol, charts, tables, lacking=options.metrics)


def _chart(table: RunTable, key: str, protocol: str | None, title: str | None) -> Chart:
    column = table.column(key)
    shown = base.with_values(table, [key])
    failed = table.failed()
    order = {int(run): float(place) for place, run in enumerate(table.frame["run_id"])}
    colour = table.colours[str(table.frame["algorithm"].iloc[0])]
    runs = shown["run_id"].to_numpy(dtype=int)
    values = base.number_column(shown, key)
    places = np.array([order[run] for run in runs])
    marks: list[Mark] = [Points("runs", places, values, colour=colour, runs=runs)]
    marks += disturbed_rings(shown, places, values)
    summary = summarise(values)
    more = ""
    if summary is not None:
        ends = np.array([0.0, len(order) - 1.0])
        interval = summary.interval
        low, high = (None, None) if interval is None else (np.full(2, interval.low), np.full(2, interval.high))
        marks.append(Line("mean", ends, np.full(2, summary.mean), low=low, high=high, colour=REFERENCE, dashed=True))
        spread = "" if summary.std is None else f", std {summary.std:.3g}"
        relative = "" if not summary.std or not summary.mean else f" ({100 * summary.std / summary.mean:.2g} %)"
        middle = f"median {summary.median:.4g}"
        more = f"Mean {summary.mean:.4g} {column.unit}{spread}{relative}, {middle}; band: 95 % bootstrap interval."
    failed_runs = failed["run_id"].to_numpy(dtype=int)
    marks.append(FailedRuns(np.array([order[run] for run in failed_runs], dtype=float), failed_runs, colour))
    return Chart(
        key=f"repeatability_{key}",
        title=title or f"{column.label} of {len(order)} repeats",
        x=Axis("repeat", categories=_numbers(len(order)), numbered=True),
        y=Axis(column.label, column.unit),
        marks=tuple(marks),
        caption=base.caption(table, len(shown), protocol, more),
    )


def _numbers(count: int) -> tuple[str, ...]:
    """1 to ``count``; only some have a label if there is no room for all."""
    every = -(-count // _TICK_LABELS)
    return tuple(str(place) if (place - 1) % every == 0 else "" for place in range(1, count + 1))
