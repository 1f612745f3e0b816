"""Effects of parameters on a metric: lines, sensitivity to a degradation, importance, parallel coordinates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import PALETTE, Array, Axis, Bars, Cells, Chart, Dimension, Line, Parallel, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import failed_marks, legend, look_of, places_on, value_words
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Codes, Effects, explain_variance, summarise
from slamhive.analysis.table import FAILED, Column, RunTable
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


# Importance of parameters: the share of a metric's variance that each parameter and each pair explains.


MOST_GROUPS = 12
"""A parameter with more values is divided into this many groups of equal size."""

MOST_EXPLAINING = 20
_WORTH_SAYING = 0.005
"""Smaller shares round to zero."""


class ImportanceOptions(base.PlotOptions):
    """``parameters`` default to algorithm, dataset and all parameters that vary."""

    metric: str = Field(default="ate.rmse", description="Metric to explain.")
    parameters: list[str] = Field(
        default_factory=list, max_length=MOST_EXPLAINING, description="Parameters that explain it."
    )


class Importance(base.PlotType[ImportanceOptions]):
    """The plot type ``importance``."""

    key = "importance"
    title = "Parameter importance"
    description = "The share of the variance of a metric, and of failing, that each parameter and each pair explains."
    options = ImportanceOptions
    column_options = ("metric", "parameters")

    def build(self, data: base.PlotData, options: ImportanceOptions) -> PlotResult:
        """Bars of main effects, a map of interactions, a table of both, the raw data."""
        table = data.table.require_runs()
        metric = table.numeric(options.metric, "importance")
        protocol = table.one_protocol([metric.key])
        names = options.parameters or default_parameters(table)
        for name in names:
            table.column(name)
        if not names:
            raise InvalidInput("nothing varies in the selection", "select runs of several parameters or algorithms")
        shown = base.with_values(table, [metric.key])
        values = base.number_column(shown, metric.key)
        logarithm = bool(len(values)) and bool((values > 0).all())
        accuracy = explain_variance(_codes(shown, names), np.log10(values) if logarithm else values)
        failing = explain_variance(_codes(table.frame, names), table.frame[FAILED].notna().to_numpy(dtype=float))
        text = base.caption(table, len(shown), protocol, _METHOD, _method_limits(accuracy, logarithm=logarithm))
        charts = (
            _bars(accuracy, failing, options.title or f"What {metric.label} depends on", metric.label, text),
            _map(accuracy, f"Interactions in {metric.label}", text),
        )
        columns = (
            TableColumn("parameter", "Parameter"),
            TableColumn("accuracy", f"Variance of {metric.label} explained", "%"),
            TableColumn("failing", "Variance of failing explained", "%"),
        )
        note = f"Empty: the runs cannot show it. {text}"
        tables = (
            ResultTable("importance", "Importance", columns, tuple(_rows(accuracy, failing)), note),
            base.raw_table("importance_raw", table, [*names, metric.key]),
        )
        return base.result_of(table, protocol, charts, tables, lacking=[metric.key])


def default_parameters(table: RunTable) -> list[str]:
    """Algorithm, dataset and parameters that vary."""
    names = [name for name in ("algorithm", "dataset") if table.frame[name].nunique() > 1]
    return [*names, *(column.key for column in table.varied())][:MOST_EXPLAINING]


_METHOD = (
    "Shares of variance from one analysis of variance with all parameters and pairs (omega squared, type II sums of "
    "squares). A share counts what a parameter explains beyond all others, minus what it would explain by chance."
)


def _method_limits(effects: Effects, *, logarithm: bool) -> str:
    """Limits of these shares, for the caption."""
    found = ["The values are log10 of the metric."] if logarithm else []
    if effects.shared > _WORTH_SAYING:
        found.append(
            "The design is not balanced: "
            f"{100 * effects.shared:.2g} % of the variance cannot be assigned to a single parameter."
        )
    found += [
        f"{first} and {second} always vary together; each is shown with the share of both."
        for first, second in effects.aliases
    ]
    if effects.left_out:
        found.append(f"There are too few runs to judge {effects.left_out} of {len(effects.pairs)} pairs.")
    return " ".join(found)


def _codes(rows: pd.DataFrame, names: list[str]) -> dict[str, Codes]:
    """The level of each run by parameter. A parameter that some algorithms lack is nested in the algorithm."""
    codes = {name: _levels(rows[name]) for name in names}
    if "algorithm" in codes:
        of = codes["algorithm"]
        for name in names:
            if rows[name].isna().any():
                joint = of * (int(codes[name].max(initial=0)) + 1) + codes[name]
                codes[name] = np.unique(joint, return_inverse=True)[1]
    return codes


def _levels(values: pd.Series) -> Codes:
    """Levels by value, or by quantile for numbers with many values; missing values form a separate level."""
    if values.nunique() > MOST_GROUPS and pd.api.types.is_numeric_dtype(values):
        groups = pd.qcut(values, MOST_GROUPS, labels=False, duplicates="drop").fillna(-1)
        return np.unique(groups.to_numpy(), return_inverse=True)[1]
    codes: Codes = np.unique(pd.factorize(values, use_na_sentinel=False)[0], return_inverse=True)[1]
    return codes


def _share(share: float | None) -> float:
    return np.nan if share is None else 100 * share


def _bars(accuracy: Effects, failing: Effects, title: str, label: str, text: str) -> Chart:
    order = tuple(sorted(accuracy.names, key=lambda name: -(accuracy.main[name] or 0.0)))

    def heights(effects: Effects) -> Array:
        return np.array([_share(effects.main[name]) for name in order])

    bars = (
        Bars(label, heights(accuracy), colour=PALETTE[0]),
        Bars("failing", heights(failing), colour=PALETTE[1], striped=True),
    )
    return Chart(
        key="importance",
        title=title,
        x=Axis("parameter", categories=order),
        y=Axis("variance explained", "%"),
        marks=bars if any(failing.main.values()) else bars[:1],
        caption=text,
    )


def _map(effects: Effects, title: str, text: str) -> Chart:
    names = effects.names
    values = np.full((len(names), len(names)), np.nan)
    for place, name in enumerate(names):
        values[place, place] = _share(effects.main[name])
    for (first, second), share in effects.pairs.items():
        row, column = names.index(second), names.index(first)
        values[row, column] = _share(share)
    texts = tuple(tuple("" if np.isnan(value) else f"{value:.2g}" for value in row) for row in values)
    return Chart(
        key="interactions",
        title=title,
        x=Axis("", categories=names),
        y=Axis("", categories=names),
        marks=(Cells(values, texts, "variance explained", "%", lower_is_better=False),),
        caption=(
            "Diagonal: each parameter alone. Below: what two parameters explain together beyond that; empty if the "
            f"runs cannot show it. {text}"
        ),
    )


def _rows(accuracy: Effects, failing: Effects) -> Iterator[tuple[Cell, ...]]:
    singles = [(name, accuracy.main[name], failing.main[name]) for name in accuracy.names]
    pairs = [(f"{a} with {b}", share, failing.pairs.get((a, b))) for (a, b), share in accuracy.pairs.items()]
    for name, first, second in sorted([*singles, *pairs], key=lambda entry: -(entry[1] or 0.0)):
        yield (name, base.plain_cell(_share(first)), base.plain_cell(_share(second)))


# Parallel coordinates: one line per run through its parameters and metrics.


MOST_LINES = 20_000
MOST_DIMENSIONS = 10


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
            [*names, *(column.key for column in table.varied()[:MOST_DIMENSIONS])] or ["algorithm"]
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
