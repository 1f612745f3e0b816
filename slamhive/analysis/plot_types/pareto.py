"""The Pareto front: configurations that no other configuration beats in all metrics at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from pydantic import Field, model_validator

from slamhive.analysis.chart import REFERENCE, Array, Chart, Line, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.looks import legend, look_of
from slamhive.analysis.report import PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import FAILED, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.documents.validation import explained
from slamhive.domain.metrics import Direction


class ParetoOptions(base.PlotOptions):
    """The first two metrics are the axes; all metrics decide which configuration beats which."""

    metrics: list[str] = Field(
        default_factory=lambda: ["cpu.mean", "ate.rmse"],
        min_length=2,
        max_length=6,
        description="Metrics to trade off: the first is the x axis, the second the y axis; all count.",
    )

    @model_validator(mode="after")
    def _distinct(self) -> ParetoOptions:
        if len(set(self.metrics)) < len(self.metrics):
            raise explained(InvalidInput(f"a metric is named twice in {self.metrics}"))
        return self


class Pareto(base.PlotType[ParetoOptions]):
    """The plot type ``pareto``."""

    key = "pareto"
    title = "Pareto front"
    description = "Accuracy against CPU, memory or latency: the configurations that no other beats in all of them."
    options = ParetoOptions
    column_options = ("metrics",)

    def build(self, data: base.PlotData, options: ParetoOptions) -> PlotResult:
        """A scatter of configurations with the front as a line, a table of the front, the raw data."""
        table = data.table.require_runs()
        columns = [base.directed(table, key, "a trade-off") for key in options.metrics]
        protocol = table.one_protocol(options.metrics)
        means = configuration_means(table, options.metrics)
        if means.empty:
            raise InvalidInput(
                f"no selected run has all of {', '.join(options.metrics)}", "choose metrics that were measured"
            )
        signs = np.array([-1.0 if column.direction is Direction.HIGHER else 1.0 for column in columns])
        survivors = bool(means["failed"].any())
        front = fronts_by_dataset(means, options.metrics, signs)
        x, y = columns[0], columns[1]
        in_plane = len(columns) == 2 and not survivors
        joined = ", joined by dashed lines" if in_plane else ""
        beaten = [column.label for column in columns] + (["the share of failed runs"] if survivors else [])
        # Drawn only if no third cost counts.
        on_front = means[front]
        lines: list[Line] = []
        for dataset, rows in on_front.groupby("dataset", sort=True):
            ordered = rows.sort_values(x.key)
            places = base.number_column(ordered, x.key), base.number_column(ordered, y.key)
            lines.append(Line(f"front on {dataset}", *places, colour=REFERENCE, dashed=True, in_legend=False))
        chart = Chart(
            key=f"pareto_{'_'.join(options.metrics)}",
            title=options.title or f"{y.label} against {x.label}",
            x=base.axis_of_numbers(x, means),
            y=base.axis_of_numbers(y, means),
            marks=(
                *(lines if in_plane else ()),
                *_points(means.assign(front=front), options.metrics, table),
            ),
            caption=base.caption(
                table,
                int(means["good"].sum()),
                protocol,
                f"One point for each of {len(means)} pairs of configuration and dataset (mean over good runs). Outlined"
                f"{joined}: the {int(front.sum())} that no other on the same dataset beats in {', '.join(beaten)}.",
            ),
        )
        table_columns = [
            TableColumn("algorithm", "Algorithm"),
            TableColumn("dataset", "Dataset"),
            TableColumn("configuration_id", "Configuration"),
            *(TableColumn(key, f"{table.column(key).label} mean", table.column(key).unit) for key in options.metrics),
            TableColumn("runs", "Runs"),
            TableColumn("failed", "Failed"),
        ]
        chosen = on_front[[column.key for column in table_columns]].sort_values(options.metrics[0])
        table_rows = tuple(tuple(map(base.plain_cell, row)) for row in chosen.itertuples(index=False, name=None))
        tables = (
            ResultTable("pareto", "Configurations on the front", tuple(table_columns), table_rows),
            base.raw_table("pareto_raw", table, options.metrics),
        )
        return base.result_of(table, protocol, (chart,), tables, lacking=options.metrics)


def configuration_means(table: RunTable, metrics: list[str]) -> pd.DataFrame:
    """One row per configuration and dataset that has all metrics: means over good runs, runs, failures."""
    keys = ["algorithm", "dataset", "configuration_id"]
    good = table.good().dropna(subset=metrics)
    means = good.groupby(keys, sort=True)[metrics].mean()
    means["good"] = good.groupby(keys, sort=True).size()
    counts = table.frame.groupby(keys, sort=True)[FAILED].agg(["size", "count"])
    joined = means.join(counts.rename(columns={"size": "runs", "count": "failed"}))
    return joined.reset_index()


def pareto_front(costs: Array) -> Array:
    """Mark the rows that no other row beats: (n,) bool.

    A row beats another if it is never worse and at least once better (dominance as in K. Deb, 2001).

    Args:
        costs: (n, metrics), lower is better, finite.
    """
    order = np.lexsort(costs.T[::-1])
    front = np.zeros(len(costs), dtype=bool)
    kept = np.empty((0, costs.shape[1]))
    for place in order:
        row = costs[place]
        beaten = np.any(np.all(kept <= row, axis=1) & np.any(kept < row, axis=1))
        if not beaten:
            front[place] = True
            kept = np.vstack([kept, row])
    return front


def fronts_by_dataset(means: pd.DataFrame, metrics: list[str], signs: Array) -> Array:
    """Mark the rows on the front of their dataset; sequences differ in difficulty and are never compared.

    The share of failed runs is another cost: a good mean over few surviving runs beats no configuration with fewer
    failures.
    """
    front = np.zeros(len(means), dtype=bool)
    datasets = means["dataset"].to_numpy()
    lost = means["failed"].to_numpy(dtype=float) / means["runs"].to_numpy(dtype=float)
    costs = np.column_stack([means[metrics].to_numpy(dtype=float) * signs, lost])
    for dataset in set(datasets):
        rows = np.flatnonzero(datasets == dataset)
        front[rows[pareto_front(costs[rows])]] = True
    return front


def _points(means: pd.DataFrame, metrics: list[str], table: RunTable) -> Iterator[Points]:
    grouped = means.groupby(["front", "algorithm", "dataset"], sort=True)  # the front is drawn last
    for (on_front, algorithm, dataset), rows in grouped:
        yield Points(
            **look_of(table, str(algorithm), str(dataset)),
            x=base.number_column(rows, metrics[0]),
            y=base.number_column(rows, metrics[1]),
            marker=table.marker(str(algorithm), str(dataset)),
            emphasis=bool(on_front),
            texts=tuple(
                f"configuration {row.configuration_id}: {row.good} good of {row.runs} runs"
                for row in rows.itertuples(index=False)
            ),
        )
    yield from legend(table)
