"""Which parameters matter: the share of a metric's variance that each explains, alone and together with another."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

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
from slamhive.errors import InvalidInput

MOST_GROUPS = 12
"""A parameter with more values is cut into so many groups of equal size."""

MOST_PARAMETERS = 20


@dataclass(frozen=True, slots=True)
class Effects:
    """Shares of the variance of one quantity: of each parameter alone, of pairs beyond both, and of nothing known."""

    names: tuple[str, ...]
    main: dict[str, float]
    pairs: dict[tuple[str, str], float]
    count: int


class ImportanceOptions(FormOptions):
    """``parameters`` default to all that vary, with algorithm and dataset."""

    metric: str = Field(default="ate.rmse", description="What is explained.")
    parameters: list[str] = Field(default_factory=list, max_length=MOST_PARAMETERS, description="By what.")


class Importance(Form[ImportanceOptions]):
    """The form ``importance``."""

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
        accuracy = explained_variance(shown, names, np.log10(values) if logarithm else values)
        failing = explained_variance(table.frame, names, table.frame[FAILED].notna().to_numpy(dtype=float))
        scale = "log10 of the metric" if logarithm else "the metric"
        note = (
            f"Omega squared (W. L. Hays, 1963) of {scale}: shares of variance, corrected for the number of values. "
            "They overlap where not all combinations have equally many good runs."
        )
        text = caption(table, len(shown), protocol, note)
        charts = (
            _bars(accuracy, failing, options.title or f"What {metric.label} depends on", metric.label, text),
            _map(accuracy, f"Interactions in {metric.label}", text),
        )
        tables = (_table(accuracy, failing, metric.label), raw_table("importance_raw", table, [*names, metric.key]))
        return result_of(table, protocol, charts, tables, lacking=[metric.key])


def default_parameters(table: RunTable) -> list[str]:
    """Algorithm and dataset if they vary, then all parameters that vary."""
    names = [name for name in ("algorithm", "dataset") if table.frame[name].nunique() > 1]
    return [*names, *(column.key for column in table.varied())][:MOST_PARAMETERS]


def explained_variance(rows: pd.DataFrame, names: list[str], values: Array) -> Effects:
    """Omega squared of each parameter and of each pair beyond the two alone, never below 0; NaN if it cannot be told.

    The shares add up where every combination was run equally often; they overlap where it was not.

    Args:
        rows: One row for each value, with the parameters.
        names: Columns of ``rows``.
        values: (n,) finite.
    """
    codes = {name: _codes(rows[name]) for name in names}
    main = {name: _omega_squared(codes[name], values) for name in names}
    pairs = {}
    for first, second in combinations(names, 2):
        joint = codes[first] * (int(codes[second].max(initial=0)) + 1) + codes[second]
        both = _omega_squared(np.unique(joint, return_inverse=True)[1], values)
        pairs[first, second] = float(np.maximum(0.0, both - main[first] - main[second]))  # keeps NaN
    return Effects(tuple(names), main, pairs, len(values))


def _codes(values: pd.Series) -> Array:
    """Groups by value, or by quantile for numbers of many values; missing values are a group of their own."""
    if values.nunique() > MOST_GROUPS and pd.api.types.is_numeric_dtype(values):
        groups = pd.qcut(values, MOST_GROUPS, labels=False, duplicates="drop").fillna(-1)
        return np.unique(groups.to_numpy(), return_inverse=True)[1]
    codes: Array = pd.factorize(values, use_na_sentinel=False)[0]
    return codes


def _omega_squared(groups: Array, values: Array) -> float:
    total = float(((values - values.mean()) ** 2).sum()) if len(values) else 0.0
    counts = np.bincount(groups) if len(groups) else np.zeros(0)
    between_freedom, within_freedom = len(counts) - 1, len(values) - len(counts)
    if total == 0 or between_freedom < 1:
        return 0.0
    if within_freedom < 1:
        return float("nan")  # no group has two values: what differs by the groups and what by chance is one
    means = np.bincount(groups, weights=values) / counts
    between = float((counts * (means - values.mean()) ** 2).sum())
    within = max(0.0, total - between) / within_freedom
    return max(0.0, (between - between_freedom * within) / (total + within))


def _bars(accuracy: Effects, failing: Effects, title: str, label: str, text: str) -> Chart:
    order = tuple(sorted(accuracy.names, key=lambda name: -np.nan_to_num(accuracy.main[name])))

    def heights(effects: Effects) -> Array:
        return np.array([100 * effects.main[name] for name in order])

    bars = (
        Bars(label, heights(accuracy), colour=REFERENCE),
        Bars("failing", heights(failing), colour=REFERENCE, striped=True),
    )
    return Chart(
        key="importance",
        title=title,
        x=Axis("parameter", categories=order),
        y=Axis("variance explained", "%"),
        marks=bars if any(share > 0 for share in failing.main.values()) else bars[:1],
        caption=text,
    )


def _map(effects: Effects, title: str, text: str) -> Chart:
    names = effects.names
    values = np.full((len(names), len(names)), np.nan)
    for place, name in enumerate(names):
        values[place, place] = 100 * effects.main[name]
    for (first, second), share in effects.pairs.items():
        row, column = names.index(second), names.index(first)
        values[row, column] = 100 * share
    texts = tuple(tuple("" if np.isnan(value) else f"{value:.2g}" for value in row) for row in values)
    return Chart(
        key="interactions",
        title=title,
        x=Axis("", categories=names),
        y=Axis("", categories=names),
        marks=(Cells(values, texts, "variance explained", "%", lower_is_better=False),),
        caption=(
            "Diagonal: each parameter alone; below it: what two explain together beyond that, empty where no "
            f"combination was run twice. {text}"
        ),
    )


def _table(accuracy: Effects, failing: Effects, label: str) -> ResultTable:
    columns = (
        TableColumn("parameter", "Parameter"),
        TableColumn("accuracy", f"Variance of {label} explained", "%"),
        TableColumn("failing", "Variance of failing explained", "%"),
    )
    return ResultTable("importance", "Importance", columns, tuple(_rows(accuracy, failing)))


def _rows(accuracy: Effects, failing: Effects) -> Iterator[tuple[Cell, ...]]:
    singles = [(name, accuracy.main[name], failing.main[name]) for name in accuracy.names]
    pairs = [(f"{a} with {b}", share, failing.pairs[a, b]) for (a, b), share in accuracy.pairs.items()]
    for name, first, second in sorted([*singles, *pairs], key=lambda entry: -np.nan_to_num(entry[1])):
        yield (name, plain_cell(100 * first), plain_cell(100 * second))


FORMS.register(Importance.key, Importance())
