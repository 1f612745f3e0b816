"""Three columns against each other in space, one point for each run."""

from __future__ import annotations

from collections.abc import Iterator

import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import Axis, Chart, Points
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
from slamhive.analysis.forms.places import places_on
from slamhive.analysis.result import FormResult
from slamhive.analysis.table import RunTable
from slamhive.errors import InvalidInput


class Scatter3dOptions(CoverageScaleOptions):
    """``x`` and ``y`` may hold words, ``z`` holds numbers."""

    x: str = Field(description="Metric or parameter on the x axis.")
    y: str = Field(description="Metric or parameter on the y axis.")
    z: str = Field(description="Metric or parameter upwards, with numbers.")


class Scatter3d(Form[Scatter3dOptions]):
    """The form ``scatter_3d``."""

    key = "scatter_3d"
    title = "Scatter in 3D"
    description = "Any three metrics or parameters against each other, colour by algorithm, marker by dataset."
    options = Scatter3dOptions

    def needs(self, options: Scatter3dOptions) -> frozenset[str]:
        """All three axes."""
        return frozenset({options.x, options.y, options.z, "tracked_fraction"})

    def build(self, data: FormData, options: Scatter3dOptions) -> FormResult:
        """One chart and its raw data."""
        table = data.table
        require_runs(table)
        keys = [options.x, options.y, options.z]
        if len(set(keys)) < len(keys):
            raise InvalidInput(f"two axes are the same: {', '.join(keys)}", "choose three different columns")
        columns = [table.column(options.x), table.column(options.y), table.numeric(options.z, "the z axis")]
        protocol = table.one_protocol(keys)
        table, scaling = scaled_by_coverage(table, keys, options)
        good = table.good()
        shown = good.dropna(subset=keys)
        axes = [
            axis_of(
                column,
                log=column.numeric and spans_decades(number_column(shown, column.key)),
                values=shown[column.key],
            )
            for column in columns
        ]
        chart = Chart(
            key=f"scatter_3d_{'_'.join(keys)}",
            title=options.title or f"{columns[2].label} over {columns[0].label} and {columns[1].label}",
            x=axes[0],
            y=axes[1],
            z=axes[2],
            marks=tuple(_points(shown, keys, axes, table)),
            caption=caption(table, len(shown), protocol, "The raw data names the failed runs.", scaling),
            height=1.4,
        )
        return FormResult(
            charts=(chart,),
            tables=(raw_table(chart.key, table, keys),),
            runs=len(table.frame),
            failed=len(table.failed()),
            excluded=excluded_without(good, keys, table.columns),
            protocol=protocol,
        )


def _points(shown: pd.DataFrame, keys: list[str], axes: list[Axis], table: RunTable) -> Iterator[Points]:
    colours = algorithm_colours(table.frame["algorithm"])
    markers = dataset_markers(table.frame["dataset"])
    for (algorithm, dataset), rows in shown.groupby(["algorithm", "dataset"], sort=True):
        x, y, z = (places_on(axis, rows[key]) for axis, key in zip(axes, keys, strict=True))
        yield Points(
            name=f"{algorithm} on {dataset}",
            x=x,
            y=y,
            z=z,
            colour=colours[str(algorithm)],
            marker=markers[str(dataset)],
            runs=rows["run_id"].to_numpy(dtype=int),
        )


FORMS.register(Scatter3d.key, Scatter3d())
