"""The interface of plot types: options, and a function from the table of runs to plots and tables."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from slamhive.analysis.chart import Array, Axis, Chart
from slamhive.analysis.report import Cell, Exclusion, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import FAILED, Column, RunTable, is_disturbed
from slamhive.base.errors import InvalidInput
from slamhive.base.registry import Registry, instances_of
from slamhive.domain.metrics import Direction
from slamhive.run_folder.played_frames import RecordingClock


class PlotOptions(BaseModel):
    """Options of every plot type; each adds its own."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
    title: str | None = Field(default=None, max_length=200, description="Replaces the title of the plot type.")
    text: str = Field(default="", max_length=20_000, description="Markdown above the plot.")


GroupKey = Annotated[
    str,
    Field(
        min_length=1,
        max_length=200,
        description="Column that groups runs: dataset, a parameter, or a property of datasets such as difficulty.",
    ),
]

OptionsT = TypeVar("OptionsT", bound=PlotOptions)

MEGABYTES_PER_BYTE = 1e-6


@dataclass(frozen=True, slots=True)
class RunTrack:
    """The aligned estimate of one run and its ground truth, from the files of its evaluation.

    Timestamps in s, positions (n, 3) in m in the frame of the ground truth; ``errors_m`` and ``pieces`` have one entry
    for each pose. ``pieces`` numbers the parts of the path; a gap longer than the protocol allows separates two parts.
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
    """CPU (cores) and memory (bytes) of one run over the time since its start (s).

    ``clock`` converts these times to the time of the recording; None if it is not known when frames were played.
    """

    run_id: int
    times_s: Array
    cpu_cores: Array
    memory_bytes: Array
    clock: RecordingClock | None = None


@dataclass(frozen=True, slots=True)
class RunLatency:
    """The time from a frame's arrival to its result (s) over the timestamp of the frame (s)."""

    run_id: int
    timestamps_s: Array
    latencies_s: Array


class RunFiles(Protocol):
    """Reads run folders for plot types; None where a run lacks the files."""

    def track(self, run_id: int) -> RunTrack | None:
        """The evaluated trajectory of a run."""
        ...

    def usage(self, run_id: int, startup_s: float | None) -> RunUsage | None:
        """The sampled usage of a run whose playback began ``startup_s`` after its start; None if unknown."""
        ...

    def latency(self, run_id: int) -> RunLatency | None:
        """The latency of each frame that a run has finished."""
        ...

    def first_frame_s(self, run_id: int) -> float | None:
        """The timestamp of the first frame of the recording that was played."""
        ...


@dataclass(frozen=True, slots=True)
class PlotData:
    """The input of a plot type.

    Attributes:
        table: The selected runs under the analysis' protocol.
        every_protocol: One row per value, to compare protocols: run_id, protocol, protocol_label, metric, value.
        files: Trajectories and usage of single runs.
        progress: Call it with the fraction done from time to time; it raises if the computation must end.
    """

    table: RunTable
    every_protocol: pd.DataFrame
    files: RunFiles
    progress: Callable[[float], None] = field(default=lambda _: None)


class PlotType(ABC, Generic[OptionsT]):
    """A kind of plot or table.

    Analysis files name it by ``key``; ``options`` is the pydantic model of its section in the file.
    """

    key: ClassVar[str]
    title: ClassVar[str]
    description: ClassVar[str]
    options: ClassVar[type[PlotOptions]]
    all_protocols: ClassVar[bool] = False
    """Whether ``build`` reads :attr:`PlotData.every_protocol`, which is empty otherwise."""
    column_options: ClassVar[tuple[str, ...]] = ()
    """The options that hold the key of a metric or parameter, or a list of keys."""
    reads: ClassVar[frozenset[str]] = frozenset()
    """Metrics that ``build`` reads whatever the options are."""

    def needs(self, options: OptionsT) -> frozenset[str]:
        """The metrics and parameters that ``build`` reads; the table may lack all other metrics."""
        named = (getattr(options, name) for name in self.column_options)
        return self.reads.union(*([keys] if isinstance(keys, str) else keys for keys in named))

    @abstractmethod
    def build(self, data: PlotData, options: OptionsT) -> PlotResult:
        """Make plots and tables; raises InvalidInput or NotFound if the data or the options do not fit."""


PLOT_TYPES: Registry[PlotType[Any]] = Registry("plot type", "slamhive.analysis_forms", instances_of(PlotType, "key"))
"""Every plot type by its key; installed packages add theirs through the entry-point group."""


def with_values(table: RunTable, keys: Sequence[str]) -> pd.DataFrame:
    """The good runs that have all these values; raises InvalidInput if there are none."""
    good = table.good()
    if good.empty:
        raise InvalidInput(f"all {len(table.frame)} runs count as failed", "loosen 'failed_when', or select others")
    for key in keys:
        if good[key].isna().all():
            raise InvalidInput(f"no good run has a value of {key!r}", "choose a metric that was measured")
    shown = good.dropna(subset=list(keys))
    if shown.empty:
        raise InvalidInput(f"no good run has all of {', '.join(keys)}", "choose metrics that were measured together")
    return shown


def directed(table: RunTable, key: str, purpose: str) -> Column:
    """The column of a metric where lower or higher is better; raises NotFound or InvalidInput."""
    column = table.numeric(key, purpose)
    if column.direction is Direction.NEUTRAL:
        raise InvalidInput(f"{key!r} has no better direction", "choose a metric where lower or higher is better")
    return column


def one_value(table: RunTable, key: str, purpose: str) -> str:
    """The only value of a column of text; raises InvalidInput that lists the values if there are several."""
    values = sorted(str(value) for value in table.frame[key].dropna().unique())
    if len(values) == 1:
        return values[0]
    shown = ", ".join(values[:5]) + (", ..." if len(values) > 5 else "") if values else "none"
    raise InvalidInput(f"{purpose} needs one {key}, the selection has {len(values)}: {shown}", f"select one {key}")


def axis_of(column: Column, *, log: bool = False, values: Iterable[object] = ()) -> Axis:
    """The axis of a column; a column of text becomes categories in alphabetical order."""
    if column.numeric:
        return Axis(column.label, column.unit, log)
    return Axis(column.label, column.unit, categories=tuple(sorted({str(value) for value in values})))


def axis_of_numbers(column: Column, rows: pd.DataFrame) -> Axis:
    """The axis of a column of numbers; logarithmic if the values of the rows need it."""
    return Axis(column.label, column.unit, spans_decades(number_column(rows, column.key)))


def spans_decades(values: Array) -> bool:
    """Tell if values need a logarithmic axis: all are positive and they span more than a factor of 100."""
    finite = values[np.isfinite(values)]
    return bool(len(finite) > 1 and finite.min() > 0 and finite.max() > 100 * finite.min())


def number_column(rows: pd.DataFrame, key: str) -> Array:
    """A column of numbers as an array; NaN where a run has none."""
    return np.asarray(rows[key], dtype=float)


def good_values(rows: pd.DataFrame, key: str) -> Array:
    """The finite values of the runs that did not fail."""
    values = number_column(rows[rows[FAILED].isna()], key)
    return values[np.isfinite(values)]


def failed_count(rows: pd.DataFrame) -> int:
    """Number of runs that failed."""
    return int(rows[FAILED].notna().sum())


def interval_ends(summaries: Iterable[Summary]) -> tuple[Array, Array]:
    """Lower and upper ends of the intervals of means; both are the mean where there is no interval."""
    ends = [(s.mean, s.mean) if s.interval is None else (s.interval.low, s.interval.high) for s in summaries]
    low, high = np.array(ends).reshape(-1, 2).T
    return low, high


def caption(table: RunTable, shown: int, protocol: str | None, *more: str) -> str:
    """The caption of a plot: number of runs, failures and their rule, protocol."""
    parts = [
        f"n = {shown} of {len(table.frame)} runs, {failed_count(table.frame)} failed.",
        table.rule_words,
        table.disturbance_words,
        table.version_words,
        table.trajectory_words,
        table.cpu_words,
        table.limit_words,
    ]
    parts.append(f"Protocol: {protocol}." if protocol else "No metric here depends on an evaluation protocol.")
    return " ".join(filter(None, [*parts, *more]))


def result_of(
    table: RunTable,
    protocol: str | None,
    charts: Sequence[Chart],
    tables: Sequence[ResultTable],
    *,
    lacking: Sequence[str] = (),
    excluded: Sequence[Exclusion] = (),
) -> PlotResult:
    """The result of a plot type over the runs of ``table``.

    Args:
        table: All runs that the plot is about.
        protocol: Protocol of its metrics, in words; None if no metric depends on one.
        tables: Tables to show, which get MB in place of bytes, and raw data.
        lacking: Columns that a good run needs to be shown; runs without them are excluded.
        excluded: Further exclusions; those without runs are dropped.
    """
    without = excluded_without(table.good(), lacking, table.columns)
    return PlotResult(
        charts=tuple(charts),
        tables=tuple(entry if entry.raw else in_megabytes(entry) for entry in tables),
        runs=len(table.frame),
        failed=len(table.failed()),
        excluded=(*without, *(entry for entry in excluded if entry.runs)),
        protocol=protocol,
    )


def excluded_without(rows: pd.DataFrame, keys: Sequence[str], columns: Mapping[str, Column]) -> tuple[Exclusion, ...]:
    """The good runs that lack a value, by the missing value."""
    exclusions = []
    for key in keys:
        lacking = rows[rows[key].isna()]
        if len(lacking):
            runs = tuple(int(run) for run in lacking["run_id"])
            exclusions.append(Exclusion(f"no value of {columns[key].label}", runs))
    return tuple(exclusions)


def raw_table(key: str, table: RunTable, keys: Sequence[str], title: str = "Raw data") -> ResultTable:
    """The runs behind a plot; failed ones are included with the reason."""
    named = [key for key in dict.fromkeys(keys) if key not in _ALWAYS]
    chosen = ["run_id", "configuration_id", "algorithm", "dataset", *named]
    columns = [_table_column(table.column(name)) for name in chosen]
    columns += [TableColumn("disturbed", "Disturbed by"), TableColumn("failed", "Failed because")]
    cells = [_plain_cells(table.frame[name]) for name in (*chosen, "disturbed", FAILED)]
    return ResultTable(key, title, tuple(columns), tuple(zip(*cells, strict=True)), raw=True)


def _plain_cells(column: pd.Series) -> list[Cell]:
    """The cells of a column, by :func:`plain_cell`. Most columns are of numbers, which need no look at each."""
    if column.dtype == np.float64 and np.isfinite(column.to_numpy()).all():
        return list(column.tolist())
    return [plain_cell(value) for value in column.tolist()]


def in_megabytes(table: ResultTable) -> ResultTable:
    """The table with MB in place of bytes, which nobody reads at a glance."""
    places = {place for place, column in enumerate(table.columns) if column.unit == "bytes"}
    if not places:
        return table
    rows = (
        tuple(
            cell * MEGABYTES_PER_BYTE if place in places and isinstance(cell, int | float) else cell
            for place, cell in enumerate(row)
        )
        for row in table.rows
    )
    columns = (replace(column, unit="MB") if column.unit == "bytes" else column for column in table.columns)
    return replace(table, columns=tuple(columns), rows=tuple(rows))


def summary_table(key: str, table: RunTable, metrics: Sequence[str], by: Sequence[str]) -> ResultTable:
    """One row for each group of runs: number of runs and failures, and mean, spread and interval of each metric.

    Means leave failed runs out; the table counts them. A column that ``by`` names twice appears once.
    """
    by = list(dict.fromkeys(by))
    columns = [_table_column(table.column(name)) for name in by]
    columns += [TableColumn("runs", "Runs"), TableColumn("failed", "Failed"), TableColumn("disturbed", "Disturbed")]
    for metric in metrics:
        column = table.column(metric)
        for part, label in _SUMMARY.items():
            unit = "MB" if column.unit == "bytes" else column.unit
            columns.append(TableColumn(f"{metric}.{part}", f"{column.label} {label}", unit))
    rows = []
    for names, group in table.frame.groupby(by, sort=True, dropna=False):
        counts = len(group), failed_count(group), int(is_disturbed(group).sum())
        cells: list[Cell] = [*map(plain_cell, names), *counts]
        for metric in metrics:
            factor = 1e-6 if table.column(metric).unit == "bytes" else 1.0
            summary = summarise(factor * good_values(group, metric))
            if summary is None:
                cells += [None] * len(_SUMMARY)
            else:
                ends = (None, None) if summary.interval is None else (summary.interval.low, summary.interval.high)
                cells += [summary.mean, summary.std, summary.median, *ends]
        rows.append(tuple(cells))
    return ResultTable(key, "Summary", tuple(columns), tuple(rows), caption=f"{table.rule_words} {_INTERVAL}")


_SUMMARY = {"mean": "mean", "std": "std", "median": "median", "low": "95 % from", "high": "95 % to"}
_INTERVAL = "95 %: bootstrap interval of the mean over runs, too narrow for fewer than 10 runs; std with divisor n - 1."


def plain_cell(value: object) -> Cell:
    """A value of a data frame as a table cell: missing values become None, numbers of numpy those of Python."""
    if value is None or value is pd.NA:
        return None
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).lower()
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return str(value)


_ALWAYS = {"run_id", "configuration_id", "algorithm", "dataset", "disturbed", FAILED}


def _table_column(column: Column) -> TableColumn:
    return TableColumn(column.key, column.label, column.unit, links_run=column.key == "run_id")


# Mean and spread of a group of runs as text, in the units that tables show.


def shown_unit(column: Column) -> str:
    """The unit of the texts of :func:`mean_and_std`: MB for bytes, nothing for shares and counts."""
    return "MB" if column.unit == "bytes" else "" if column.unit == "1" else column.unit


def summary_of(group: pd.DataFrame, column: Column) -> Summary | None:
    """The values of the runs that did not fail, in the unit of :func:`shown_unit`; None if there are none."""
    scale = MEGABYTES_PER_BYTE if column.unit == "bytes" else 1.0
    return summarise(scale * good_values(group, column.key))
