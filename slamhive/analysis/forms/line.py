"""A metric over one parameter: the mean of each value with its interval, one line for each algorithm and dataset."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Chart, Line, Points
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    FormOptions,
    axis_of,
    caption,
    number_column,
    raw_table,
    require_runs,
    result_of,
    spans_decades,
    summary_table,
    with_values,
)
from slamhive.analysis.forms.places import failed_marks, legend, look_of
from slamhive.analysis.result import FormResult
from slamhive.analysis.statistics import summarise
from slamhive.analysis.table import RunTable


class LineOptions(FormOptions):
    """``x`` is a parameter with numbers."""

    x: str = Field(description="Parameter on the x axis, with numbers.")
    metric: str = Field(default="ate.rmse", description="What is averaged at each value.")


class LineForm(Form[LineOptions]):
    """The plot type ``line``."""

    key = "line"
    title = "Over a parameter"
    description = "The mean of a metric over a parameter with its 95 % interval, all repeats counted."
    options = LineOptions

    def needs(self, options: LineOptions) -> frozenset[str]:
        """The parameter and the metric."""
        return frozenset({options.x, options.metric})

    def build(self, data: FormData, options: LineOptions) -> FormResult:
        """One plot, the table of means, the raw data."""
        table = data.table
        require_runs(table)
        x, metric = table.numeric(options.x, "the x axis"), table.numeric(options.metric, "a mean")
        protocol = table.one_protocol([x.key, metric.key])
        shown = with_values(table, [x.key, metric.key])
        x_axis = axis_of(x, log=spans_decades(number_column(shown, x.key)))
        chart = Chart(
            key=f"line_{x.key}_{metric.key}",
            title=options.title or f"{metric.label} over {x.label}",
            x=x_axis,
            y=axis_of(metric, log=spans_decades(number_column(shown, metric.key))),
            marks=(*mean_lines(shown, x.key, metric.key, table), *failed_marks(table, x_axis, x.key)),
            caption=caption(table, len(shown), protocol, "Lines: mean; bands: 95 % bootstrap interval of the mean."),
        )
        tables = (
            summary_table("line", table, [metric.key], ["algorithm", "dataset", x.key]),
            raw_table("line_raw", table, [x.key, metric.key]),
        )
        return result_of(table, protocol, (chart,), tables, lacking=[x.key, metric.key])


def mean_lines(shown: pd.DataFrame, x: str, metric: str, table: RunTable) -> Iterator[Line | Points]:
    """For each algorithm and dataset the line of means with its band, a marker at each mean, and the legend."""
    for (algorithm, dataset), rows in shown.groupby(["algorithm", "dataset"], sort=True):
        found = [(float(value), summarise(number_column(group, metric))) for value, group in rows.groupby(x, sort=True)]
        known = [(value, summary) for value, summary in found if summary is not None]
        places = np.array([value for value, _ in known])
        means = np.array([summary.mean for _, summary in known])
        ends = [(s.mean, s.mean) if s.interval is None else (s.interval.low, s.interval.high) for _, s in known]
        low, high = np.array(ends).reshape(-1, 2).T
        look = look_of(table, str(algorithm), str(dataset))
        yield Line(x=places, y=means, low=low, high=high, **look)
        texts = tuple(f"{summary.count} runs" for _, summary in known)
        yield Points(x=places, y=means, marker=table.markers[str(dataset)], texts=texts, **look)
    yield from legend(table)


FORMS.register(LineForm.key, LineForm())
