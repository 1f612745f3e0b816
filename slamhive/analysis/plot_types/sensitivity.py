"""Sensitivity to a degradation: how a metric changes from the undegraded end, and where it breaks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Chart, Line, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import failed_marks, legend, look_of
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction

# A metric over one parameter: means with intervals, one line for each algorithm and dataset.


class LineOptions(base.PlotOptions):
    """``x`` is a parameter with numeric values."""

    x: str = Field(description="Parameter on the x axis; numeric.")
    metric: str = Field(default="ate.rmse", description="Metric to average at each value.")


class LinePlot(base.PlotType[LineOptions]):
    """The plot type ``line``."""

    key = "line"
    title = "Over a parameter"
    description = "The mean of a metric over a parameter with its 95 % interval over all repeats."
    options = LineOptions
    column_options = ("x", "metric")

    def build(self, data: base.PlotData, options: LineOptions) -> PlotResult:
        """One plot, a table of means, the raw data."""
        table = data.table.require_runs()
        x, metric = table.numeric(options.x, "the x axis"), table.numeric(options.metric, "a mean")
        protocol = table.one_protocol([x.key, metric.key])
        shown = base.with_values(table, [x.key, metric.key])
        x_axis = base.axis_of_numbers(x, shown)
        chart = Chart(
            key=f"line_{x.key}_{metric.key}",
            title=options.title or f"{metric.label} over {x.label}",
            x=x_axis,
            y=base.axis_of_numbers(metric, shown),
            marks=(*mean_lines(shown, x.key, metric.key, table), *failed_marks(table, x_axis, x.key)),
            caption=base.caption(table, len(shown), protocol, "Lines: mean; bands: 95 % bootstrap interval."),
        )
        tables = (
            base.summary_table("line", table, [metric.key], ["algorithm", "dataset", x.key]),
            base.raw_table("line_raw", table, [x.key, metric.key]),
        )
        return base.result_of(table, protocol, (chart,), tables, lacking=[x.key, metric.key])


def mean_lines(shown: pd.DataFrame, x: str, metric: str, table: RunTable) -> Iterator[Line | Points]:
    """For each algorithm and dataset a line of means with its band and markers; then the legend."""
    for (algorithm, dataset), rows in shown.groupby(["algorithm", "dataset"], sort=True):
        found = {float(value): summarise(base.number_column(group, metric)) for value, group in rows.groupby(x)}
        known = {value: summary for value, summary in found.items() if summary is not None}
        places = np.array(list(known))
        means = np.array([summary.mean for summary in known.values()])
        low, high = base.interval_ends(known.values())
        look = look_of(table, str(algorithm), str(dataset))
        yield Line(x=places, y=means, low=low, high=high, **look)
        texts = tuple(f"{summary.count} runs" for summary in known.values())
        yield Points(x=places, y=means, marker=table.marker(str(algorithm), str(dataset)), texts=texts, **look)
    yield from legend(table)


class SensitivityOptions(base.PlotOptions):
    """``x`` is the degraded parameter; its undegraded end is the baseline of each algorithm."""

    x: str = Field(description="Degraded parameter: a rate, a resolution, the strength of a fault.")
    metric: str = Field(default="ate.rmse", description="Metric to watch.")
    better: Literal["high", "low"] = Field(default="high", description="The undegraded end of x.")
    factor: float = Field(
        default=2.0, gt=1, le=1000, description="An algorithm breaks where the metric is worse by this factor."
    )
    failure_rate: float = Field(
        default=0.5, gt=0, le=1, description="An algorithm also breaks where this share of its runs fails."
    )


@dataclass(frozen=True, slots=True)
class BreakingPoint:
    """Where one algorithm on one dataset breaks: ``last_good`` and ``first_bad`` are values of x, None if beyond."""

    algorithm: str
    dataset: str
    baseline: float | None
    last_good: float | None
    first_bad: float | None
    why: str


class Sensitivity(base.PlotType[SensitivityOptions]):
    """The plot type ``sensitivity``."""

    key = "sensitivity"
    title = "Sensitivity to a degradation"
    description = "A metric over a degraded parameter, and the value at which each algorithm breaks."
    options = SensitivityOptions
    column_options = ("x", "metric")

    def build(self, data: base.PlotData, options: SensitivityOptions) -> PlotResult:
        """Lines with breaking points, a table of breaking points, the raw data."""
        table = data.table.require_runs()
        x, metric = table.numeric(options.x, "a degradation"), base.directed(table, options.metric, "a mean")
        if table.frame[x.key].nunique() < 2:
            raise InvalidInput(f"{x.key!r} has one value in the selection", "select runs with two values or more")
        protocol = table.one_protocol([x.key, metric.key])
        shown = base.with_values(table, [x.key, metric.key])
        points = list(breaking_points(table, options))
        x_axis = base.axis_of_numbers(x, shown)
        chart = Chart(
            key=f"sensitivity_{x.key}_{metric.key}",
            title=options.title or f"{metric.label} as {x.label} degrades",
            x=x_axis,
            y=base.axis_of_numbers(metric, shown),
            marks=(
                *mean_lines(shown, x.key, metric.key, table),
                *_limits(points, shown, metric.key, table),
                *failed_marks(table, x_axis, x.key),
            ),
            caption=base.caption(
                table,
                len(shown),
                protocol,
                "Lines: mean; bands: 95 % bootstrap interval. Dashed: the first value at which "
                f"{100 * options.failure_rate:g} % or more of the runs fail, or the mean is worse than "
                f"{options.factor:g} times the undegraded mean.",
            ),
        )
        tables = (_table(points, table, options), base.raw_table("sensitivity_raw", table, [x.key, metric.key]))
        return base.result_of(table, protocol, (chart,), tables, lacking=[x.key, metric.key])


def breaking_points(table: RunTable, options: SensitivityOptions) -> Iterator[BreakingPoint]:
    """For each algorithm and dataset, the first value at which it breaks, counted from the undegraded end."""
    higher_is_better = table.column(options.metric).direction is Direction.HIGHER
    for (algorithm, dataset), rows in table.frame.dropna(subset=[options.x]).groupby(["algorithm", "dataset"]):
        groups = [(float(value), group) for value, group in rows.groupby(options.x, sort=True)]
        if options.better == "high":
            groups.reverse()
        baseline: float | None = None
        last_good: float | None = None
        found: tuple[float, str] | None = None
        for value, group in groups:
            mean = _mean(group, options.metric)
            baseline = mean if baseline is None else baseline
            failed = base.failed_count(group)
            why = f"{failed} of {len(group)} runs failed" if failed >= options.failure_rate * len(group) else ""
            if not why and (mean is None or baseline is None):
                why = "no values"
            elif not why and _much_worse(mean, baseline, options.factor, higher_is_better=higher_is_better):
                why = f"mean {mean:.3g} against {baseline:.3g}"
            if why:
                found = (value, why)
                break
            last_good = value
        first_bad, why = found or (None, "does not break")
        yield BreakingPoint(str(algorithm), str(dataset), baseline, last_good, first_bad, why)


def _mean(rows: pd.DataFrame, metric: str) -> float | None:
    values = base.good_values(rows, metric)
    return float(values.mean()) if len(values) else None


def _much_worse(mean: float | None, baseline: float | None, factor: float, *, higher_is_better: bool) -> bool:
    if mean is None or baseline is None or mean == baseline:
        return False
    return mean <= baseline / factor if higher_is_better else mean >= baseline * factor


def _limits(points: list[BreakingPoint], shown: pd.DataFrame, metric: str, table: RunTable) -> Iterator[Line | Points]:
    values = base.number_column(shown, metric)
    if not len(values):
        return
    ends = np.array([np.nanmin(values), np.nanmax(values)])
    for point in points:
        if point.first_bad is not None:
            look = look_of(table, point.algorithm, point.dataset)
            look["name"] += " breaks"
            yield Line(x=np.full(2, point.first_bad), y=ends, dashed=True, **look)


def _table(points: list[BreakingPoint], table: RunTable, options: SensitivityOptions) -> ResultTable:
    x, metric = table.column(options.x), table.column(options.metric)
    columns = (
        TableColumn("algorithm", "Algorithm"),
        TableColumn("dataset", "Dataset"),
        TableColumn("baseline", f"{metric.label}, undegraded", metric.unit),
        TableColumn("last_good", f"Last good {x.label}", x.unit),
        TableColumn("first_bad", f"Breaks at {x.label}", x.unit),
        TableColumn("why", "Because"),
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (point.algorithm, point.dataset, point.baseline, point.last_good, point.first_bad, point.why)
        for point in points
    )
    return ResultTable("breaking_points", "Breaking points", columns, rows)
