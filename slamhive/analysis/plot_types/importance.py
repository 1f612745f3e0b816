"""Importance of parameters: the share of a metric's variance that each parameter and each pair explains."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import PALETTE, Array, Axis, Bars, Cells, Chart
from slamhive.analysis.plot_types import base
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Codes, Effects, explain_variance
from slamhive.analysis.table import FAILED, RunTable
from slamhive.base.errors import InvalidInput

MOST_GROUPS = 12
"""A parameter with more values is divided into this many groups of equal size."""

MOST_PARAMETERS = 20
_WORTH_SAYING = 0.005
"""Smaller shares round to zero."""


class ImportanceOptions(base.PlotOptions):
    """``parameters`` default to algorithm, dataset and all parameters that vary."""

    metric: str = Field(default="ate.rmse", description="Metric to explain.")
    parameters: list[str] = Field(
        default_factory=list, max_length=MOST_PARAMETERS, description="Parameters that explain it."
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
        text = base.caption(table, len(shown), protocol, _METHOD, _limits(accuracy, logarithm=logarithm))
        charts = (
            _bars(accuracy, failing, options.title or f"What {metric.label} depends on", metric.label, text),
            _map(accuracy, f"Interactions in {metric.label}", text),
        )
        tables = (
            _table(accuracy, failing, metric.label, text),
            base.raw_table("importance_raw", table, [*names, metric.key]),
        )
        return base.result_of(table, protocol, charts, tables, lacking=[metric.key])


def default_parameters(table: RunTable) -> list[str]:
    """Algorithm, dataset and parameters that vary."""
    names = [name for name in ("algorithm", "dataset") if table.frame[name].nunique() > 1]
    return [*names, *(column.key for column in table.varied())][:MOST_PARAMETERS]


_METHOD = (
    "Shares of variance from one analysis of variance with all parameters and pairs (omega squared, type II sums of "
    "squares). A share counts what a parameter explains beyond all others, minus what it would explain by chance."
)


def _limits(effects: Effects, *, logarithm: bool) -> str:
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


def _number(share: float | None) -> float:
    return np.nan if share is None else 100 * share


def _bars(accuracy: Effects, failing: Effects, title: str, label: str, text: str) -> Chart:
    order = tuple(sorted(accuracy.names, key=lambda name: -(accuracy.main[name] or 0.0)))

    def heights(effects: Effects) -> Array:
        return np.array([_number(effects.main[name]) for name in order])

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
        values[place, place] = _number(effects.main[name])
    for (first, second), share in effects.pairs.items():
        row, column = names.index(second), names.index(first)
        values[row, column] = _number(share)
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


def _table(accuracy: Effects, failing: Effects, label: str, text: str) -> ResultTable:
    columns = (
        TableColumn("parameter", "Parameter"),
        TableColumn("accuracy", f"Variance of {label} explained", "%"),
        TableColumn("failing", "Variance of failing explained", "%"),
    )
    note = f"Empty: the runs cannot show it. {text}"
    return ResultTable("importance", "Importance", columns, tuple(_rows(accuracy, failing)), note)


def _rows(accuracy: Effects, failing: Effects) -> Iterator[tuple[Cell, ...]]:
    singles = [(name, accuracy.main[name], failing.main[name]) for name in accuracy.names]
    pairs = [(f"{a} with {b}", share, failing.pairs.get((a, b))) for (a, b), share in accuracy.pairs.items()]
    for name, first, second in sorted([*singles, *pairs], key=lambda entry: -(entry[1] or 0.0)):
        yield (name, base.plain_cell(_number(first)), base.plain_cell(_number(second)))
