"""A table of metrics as papers print it: one row for each algorithm and dataset, mean and spread over runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pandas as pd
from pydantic import Field

from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.metric_grid import grid_table
from slamhive.analysis.plot_types.values import mean_and_std, shown_unit, summary_of
from slamhive.analysis.result import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import Column, RunTable

_METRICS = ("poses", "ate.rmse", "cpu.mean", "ram.max", "latency.median", "frames.dropped")


class MetricTableOptions(base.PlotOptions):
    """Which metrics become columns, and what besides the algorithm becomes a row."""

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
        shown = ResultTable(
            "metrics",
            options.title or self.title,
            (*_row_columns(table, by), *map(_heading, columns), *(() if one else (_PROTOCOL,))),
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


def _row_columns(table: RunTable, by: list[str]) -> tuple[TableColumn, ...]:
    named = (TableColumn(key, table.column(key).label, table.column(key).unit) for key in by)
    return (*named, TableColumn("runs", "Runs"), TableColumn("failed", "Failed"))


def _heading(column: Column) -> TableColumn:
    return TableColumn(column.key, column.label, shown_unit(column), figures=True)


def _cell(group: pd.DataFrame, column: Column) -> str | None:
    summary = summary_of(group, column)
    return None if summary is None else mean_and_std(summary)
