"""Sensitivity to a degradation: how a metric changes from the best condition on, and where it breaks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Chart, Line, Points
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    axis_of,
    caption,
    number_column,
    raw_table,
    require_runs,
    result_of,
    spans_decades,
    with_values,
)
from slamhive.analysis.forms.line import mean_lines
from slamhive.analysis.forms.places import failed_marks, look_of
from slamhive.analysis.result import Cell, FormResult, ResultTable, TableColumn
from slamhive.analysis.table import FAILED, RunTable
from slamhive.domain.metrics import Direction
from slamhive.errors import InvalidInput


class SensitivityOptions(FormOptions):
    """``x`` is what was degraded; its better end is where algorithms are compared with themselves."""

    x: str = Field(description="Parameter that was degraded: a rate, a resolution, the strength of a fault.")
    metric: str = Field(default="ate.rmse", description="What suffers.")
    better: Literal["high", "low"] = Field(default="high", description="Which end of x is the undegraded one.")
    factor: float = Field(default=2.0, gt=1, le=1000, description="Broken: the metric is worse by this factor, or")
    failure_rate: float = Field(default=0.5, gt=0, le=1, description="this share of the runs fails.")


@dataclass(frozen=True, slots=True)
class BreakingPoint:
    """Where one algorithm on one dataset breaks. ``last_good`` and ``first_bad`` are values of x; None: beyond."""

    algorithm: str
    dataset: str
    baseline: float | None
    last_good: float | None
    first_bad: float | None
    why: str


class Sensitivity(Form[SensitivityOptions]):
    """The plot type ``sensitivity``."""

    key = "sensitivity"
    title = "Sensitivity to a degradation"
    description = "A metric from the undegraded end on, and the value at which each algorithm breaks."
    options = SensitivityOptions

    def needs(self, options: SensitivityOptions) -> frozenset[str]:
        """The degraded parameter and the metric."""
        return frozenset({options.x, options.metric})

    def build(self, data: FormData, options: SensitivityOptions) -> FormResult:
        """The lines with breaking points marked, the table of breaking points, the raw data."""
        table = data.table
        require_runs(table)
        x, metric = table.numeric(options.x, "a degradation"), table.numeric(options.metric, "a mean")
        if metric.direction is Direction.NEUTRAL:
            raise InvalidInput(f"{metric.key!r} has no better end", "choose a metric of which less or more is better")
        if table.frame[x.key].nunique() < 2:
            raise InvalidInput(f"{x.key!r} has one value in the selection", "a degradation needs two values or more")
        protocol = table.one_protocol([x.key, metric.key])
        shown = with_values(table, [x.key, metric.key])
        points = list(breaking_points(table, options))
        x_axis = axis_of(x, log=spans_decades(number_column(shown, x.key)))
        broken = "whose runs fail in a share of {:g} % or more, or whose mean is worse than {:g} times the undegraded"
        chart = Chart(
            key=f"sensitivity_{x.key}_{metric.key}",
            title=options.title or f"{metric.label} as {x.label} degrades",
            x=x_axis,
            y=axis_of(metric, log=spans_decades(number_column(shown, metric.key))),
            marks=(
                *mean_lines(shown, x.key, metric.key, table),
                *_limits(points, shown, metric.key, table),
                *failed_marks(table, x_axis, x.key),
            ),
            caption=caption(
                table,
                len(shown),
                protocol,
                "Lines: mean; bands: 95 % bootstrap interval. Dashed: the first value "
                f"{broken.format(100 * options.failure_rate, options.factor)}.",
            ),
        )
        tables = (_table(points, table, options), raw_table("sensitivity_raw", table, [x.key, metric.key]))
        return result_of(table, protocol, (chart,), tables, lacking=[x.key, metric.key])


def breaking_points(table: RunTable, options: SensitivityOptions) -> Iterator[BreakingPoint]:
    """For each algorithm and dataset the first value, from the undegraded end on, at which it is broken."""
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
            why = _failing(group, options.failure_rate)
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
    values = number_column(rows[rows[FAILED].isna()], metric)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def _failing(rows: pd.DataFrame, failure_rate: float) -> str:
    failed = int(rows[FAILED].notna().sum())
    return f"{failed} of {len(rows)} runs failed" if failed >= failure_rate * len(rows) else ""


def _much_worse(mean: float | None, baseline: float | None, factor: float, *, higher_is_better: bool) -> bool:
    if mean is None or baseline is None or mean == baseline:
        return False
    return mean <= baseline / factor if higher_is_better else mean >= baseline * factor


def _limits(points: list[BreakingPoint], shown: pd.DataFrame, metric: str, table: RunTable) -> Iterator[Line | Points]:
    values = number_column(shown, metric)
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


FORMS.register(Sensitivity.key, Sensitivity())
