"""A table of metrics as papers print it: one row for each algorithm and dataset, mean and spread over runs."""

from __future__ import annotations

import math
from dataclasses import replace

import pandas as pd
from pydantic import Field

from slamhive.analysis.plot_types import base
from slamhive.analysis.result import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import Summary, summarise
from slamhive.analysis.table import Column, RunTable

_METRICS = ("poses", "ate.rmse", "cpu.mean", "ram.max", "latency.median", "frames.dropped")


class MetricTableOptions(base.PlotOptions):
    """Which metrics become columns, and what besides the algorithm becomes a row."""

    metrics: list[str] = Field(
        default_factory=lambda: list(_METRICS), min_length=1, max_length=20, description="Metrics, one column each."
    )
    by: base.GroupKey = "dataset"


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

        Raises InvalidInput if the runs of one row were evaluated under several protocols.
        """
        table = data.table.require_runs().grouped_by(options.by)
        metrics = list(dict.fromkeys(options.metrics))
        columns = [table.numeric(key, "a mean") for key in metrics]
        by = list(dict.fromkeys([options.by, "algorithm"]))
        rows: list[tuple[Cell, ...]] = []
        protocols: set[str] = set()
        for names, group in table.frame.groupby(by, sort=True):
            protocol = table.with_rows(group).one_protocol(metrics)
            protocols |= {protocol} if protocol else set()
            counts = len(group), base.failed_count(group)
            rows.append((*map(str, names), *counts, *(_cell(group, column) for column in columns), protocol))
        one = len(protocols) <= 1
        shown = ResultTable(
            "metrics",
            options.title or self.title,
            (*_row_columns(table, by), *map(_heading, columns), *(() if one else (_PROTOCOL,))),
            tuple(row[:-1] for row in rows) if one else tuple(rows),
            caption=base.caption(table, len(table.good()), " or ".join(sorted(protocols)) or None, _CAPTION),
        )
        tables = (
            shown,
            replace(base.summary_table("metrics_values", table, metrics, by), title="Values", raw=True),
            base.raw_table("metrics_raw", table, [options.by, *metrics]),
        )
        return base.result_of(table, next(iter(protocols)) if len(protocols) == 1 else None, (), tables)


_PROTOCOL = TableColumn("protocol", "Protocol")
_CAPTION = "Values: mean ± standard deviation (divisor n - 1) over the runs that did not fail."


def _row_columns(table: RunTable, by: list[str]) -> tuple[TableColumn, ...]:
    named = (TableColumn(key, table.column(key).label) for key in by)
    return (*named, TableColumn("runs", "Runs"), TableColumn("failed", "Failed"))


def _heading(column: Column) -> TableColumn:
    unit = "MB" if column.unit == "bytes" else "" if column.unit == "1" else column.unit
    return TableColumn(column.key, column.label, unit)


def _cell(group: pd.DataFrame, column: Column) -> str | None:
    scale = base.MEGABYTES_PER_BYTE if column.unit == "bytes" else 1.0
    summary = summarise(scale * base.good_values(group, column.key))
    return None if summary is None else mean_and_std(summary)


def mean_and_std(summary: Summary) -> str:
    """``0.0312 ± 0.0008``: three significant digits of the mean, one more if the spread is smaller than they show."""
    whole = summary.std in (None, 0.0) and summary.mean.is_integer()
    digits = 0 if whole else max(0, 2 - _exponent(summary.mean))
    if summary.std and round(summary.std, digits + 1):
        digits = min(max(digits, -_exponent(summary.std)), digits + 1)
    if summary.std is None:
        return f"{summary.mean:.{digits}f}"
    return f"{summary.mean:.{digits}f} ± {summary.std:.{digits}f}"


def _exponent(value: float) -> int:
    return math.floor(math.log10(abs(value))) if value else 0
