"""A table of metrics as papers print it: one row for each algorithm and dataset, mean and spread over runs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import file_key
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.base import shown_unit, summary_of
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import Column, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import Direction
from slamhive.domain.names import mean_and_std

# The table of one metric as papers print it: sequences by algorithms, best and second marked, failures in view.


ALL_FAILED = "×"
"""The cell of an algorithm of which every run failed."""

_MARKED = (1, 2)
_WORDS = {Direction.LOWER: "lower is better", Direction.HIGHER: "higher is better"}


@dataclass(frozen=True, slots=True)
class _Entry:
    """One algorithm on one sequence: runs, failed ones, and mean and spread as text, None without a value."""

    runs: int
    failed: int
    shown: str | None

    @property
    def text(self) -> str | None:
        if self.shown is None:
            return ALL_FAILED if 0 < self.runs == self.failed else None
        return f"{self.shown} ({self.runs - self.failed}/{self.runs})" if self.failed else self.shown


def grid_table(table: RunTable, column: Column, by: str, title: str | None) -> ResultTable:
    """One row for each value of ``by`` and one column for each algorithm.

    Raises InvalidInput if the metric was evaluated under several protocols, because a ranking never mixes them.
    """
    if by == "algorithm":
        raise InvalidInput("algorithms cannot be rows and columns at once", "group by dataset, or use columns: metrics")
    protocol = table.one_protocol([column.key])
    algorithms = sorted(map(str, table.frame["algorithm"].unique()))
    grid = {
        str(name): [_entry(group[group["algorithm"] == algorithm], column) for algorithm in algorithms]
        for name, group in table.frame.groupby(by, sort=True)
    }
    unit = shown_unit(column)
    named = f"{column.label} [{unit}]" if unit else column.label
    first = table.column(by)
    return ResultTable(
        file_key(f"grid_{column.key}"),
        f"{title}: {named}" if title else named,
        (
            TableColumn(f"by.{first.key}", first.label, first.unit),
            *(TableColumn(f"algorithm.{name}", name, figures=True) for name in algorithms),
        ),
        tuple((name, *(entry.text for entry in entries)) for name, entries in grid.items()),
        caption=base.caption(
            table,
            len(table.good()),
            protocol,
            *_notes(column, [entry for entries in grid.values() for entry in entries]),
        ),
        ranks=tuple((None, *ranks(entries, column.direction)) for entries in grid.values()),
    )


def _entry(group: pd.DataFrame, column: Column) -> _Entry:
    summary = summary_of(group, column)
    return _Entry(
        len(group), base.failed_count(group), None if summary is None else mean_and_std(summary.mean, summary.std)
    )


def ranks(entries: Sequence[_Entry], direction: Direction) -> list[int | None]:
    """1 for the best, 2 for the second best, None for others: by the share of failures, then by the mean.

    Equal texts share a rank. Nothing is ranked if the metric has no better direction, or if all values are equal.
    """
    if direction is Direction.NEUTRAL:
        return [None] * len(entries)
    sign = 1 if direction is Direction.LOWER else -1
    keys = [
        None if entry.shown is None else (entry.failed / entry.runs, sign * float(entry.shown.partition(" ")[0]))
        for entry in entries
    ]
    known = sorted(key for key in keys if key is not None)
    places = [None if key is None or known[0] == known[-1] else 1 + known.index(key) for key in keys]
    return [place if place in _MARKED else None for place in places]


def _notes(column: Column, entries: Sequence[_Entry]) -> Iterator[str]:
    better = _WORDS.get(column.direction)
    unit = shown_unit(column)
    yield f"{column.label}{f' in {unit}' if unit else ''}{f', {better}' if better else ''}."
    counts = {entry.runs for entry in entries if entry.runs}
    each = f"{min(counts)}" if len(counts) == 1 else f"{min(counts)} to {max(counts)}"
    yield f"Mean ± standard deviation (divisor n - 1) of the runs that did not fail, of {each} in each cell."
    if better:
        yield "Bold: best; underlined: second best; fewer failures come first, then the mean."
    if any(entry.shown is not None and entry.failed for entry in entries):
        yield "(a/b): a of b runs did not fail."
    if any(entry.text == ALL_FAILED for entry in entries):
        yield f"{ALL_FAILED}: every run failed."
    if any(entry.text is None for entry in entries):
        yield "–: no value."


_METRICS = ("poses", "ate.rmse", "cpu.mean", "ram.max", "latency.median", "frames.dropped")


class MetricTableOptions(base.PlotOptions):
    """Choice of the metrics that become columns, and of what besides the algorithm becomes a row."""

    metrics: list[str] = Field(
        default_factory=lambda: list(_METRICS), min_length=1, max_length=20, description="Metrics, one column each."
    )
    by: base.GroupKey = "dataset"
    columns: Literal["metrics", "algorithms"] = Field(
        default="metrics",
        description="What the columns are: metrics, in one table; or algorithms, in one table for each metric, with "
        "the best value bold and the second underlined, as papers print it.",
    )


class MetricTable(base.PlotType[MetricTableOptions]):
    """The plot type ``table``."""

    key = "table"
    title = "Table of metrics"
    description = (
        "One row for each algorithm and dataset, or another group: mean ± standard deviation of several metrics over "
        "the runs that did not fail, and how many failed. Each row states its protocol."
    )
    options = MetricTableOptions
    column_options = ("metrics",)

    def build(self, data: base.PlotData, options: MetricTableOptions) -> PlotResult:
        """The table to read, the same values as numbers, the raw data; no plot.

        Raises InvalidInput if the runs of one row were evaluated under several protocols; with one column for each
        algorithm, if those of any two rows were.
        """
        table = data.table.require_runs().grouped_by(options.by)
        metrics = list(dict.fromkeys(options.metrics))
        columns = [table.numeric(key, "a mean") for key in metrics]
        if options.columns == "algorithms":
            tables = [grid_table(table, column, options.by, options.title) for column in columns]
            return self._result(table, table.one_protocol(metrics), tables, metrics, options.by)
        by = list(dict.fromkeys([options.by, "algorithm"]))
        rows: list[tuple[Cell, ...]] = []
        protocols: set[str] = set()
        for names, group in table.frame.groupby(by, sort=True):
            protocol = table.with_rows(group).one_protocol(metrics)
            protocols |= {protocol} if protocol else set()
            counts = len(group), base.failed_count(group)
            rows.append((*map(str, names), *counts, *(_cell(group, column) for column in columns), protocol))
        one = len(protocols) <= 1
        named = (TableColumn(key, table.column(key).label, table.column(key).unit) for key in by)
        shown = ResultTable(
            "metrics",
            options.title or self.title,
            (
                *named,
                TableColumn("runs", "Runs"),
                TableColumn("failed", "Failed"),
                *map(_heading, columns),
                *(() if one else (_PROTOCOL,)),
            ),
            tuple(row[:-1] for row in rows) if one else tuple(rows),
            caption=base.caption(table, len(table.good()), " or ".join(sorted(protocols)) or None, _CAPTION),
        )
        return self._result(table, next(iter(protocols)) if one and protocols else None, [shown], metrics, options.by)

    @staticmethod
    def _result(
        table: RunTable, protocol: str | None, shown: list[ResultTable], metrics: list[str], by: str
    ) -> PlotResult:
        groups = list(dict.fromkeys([by, "algorithm"]))
        values = base.summary_table("metrics_values", table, metrics, groups)
        tables = (
            *shown,
            replace(values, title="Values", raw=True),
            base.raw_table("metrics_raw", table, [by, *metrics]),
        )
        return base.result_of(table, protocol, (), tables)


_PROTOCOL = TableColumn("protocol", "Protocol")
_CAPTION = "Values: mean ± standard deviation (divisor n - 1) over the runs that did not fail."


def _heading(column: Column) -> TableColumn:
    return TableColumn(column.key, column.label, shown_unit(column), figures=True)


def _cell(group: pd.DataFrame, column: Column) -> str | None:
    summary = summary_of(group, column)
    return None if summary is None else mean_and_std(summary.mean, summary.std)
