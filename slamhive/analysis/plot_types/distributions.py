"""The distribution of metrics over runs: a box with points for each algorithm and dataset."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, Axis, Boxes, Chart, FailedRuns, Line, Mark, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import disturbed_rings, failed_marks
from slamhive.analysis.report import PlotResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable
from slamhive.base.errors import InvalidInput


class DistributionsOptions(base.PlotOptions):
    """Each of ``metrics`` gets its own plot."""

    metrics: list[str] = Field(
        default_factory=lambda: ["ate.rmse", "rpe.rmse"], min_length=1, max_length=20, description="Metrics to show."
    )
    by: base.GroupKey = "dataset"


class Distributions(base.PlotType[DistributionsOptions]):
    """The plot type ``distributions``."""

    key = "distributions"
    title = "Distributions over runs"
    description = "The values of all runs as boxes with points, for each algorithm and dataset, or another group."
    options = DistributionsOptions
    column_options = ("metrics",)

    def build(self, data: base.PlotData, options: DistributionsOptions) -> PlotResult:
        """A plot for each metric, a summary, the raw data."""
        table = data.table.require_runs().grouped_by(options.by)
        for key in options.metrics:
            table.numeric(key, "a distribution")
        protocol = table.one_protocol(options.metrics)
        charts = [_chart(table, key, protocol, options) for key in options.metrics]
        tables = (
            base.summary_table("distributions", table, options.metrics, ["algorithm", options.by]),
            base.raw_table("distributions_raw", table, options.metrics),
        )
        return base.result_of(table, protocol, charts, tables, lacking=options.metrics)


def _chart(table: RunTable, key: str, protocol: str | None, options: DistributionsOptions) -> Chart:
    column = table.column(key)
    shown = base.with_values(table, [key])
    x = Axis(table.column(options.by).label, table.column(options.by).unit, categories=table.groups(options.by))
    marks: list[Mark] = []
    for algorithm, rows in table.good().dropna(subset=[key]).groupby("algorithm", sort=True):
        marks.append(
            Boxes(
                name=str(algorithm),
                categories=tuple(rows[options.by]),
                values=base.number_column(rows, key),
                runs=rows["run_id"].to_numpy(dtype=int),
                colour=table.colours[str(algorithm)],
            )
        )
    marks.extend(failed_marks(table, x, options.by))
    return Chart(
        key=f"distribution_{key}",
        title=options.title or f"{column.label} over runs",
        x=x,
        y=Axis(column.label, column.unit, log=base.spans_decades(base.number_column(shown, key))),
        marks=tuple(marks),
        caption=base.caption(
            table, len(shown), protocol, "Boxes: quartiles; whiskers: up to 1.5 times the interquartile range."
        ),
    )


# Repeatability: all runs of one configuration, and how much their metrics differ.


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
        charts = [_repeatability_chart(table, key, protocol, options.title) for key in options.metrics]
        tables = (
            base.summary_table("repeatability", table, options.metrics, ["algorithm", "dataset"]),
            base.raw_table("repeatability_raw", table, ["seed", *options.metrics]),
        )
        return base.result_of(table, protocol, charts, tables, lacking=options.metrics)


def _repeatability_chart(table: RunTable, key: str, protocol: str | None, title: str | None) -> Chart:
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
