"""The distribution of metrics over runs: a box with points for each algorithm and dataset."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import Field

from slamhive.analysis.chart import Axis, Boxes, Chart, Mark
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.places import failed_marks
from slamhive.analysis.result import PlotResult
from slamhive.analysis.table import RunTable


class DistributionsOptions(base.PlotOptions):
    """Each of ``metrics`` gets its own plot."""

    metrics: list[str] = Field(
        default_factory=lambda: ["ate.rmse", "rpe.rmse"], min_length=1, max_length=20, description="Metrics to show."
    )
    by: base.GroupKey = "dataset"


class Distributions(base.PlotType[DistributionsOptions]):
    """The plot type ``distributions``."""

    key = "distributions"
    title = "Distributions over runs"
    description = "The values of all runs as boxes with points, for each algorithm and dataset, or another group."
    options = DistributionsOptions
    column_options = ("metrics",)

    def build(self, data: base.PlotData, options: DistributionsOptions) -> PlotResult:
        """A plot for each metric, a summary, the raw data."""
        table = data.table.require_runs().grouped_by(options.by)
        for key in options.metrics:
            table.numeric(key, "a distribution")
        protocol = table.one_protocol(options.metrics)
        charts = [_chart(table, key, protocol, options) for key in options.metrics]
        tables = (
            base.summary_table("distributions", table, options.metrics, ["algorithm", options.by]),
            base.raw_table("distributions_raw", table, options.metrics),
        )
        return base.result_of(table, protocol, charts, tables, lacking=options.metrics)


def _chart(table: RunTable, key: str, protocol: str | None, options: DistributionsOptions) -> Chart:
    column = table.column(key)
    shown = base.with_values(table, [key])
    x = Axis(table.column(options.by).label, table.column(options.by).unit, categories=table.groups(options.by))
    return Chart(
        key=f"distribution_{key}",
        title=options.title or f"{column.label} over runs",
        x=x,
        y=Axis(column.label, column.unit, log=base.spans_decades(base.number_column(shown, key))),
        marks=tuple(_marks(table, key, x, options.by)),
        caption=base.caption(
            table, len(shown), protocol, "Boxes: quartiles; whiskers: up to 1.5 times the interquartile range."
        ),
    )


def _marks(table: RunTable, key: str, x: Axis, by: str) -> Iterator[Mark]:
    shown = table.good().dropna(subset=[key])
    for algorithm, rows in shown.groupby("algorithm", sort=True):
        yield Boxes(
            name=str(algorithm),
            categories=tuple(rows[by]),
            values=base.number_column(rows, key),
            runs=rows["run_id"].to_numpy(dtype=int),
            colour=table.colours[str(algorithm)],
        )
    yield from failed_marks(table, x, by)
