"""The interface of plot types: options, and a function from the table of runs to plots and tables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from slamhive.analysis.chart import Array, Axis, Chart
from slamhive.analysis.result import Cell, Exclusion, FormResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import FAILED, Column, RunTable, is_disturbed
from slamhive.errors import InvalidInput
from slamhive.registry import Registry


class FormOptions(BaseModel):
    """What every plot type understands; a plot type adds its own options."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    title: str | None = Field(default=None, max_length=200, description="Replaces the default title.")
    text: str = Field(default="", max_length=20_000, description="Markdown above the plot.")


OptionsT = TypeVar("OptionsT", bound=FormOptions)


@dataclass(frozen=True, slots=True)
class RunTrack:
    """The aligned estimate of one run and its ground truth, as its evaluation left them.

    Timestamps in s, positions (n, 3) in m in the ground truth's frame; ``errors_m`` and ``pieces`` have one entry for
    each pose. ``pieces`` numbers the stretches between pauses that are longer than the protocol's gap.
    """

    run_id: int
    stamps_s: Array
    positions_m: Array
    errors_m: Array
    pieces: Array
    reference_stamps_s: Array
    reference_positions_m: Array


@dataclass(frozen=True, slots=True)
class RunUsage:
    """CPU (cores) and memory (bytes) of one run over the time since its start (s)."""

    run_id: int
    times_s: Array
    cpu_cores: Array
    memory_bytes: Array


class RunFiles(Protocol):
    """What forms read from run folders; None where a run has none."""

    def track(self, run_id: int) -> RunTrack | None:
        """The evaluated trajectory of a run."""
        ...

    def usage(self, run_id: int) -> RunUsage | None:
        """The sampled usage of a run."""
        ...


@dataclass(frozen=True, slots=True)
class FormData:
    """What a plot type works on.

    Attributes:
        table: The selected runs under the analysis' protocol.
        every_protocol: Long form, for comparing protocols: run_id, protocol, protocol_label, metric, value.
        files: Trajectories and usage of single runs.
        progress: To be called with a fraction from time to time; raises to end a computation that takes too long.
    """

    table: RunTable
    every_protocol: pd.DataFrame
    files: RunFiles
    progress: Callable[[float], None] = field(default=lambda _: None)


class Form(ABC, Generic[OptionsT]):
    """One kind of plot or table.

    ``key`` is what analysis files call it; ``options`` is the pydantic model of its part of the file.
    """

    key: ClassVar[str]
    title: ClassVar[str]
    description: ClassVar[str]
    options: ClassVar[type[FormOptions]]
    all_protocols: ClassVar[bool] = False
    """Whether the plot type reads :attr:`FormData.every_protocol`, which is empty otherwise."""

    @abstractmethod
    def needs(self, options: OptionsT) -> frozenset[str]:
        """The metrics and parameters that ``build`` reads; other metrics need not be in the table."""

    @abstractmethod
    def build(self, data: FormData, options: OptionsT) -> FormResult:
        """Plots and tables. Raises InvalidInput or NotFound if the data or the options do not fit the plot type."""


FORMS: Registry[Form[Any]] = Registry("plot type", "slamhive.analysis_forms")
"""Every plot type by its key; installed packages add theirs through the entry-point group."""


def require_runs(table: RunTable) -> None:
    """Raise InvalidInput for an empty selection."""
    if table.frame.empty:
        raise InvalidInput("the selection holds no run", "widen it; the page of runs shows what there is")


def with_values(table: RunTable, keys: Sequence[str]) -> pd.DataFrame:
    """The good runs that have all these values; raises InvalidInput if no run is good, or none of them has one."""
    good = table.good()
    if good.empty:
        raise InvalidInput(f"all {len(table.frame)} runs count as failed", "loosen 'failed_when', or select others")
    for key in keys:
        if good[key].isna().all():
            raise InvalidInput(f"no good run has a value of {key!r}", "choose one that was measured")
    shown = good.dropna(subset=list(keys))
    if shown.empty:
        raise InvalidInput(f"no good run has all of {', '.join(keys)}", "choose those that were measured together")
    return shown


def one_value(table: RunTable, key: str, purpose: str) -> str:
    """The only value of a column of words; raises InvalidInput naming the values if there are several."""
    values = sorted(str(value) for value in table.frame[key].dropna().unique())
    if len(values) == 1:
        return values[0]
    shown = ", ".join(values[:5]) + (", ..." if len(values) > 5 else "") if values else "none"
    raise InvalidInput(f"{purpose} needs one {key}, the selection holds {len(values)}: {shown}", f"select one {key}")


def axis_of(column: Column, *, log: bool = False, values: Iterable[object] = ()) -> Axis:
    """The axis of a column; a column of words becomes categories in the order of the alphabet."""
    if column.numeric:
        return Axis(column.label, column.unit, log)
    return Axis(column.label, column.unit, categories=tuple(sorted({str(value) for value in values})))


def spans_decades(values: Array) -> bool:
    """Whether values are all positive and spread over more than a factor of 100: then an axis is logarithmic."""
    finite = values[np.isfinite(values)]
    return bool(len(finite) > 1 and finite.min() > 0 and finite.max() > 100 * finite.min())


def number_column(rows: pd.DataFrame, key: str) -> Array:
    """A column of numbers as an array; NaN where a run has none."""
    return np.asarray(rows[key], dtype=float)


def caption(table: RunTable, shown: int, protocol: str | None, *more: str) -> str:
    """What every plot says of itself: n, failures by the one rule, protocol."""
    failed = int(table.frame[FAILED].notna().sum())
    total = len(table.frame)
    parts = [f"n = {shown} of {total} runs, {failed} failed.", table.rule_words, table.disturbance_words]
    parts.append(f"Protocol: {protocol}." if protocol else "These plots do not depend on an evaluation protocol.")
    return " ".join(filter(None, [*parts, *more]))


def result_of(
    table: RunTable,
    protocol: str | None,
    charts: Sequence[Chart],
    tables: Sequence[ResultTable],
    *,
    lacking: Sequence[str] = (),
    excluded: Sequence[Exclusion] = (),
) -> FormResult:
    """What a plot type came to over the runs of ``table``.

    Args:
        table: Every run that the plot type is about.
        protocol: Of its plots, in words; None if none depends on one.
        charts: In the order of the page.
        tables: Shown ones and raw data.
        lacking: Columns without which a good run is not shown; those runs are excluded.
        excluded: More of them; those of no runs are left out.
    """
    without = excluded_without(table.good(), lacking, table.columns)
    return FormResult(
        charts=tuple(charts),
        tables=tuple(tables),
        runs=len(table.frame),
        failed=len(table.failed()),
        excluded=(*without, *(entry for entry in excluded if entry.runs)),
        protocol=protocol,
    )


def excluded_without(rows: pd.DataFrame, keys: Sequence[str], columns: Mapping[str, Column]) -> tuple[Exclusion, ...]:
    """The good runs that lack one of these values, with the value they lack."""
    exclusions = []
    for key in keys:
        lacking = rows[rows[key].isna()]
        if len(lacking):
            runs = tuple(int(run) for run in lacking["run_id"])
            exclusions.append(Exclusion(f"no value of {columns[key].label}", runs))
    return tuple(exclusions)


def raw_table(key: str, table: RunTable, keys: Sequence[str], title: str = "Raw data") -> ResultTable:
    """The runs behind a plot, failed ones included, with the reason."""
    named = [key for key in dict.fromkeys(keys) if key not in _ALWAYS]
    chosen = ["run_id", "configuration_id", "algorithm", "dataset", *named]
    columns = [_table_column(table.column(name)) for name in chosen]
    columns += [TableColumn("disturbed", "Disturbed by"), TableColumn("failed", "Failed because")]
    rows = tuple(
        tuple(plain_cell(value) for value in row)
        for row in table.frame[[*chosen, "disturbed", FAILED]].itertuples(index=False, name=None)
    )
    return ResultTable(key, title, tuple(columns), rows, raw=True)


def summary_table(key: str, table: RunTable, metrics: Sequence[str], by: Sequence[str]) -> ResultTable:
    """One row for each group of runs: how many, how many failed, and each metric's mean, spread and interval.

    Failed runs have no part in a mean; their number stands beside it. A column that ``by`` names twice stands once.
    """
    by = list(dict.fromkeys(by))
    columns = [_table_column(table.column(name)) for name in by]
    columns += [TableColumn("runs", "Runs"), TableColumn("failed", "Failed"), TableColumn("disturbed", "Disturbed")]
    for metric in metrics:
        column = table.column(metric)
        for part, label in _SUMMARY.items():
            columns.append(TableColumn(f"{metric}.{part}", f"{column.label} {label}", column.unit))
    rows = []
    for names, group in table.frame.groupby(by, sort=True, dropna=False):
        failed = int(group[FAILED].notna().sum())
        good = group[group[FAILED].isna()]
        disturbed = int(is_disturbed(group).sum())
        cells: list[Cell] = [*(plain_cell(name) for name in names), len(group), failed, disturbed]
        for metric in metrics:
            cells += _summary_cells(summarise(number_column(good, metric)))
        rows.append(tuple(cells))
    return ResultTable(key, "Summary", tuple(columns), tuple(rows), caption=f"{table.rule_words} {_INTERVAL}")


_SUMMARY = {"mean": "mean", "std": "std", "median": "median", "low": "95 % from", "high": "95 % to"}
_INTERVAL = "95 %: bootstrap interval of the mean over runs, too narrow below 10 of them; std with divisor n - 1."


def _summary_cells(summary: Summary | None) -> list[Cell]:
    if summary is None:
        return [None] * len(_SUMMARY)
    ends = (None, None) if summary.interval is None else (summary.interval.low, summary.interval.high)
    return [summary.mean, summary.std, summary.median, *ends]


def plain_cell(value: object) -> Cell:
    """A value of a data frame as one of a table: NaN and missing become None, numpy's numbers Python's."""
    if value is None or value is pd.NA:
        return None
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        number = float(value)
        if not np.isfinite(number):
            return None
        return number
    return str(value)


_ALWAYS = {"run_id", "configuration_id", "algorithm", "dataset", "disturbed", FAILED}


def _table_column(column: Column) -> TableColumn:
    return TableColumn(column.key, column.label, column.unit, links_run=column.key == "run_id")
