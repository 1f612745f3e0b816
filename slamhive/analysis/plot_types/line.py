"""A metric over one parameter: means with intervals, one line for each algorithm and dataset."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Chart, Line, Points
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.places import failed_marks, legend, look_of
from slamhive.analysis.result import PlotResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable


class LineOptions(base.PlotOptions):
    """``x`` is a parameter with numeric values."""

    x: str = Field(description="Parameter on the x axis; numeric.")
    metric: str = Field(default="ate.rmse", description="Metric to average at each value.")


class LinePlot(base.PlotType[LineOptions]):
    """The plot type ``line``."""

    key = "line"
    title = "Over a parameter"
    description = "The mean of a metric over a parameter with its 95 % interval over all repeats."
    options = LineOptions
    column_options = ("x", "metric")

    def build(self, data: base.PlotData, options: LineOptions) -> PlotResult:
        """One plot, a table of means, the raw data."""
        table = data.table.require_runs()
        x, metric = table.numeric(options.x, "the x axis"), table.numeric(options.metric, "a mean")
        protocol = table.one_protocol([x.key, metric.key])
        shown = base.with_values(table, [x.key, metric.key])
        x_axis = base.axis_of_numbers(x, shown)
        chart = Chart(
            key=f"line_{x.key}_{metric.key}",
            title=options.title or f"{metric.label} over {x.label}",
            x=x_axis,
            y=base.axis_of_numbers(metric, shown),
            marks=(*mean_lines(shown, x.key, metric.key, table), *failed_marks(table, x_axis, x.key)),
            caption=base.caption(table, len(shown), protocol, "Lines: mean; bands: 95 % bootstrap interval."),
        )
        tables = (
            base.summary_table("line", table, [metric.key], ["algorithm", "dataset", x.key]),
            base.raw_table("line_raw", table, [x.key, metric.key]),
        )
        return base.result_of(table, protocol, (chart,), tables, lacking=[x.key, metric.key])


def mean_lines(shown: pd.DataFrame, x: str, metric: str, table: RunTable) -> Iterator[Line | Points]:
    """For each algorithm and dataset a line of means with its band and markers; then the legend."""
    for (algorithm, dataset), rows in shown.groupby(["algorithm", "dataset"], sort=True):
        found = {float(value): summarise(base.number_column(group, metric)) for value, group in rows.groupby(x)}
        known = {value: summary for value, summary in found.items() if summary is not None}
        places = np.array(list(known))
        means = np.array([summary.mean for summary in known.values()])
        low, high = base.interval_ends(known.values())
        look = look_of(table, str(algorithm), str(dataset))
        yield Line(x=places, y=means, low=low, high=high, **look)
        texts = tuple(f"{summary.count} runs" for summary in known.values())
        yield Points(x=places, y=means, marker=table.marker(str(algorithm), str(dataset)), texts=texts, **look)
    yield from legend(table)
