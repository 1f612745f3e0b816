"""Repeatability: all runs of one configuration, their metrics and how much they differ."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, Axis, Chart, FailedRuns, Line, Mark, Points
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    caption,
    number_column,
    one_value,
    raw_table,
    require_runs,
    result_of,
    summary_table,
    with_values,
)
from slamhive.analysis.forms.places import disturbed_rings
from slamhive.analysis.result import FormResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput

_TICK_LABELS = 30


class RepeatabilityOptions(FormOptions):
    """``metrics`` each get a plot."""

    metrics: list[str] = Field(
        default_factory=lambda: ["ate.rmse"], min_length=1, max_length=20, description="What is shown."
    )


class Repeatability(Form[RepeatabilityOptions]):
    """The plot type ``repeatability``."""

    key = "repeatability"
    title = "Repeatability"
    description = "Every repeat of one configuration with the mean, its interval and the spread."
    options = RepeatabilityOptions

    def needs(self, options: RepeatabilityOptions) -> frozenset[str]:
        """The metrics."""
        return frozenset(options.metrics)

    def build(self, data: FormData, options: RepeatabilityOptions) -> FormResult:
        """A plot for each metric, the summary, the raw data."""
        table = data.table
        require_runs(table)
        one_value(table, "configuration_id", "repeatability")
        if len(table.frame) < 2:
            raise InvalidInput("repeatability needs two runs of the configuration, found 1", "add repeats")
        for key in options.metrics:
            table.numeric(key, "repeatability")
        protocol = table.one_protocol(options.metrics)
        charts = [_chart(table, key, protocol, options.title) for key in options.metrics]
        tables = (
            summary_table("repeatability", table, options.metrics, ["algorithm", "dataset"]),
            raw_table("repeatability_raw", table, ["seed", *options.metrics]),
        )
        return result_of(table, protocol, charts, tables, lacking=options.metrics)


def _chart(table: RunTable, key: str, protocol: str | None, title: str | None) -> Chart:
    column = table.column(key)
    shown = with_values(table, [key])
    failed = table.failed()
    order = {int(run): float(place) for place, run in enumerate(table.frame["run_id"])}
    colour = table.colours[str(table.frame["algorithm"].iloc[0])]
    runs = shown["run_id"].to_numpy(dtype=int)
    values = number_column(shown, key)
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
        caption=caption(table, len(shown), protocol, more),
    )


def _numbers(count: int) -> tuple[str, ...]:
    """1 to ``count``, no more of them in words than there is room for."""
    every = -(-count // _TICK_LABELS)
    return tuple(str(place) if (place - 1) % every == 0 else "" for place in range(1, count + 1))


FORMS.register(Repeatability.key, Repeatability())
