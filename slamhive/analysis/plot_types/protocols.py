"""The same runs under several evaluation protocols, side by side: how the alignment changes a metric."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import PALETTE, Axis, Boxes, Chart
from slamhive.analysis.plot_types import base
from slamhive.analysis.report import Cell, PlotResult, ResultTable, TableColumn
from slamhive.analysis.statistics import summarise
from slamhive.base.errors import InvalidInput


class ProtocolsOptions(base.PlotOptions):
    """``metric`` must depend on the protocol."""

    metric: str = Field(default="ate.rmse", description="Metric to compare.")


class Protocols(base.PlotType[ProtocolsOptions]):
    """The plot type ``protocols``."""

    key = "protocols"
    title = "Protocols side by side"
    description = "One metric of the same runs under each of their protocols; no other plot type mixes protocols."
    options = ProtocolsOptions
    all_protocols = True
    column_options = ("metric",)

    def build(self, data: base.PlotData, options: ProtocolsOptions) -> PlotResult:
        """Boxes by algorithm and protocol over the runs that have all protocols, a table of means, the raw data."""
        table = data.table.require_runs()
        column = table.numeric(options.metric, "a comparison")
        if not column.needs_protocol:
            raise InvalidInput(f"{column.key!r} does not depend on a protocol", "choose one that does: ate.rmse")
        every = data.every_protocol
        chosen = every[(every["metric"] == column.key) & every["run_id"].isin(table.frame["run_id"])]
        wide = chosen.pivot_table(index="run_id", columns="protocol", values="value", aggfunc="first")
        labels = dict(zip(chosen["protocol"], chosen["protocol_label"], strict=True))
        if wide.shape[1] < 2:
            raise InvalidInput(
                f"the selected runs were evaluated under {wide.shape[1]} protocol",
                "evaluate them under another protocol first",
            )
        complete = wide.dropna(axis=0)
        if complete.empty:
            raise InvalidInput(
                "no selected run was evaluated under all protocols", "evaluate the runs under each protocol"
            )
        algorithms = table.frame.set_index("run_id")["algorithm"]
        chart = Chart(
            key=f"protocols_{column.key}",
            title=options.title or f"{column.label} by protocol",
            x=Axis("Algorithm", categories=tuple(sorted(algorithms.loc[complete.index].unique()))),
            y=Axis(column.label, column.unit, base.spans_decades(complete.to_numpy(dtype=float).ravel())),
            marks=tuple(_boxes(complete, algorithms, labels)),
            caption=(
                f"n = {len(complete)} runs with all {wide.shape[1]} protocols, of {len(table.frame)} selected runs, "
                f"{len(table.failed())} of which failed. {table.rule_words} Values of different protocols are "
                "shown side by side and never averaged."
            ),
        )
        tables = (_summary(complete, algorithms, labels, column.unit), _raw(wide, algorithms, labels, column.unit))
        lacking = len(wide) - len(complete)
        notes = (f"{lacking} runs lack one of the protocols and are not shown.",) if lacking else ()
        return replace(base.result_of(table, None, (chart,), tables), notes=notes)


def _boxes(wide: pd.DataFrame, algorithms: pd.Series, labels: dict[str, str]) -> Iterator[Boxes]:
    names = tuple(algorithms.loc[wide.index])
    for place, fingerprint in enumerate(wide.columns):
        yield Boxes(
            name=f"{labels[fingerprint]} ({fingerprint})",
            categories=names,
            values=wide[fingerprint].to_numpy(dtype=float),
            runs=np.asarray(wide.index, dtype=int),
            colour=PALETTE[place % len(PALETTE)],
        )


def _summary(wide: pd.DataFrame, algorithms: pd.Series, labels: dict[str, str], unit: str) -> ResultTable:
    columns = [TableColumn("algorithm", "Algorithm"), TableColumn("runs", "Runs")]
    columns += [TableColumn(str(name), f"{labels[name]} mean", unit) for name in wide.columns]
    rows: list[tuple[Cell, ...]] = []
    for algorithm, group in wide.groupby(algorithms.loc[wide.index].to_numpy(), sort=True):
        found = [summarise(group[name].to_numpy(dtype=float)) for name in wide.columns]
        means = [None if entry is None else entry.mean for entry in found]
        rows.append((str(algorithm), len(group), *means))
    return ResultTable("protocols", "Means by protocol", tuple(columns), tuple(rows))


def _raw(wide: pd.DataFrame, algorithms: pd.Series, labels: dict[str, str], unit: str) -> ResultTable:
    columns = [TableColumn("run_id", "Run", links_run=True), TableColumn("algorithm", "Algorithm")]
    columns += [TableColumn(str(name), labels[name], unit) for name in wide.columns]
    rows = tuple(
        (base.plain_cell(run), str(algorithms.loc[run]), *(base.plain_cell(value) for value in values))
        for run, values in zip(wide.index, wide.to_numpy(), strict=True)
    )
    return ResultTable("protocols_raw", "Raw data", tuple(columns), rows, raw=True)
