"""Two columns against each other: one point for each run, colour by algorithm, marker by dataset."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Axis, Chart, Mark, Points
from slamhive.analysis.colours import algorithm_colours, dataset_markers
from slamhive.analysis.forms.base import (
    FORMS,
    Form,
    FormData,
    axis_of,
    caption,
    excluded_without,
    number_column,
    raw_table,
    require_runs,
    spans_decades,
)
from slamhive.analysis.forms.coverage_scale import CoverageScaleOptions, scaled_by_coverage
from slamhive.analysis.forms.places import failed_marks, places_on
from slamhive.analysis.result import FormResult
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput


class ScatterOptions(CoverageScaleOptions):
    """``x`` and ``y`` are keys of metrics, parameters or facts."""

    x: str = Field(description="Metric or parameter on the x axis.")
    y: str = Field(description="Metric or parameter on the y axis, with numbers.")


class Scatter(Form[ScatterOptions]):
    """The form ``scatter``."""

    key = "scatter"
    title = "Scatter"
    description = "Any two metrics or parameters against each other, one point for each run."
    options = ScatterOptions

    def needs(self, options: ScatterOptions) -> frozenset[str]:
        """Both axes."""
        return frozenset({options.x, options.y, "tracked_fraction"})

    def build(self, data: FormData, options: ScatterOptions) -> FormResult:
        """One chart and its raw data."""
        table = data.table
        require_runs(table)
        if options.x == options.y:
            raise InvalidInput(f"x and y are both {options.x!r}", "choose two different columns")
        x, y = table.column(options.x), table.numeric(options.y, "the y axis")
        protocol = table.one_protocol([x.key, y.key])
        table, scaling = scaled_by_coverage(table, [x.key, y.key], options)
        good = table.good()
        shown = good.dropna(subset=[x.key, y.key])
        x_axis = axis_of(
            x, log=x.numeric and spans_decades(number_column(shown, x.key)), values=table.frame[x.key].dropna()
        )
        chart = Chart(
            key=f"scatter_{x.key}_{y.key}",
            title=options.title or f"{y.label} over {x.label}",
            x=x_axis,
            y=axis_of(y, log=spans_decades(number_column(shown, y.key))),
            marks=(*_points(shown, x_axis, x.key, y.key, table), *failed_marks(table, x_axis, x.key)),
            caption=caption(table, len(shown), protocol, scaling),
        )
        return FormResult(
            charts=(chart,),
            tables=(raw_table(chart.key, table, [x.key, y.key]),),
            runs=len(table.frame),
            failed=len(table.failed()),
            excluded=excluded_without(good, [x.key, y.key], table.columns),
            protocol=protocol,
        )


def _points(shown: pd.DataFrame, axis: Axis, x: str, y: str, table: RunTable) -> Iterator[Mark]:
    colours = algorithm_colours(table.frame["algorithm"])
    markers = dataset_markers(table.frame["dataset"])
    for (algorithm, dataset), rows in shown.groupby(["algorithm", "dataset"], sort=True):
        yield Points(
            name=f"{algorithm} on {dataset}",
            x=places_on(axis, rows[x]),
            y=number_column(rows, y),
            colour=colours[algorithm],
            marker=markers[dataset],
            runs=rows["run_id"].to_numpy(dtype=int),
        )


FORMS.register(Scatter.key, Scatter())
