"""How metrics are distributed over runs: a box with its points for each algorithm and dataset."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import Field

from slamhive.analysis.chart import Axis, Boxes, Chart, Mark
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    caption,
    number_column,
    raw_table,
    require_runs,
    result_of,
    spans_decades,
    summary_table,
    with_values,
)
from slamhive.analysis.forms.places import failed_marks
from slamhive.analysis.result import FormResult
from slamhive.analysis.table import RunTable


class DistributionsOptions(FormOptions):
    """``metrics`` each get a plot of their own."""

    metrics: list[str] = Field(
        default_factory=lambda: ["ate.rmse", "rpe.rmse"], min_length=1, max_length=20, description="What is shown."
    )


class Distributions(Form[DistributionsOptions]):
    """The plot type ``distributions``."""

    key = "distributions"
    title = "Distributions over runs"
    description = "Every run's value of some metrics, as boxes with points for each algorithm and dataset."
    options = DistributionsOptions

    def needs(self, options: DistributionsOptions) -> frozenset[str]:
        """The metrics shown."""
        return frozenset(options.metrics)

    def build(self, data: FormData, options: DistributionsOptions) -> FormResult:
        """A plot for each metric, a table of summaries, the raw data."""
        table = data.table
        require_runs(table)
        for key in options.metrics:
            table.numeric(key, "a distribution")
        protocol = table.one_protocol(options.metrics)
        charts = [_chart(table, key, protocol, options.title) for key in options.metrics]
        tables = (
            summary_table("distributions", table, options.metrics, ["algorithm", "dataset"]),
            raw_table("distributions_raw", table, options.metrics),
        )
        return result_of(table, protocol, charts, tables, lacking=options.metrics)


def _chart(table: RunTable, key: str, protocol: str | None, title: str | None) -> Chart:
    column = table.column(key)
    shown = with_values(table, [key])
    x = Axis("Dataset", categories=tuple(sorted(table.frame["dataset"].unique())))
    return Chart(
        key=f"distribution_{key}",
        title=title or f"{column.label} over runs",
        x=x,
        y=Axis(column.label, column.unit, log=spans_decades(number_column(shown, key))),
        marks=tuple(_marks(table, key, x)),
        caption=caption(table, len(shown), protocol, "Boxes: quartiles; whiskers: to 1.5 times their distance."),
    )


def _marks(table: RunTable, key: str, x: Axis) -> Iterator[Mark]:
    shown = table.good().dropna(subset=[key])
    for algorithm, rows in shown.groupby("algorithm", sort=True):
        yield Boxes(
            name=str(algorithm),
            categories=tuple(rows["dataset"]),
            values=number_column(rows, key),
            runs=rows["run_id"].to_numpy(dtype=int),
            colour=table.colours[str(algorithm)],
        )
    yield from failed_marks(table, x, "dataset")


FORMS.register(Distributions.key, Distributions())
