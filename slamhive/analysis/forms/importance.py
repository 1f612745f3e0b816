"""Which parameters matter: the share of a metric's variance that each explains, alone and together with another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import REFERENCE, Array, Axis, Bars, Cells, Chart
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    caption,
    number_column,
    plain_cell,
    raw_table,
    require_runs,
    result_of,
    with_values,
)
from slamhive.analysis.result import Cell, FormResult, ResultTable, TableColumn
from slamhive.analysis.table import FAILED, RunTable
from slamhive.analysis.variance import Codes, Effects, explain_variance
from slamhive.errors import InvalidInput

MOST_GROUPS = 12
"""A parameter with more values is cut into so many groups of equal size."""

MOST_PARAMETERS = 20
_WORTH_SAYING = 0.005
"""A smaller share rounds to nothing."""


class ImportanceOptions(FormOptions):
    """``parameters`` default to all that vary, with algorithm and dataset."""

    metric: str = Field(default="ate.rmse", description="What is explained.")
    parameters: list[str] = Field(default_factory=list, max_length=MOST_PARAMETERS, description="By what.")


class Importance(Form[ImportanceOptions]):
    """The plot type ``importance``."""

    key = "importance"
    title = "Parameter importance"
    description = "Share of the variance of a metric, and of failing, explained by each parameter and by pairs."
    options = ImportanceOptions

    def needs(self, options: ImportanceOptions) -> frozenset[str]:
        """The metric and the parameters."""
        return frozenset({options.metric, *options.parameters})

    def build(self, data: FormData, options: ImportanceOptions) -> FormResult:
        """Bars of main effects, a map of interactions, the table, the raw data."""
        table = data.table
        require_runs(table)
        metric = table.numeric(options.metric, "importance")
        protocol = table.one_protocol([metric.key])
        names = options.parameters or default_parameters(table)
        for name in names:
            table.column(name)
        if not names:
            raise InvalidInput("nothing varies in the selection", "select runs of several parameters or algorithms")
        shown = with_values(table, [metric.key])
        values = number_column(shown, metric.key)
        logarithm = bool(len(values)) and bool((values > 0).all())
        accuracy = explain_variance(_codes(shown, names), np.log10(values) if logarithm else values)
        failing = explain_variance(_codes(table.frame, names), table.frame[FAILED].notna().to_numpy(dtype=float))
        text = caption(table, len(shown), protocol, _METHOD, _limits(accuracy, logarithm=logarithm))
        charts = (
            _bars(accuracy, failing, options.title or f"What {metric.label} depends on", metric.label, text),
            _map(accuracy, f"Interactions in {metric.label}", text),
        )
        tables = (
            _table(accuracy, failing, metric.label, text),
            raw_table("importance_raw", table, [*names, metric.key]),
        )
        return result_of(table, protocol, charts, tables, lacking=[metric.key])


def default_parameters(table: RunTable) -> list[str]:
    """Algorithm and dataset if they vary, then all parameters that vary."""
    names = [name for name in ("algorithm", "dataset") if table.frame[name].nunique() > 1]
    return [*names, *(column.key for column in table.varied())][:MOST_PARAMETERS]


_METHOD = (
    "Shares of variance by one analysis of variance with all parameters and pairs (omega squared, type II sums of "
    "squares). Each share is what a parameter explains beyond all others, less what it would explain by chance."
)


def _limits(effects: Effects, *, logarithm: bool) -> str:
    """What a reader must know of these shares in particular."""
    found = ["The values are log10 of the metric."] if logarithm else []
    if effects.shared > _WORTH_SAYING:
        found.append(
            "The design is not balanced: "
            f"{100 * effects.shared:.2g} % of the variance belongs to several parameters together and to none alone."
        )
    found += [
        f"{first} and {second} always vary together: each has the share of both." for first, second in effects.aliases
    ]
    if effects.left_out:
        found.append(f"There are too few runs to tell {effects.left_out} of {len(effects.pairs)} pairs from chance.")
    return " ".join(found)


def _codes(rows: pd.DataFrame, names: list[str]) -> dict[str, Codes]:
    """The level of each run by parameter. A parameter that some algorithms lack counts within its algorithm."""
    codes = {name: _levels(rows[name]) for name in names}
    if "algorithm" in codes:
        of = codes["algorithm"]
        for name in names:
            if rows[name].isna().any():
                joint = of * (int(codes[name].max(initial=0)) + 1) + codes[name]
                codes[name] = np.unique(joint, return_inverse=True)[1]
    return codes


def _levels(values: pd.Series) -> Codes:
    """Levels by value, or by quantile for numbers of many values; missing values are a level of their own."""
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
        Bars(label, heights(accuracy), colour=REFERENCE),
        Bars("failing", heights(failing), colour=REFERENCE, striped=True),
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
            "Diagonal: each parameter alone. Below it: what two explain together beyond that; empty where the runs "
            f"cannot tell. {text}"
        ),
    )


def _table(accuracy: Effects, failing: Effects, label: str, text: str) -> ResultTable:
    columns = (
        TableColumn("parameter", "Parameter"),
        TableColumn("accuracy", f"Variance of {label} explained", "%"),
        TableColumn("failing", "Variance of failing explained", "%"),
    )
    note = f"Empty: the runs cannot tell. {text}"
    return ResultTable("importance", "Importance", columns, tuple(_rows(accuracy, failing)), note)


def _rows(accuracy: Effects, failing: Effects) -> Iterator[tuple[Cell, ...]]:
    singles = [(name, accuracy.main[name], failing.main[name]) for name in accuracy.names]
    pairs = [(f"{a} with {b}", share, failing.pairs.get((a, b))) for (a, b), share in accuracy.pairs.items()]
    for name, first, second in sorted([*singles, *pairs], key=lambda entry: -(entry[1] or 0.0)):
        yield (name, plain_cell(_number(first)), plain_cell(_number(second)))


FORMS.register(Importance.key, Importance())
