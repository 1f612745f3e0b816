"""The table of one metric as papers print it: sequences by algorithms, best and second marked, failures in view."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import pandas as pd

from slamhive.analysis.chart import file_key
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.values import mean_and_std, shown_unit, summary_of
from slamhive.analysis.result import ResultTable, TableColumn
from slamhive.analysis.table import Column, RunTable
from slamhive.domain.metrics import Direction
from slamhive.errors import InvalidInput

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
        caption=_caption(table, column, protocol, [entry for entries in grid.values() for entry in entries]),
        ranks=tuple((None, *ranks(entries, column.direction)) for entries in grid.values()),
    )


def _entry(group: pd.DataFrame, column: Column) -> _Entry:
    summary = summary_of(group, column)
    return _Entry(len(group), base.failed_count(group), None if summary is None else mean_and_std(summary))


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


def _caption(table: RunTable, column: Column, protocol: str | None, entries: Sequence[_Entry]) -> str:
    return base.caption(table, len(table.good()), protocol, *_notes(column, entries))


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
