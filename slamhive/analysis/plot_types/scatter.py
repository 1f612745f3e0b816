"""Scatter plots of two or three columns: one point per run, colour by algorithm, marker by dataset."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from pydantic import Field

from slamhive.analysis.chart import FAILED_MARKER, MARKERS, MARKERS_IN_SPACE, Axis, Chart, Points
from slamhive.analysis.density import rule_words
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.coverage import CoverageScaleOptions, scaled_by_coverage
from slamhive.analysis.plot_types.looks import disturbed_rings, failed_marks, legend, look_of, places_on
from slamhive.analysis.report import PlotResult
from slamhive.analysis.table import Column, RunTable
from slamhive.base.errors import InvalidInput

_NAMES = "xyz"
_FAILED_HEIGHT = 1.2
"""Where the paper of SLAM Hive draws failed runs, times the largest value."""


class ScatterOptions(CoverageScaleOptions):
    """``x`` and ``y`` are keys of metrics, parameters or facts."""

    x: str = Field(description="Metric or parameter on the x axis.")
    y: str = Field(description="Metric or parameter on the y axis; numeric.")


class Scatter3dOptions(ScatterOptions):
    """``x`` and ``y`` may be text, ``z`` is numeric."""

    y: str = Field(description="Metric or parameter on the y axis.")
    z: str = Field(description="Metric or parameter on the z axis; numeric.")


class Scatter(base.PlotType[ScatterOptions]):
    """The plot type ``scatter``."""

    key = "scatter"
    title = "Scatter"
    description = "Any two metrics or parameters against each other, one point per run."
    options = ScatterOptions
    column_options = ("x", "y")
    reads = frozenset({"tracked_fraction"})

    def build(self, data: base.PlotData, options: ScatterOptions) -> PlotResult:
        """One plot and its raw data."""
        cloud = _cloud(data.table.require_runs(), [options.x, options.y], options)
        x, y = cloud.columns
        chart = Chart(
            key=f"scatter_{x.key}_{y.key}",
            title=options.title or f"{y.label} over {x.label}",
            x=cloud.axes[0],
            y=cloud.axes[1],
            marks=(*cloud.points(), *failed_marks(cloud.table, cloud.axes[0], x.key), *legend(cloud.table)),
            caption=base.caption(
                cloud.table, len(cloud.shown), cloud.protocol, cloud.scaling, rule_words(len(cloud.shown))
            ),
        )
        return cloud.result(chart)


class Scatter3d(base.PlotType[Scatter3dOptions]):
    """The plot type ``scatter_3d``."""

    key = "scatter_3d"
    title = "Scatter in 3D"
    description = "Any three metrics or parameters against each other, colour by algorithm, marker by dataset."
    options = Scatter3dOptions
    column_options = ("x", "y", "z")
    reads = frozenset({"tracked_fraction"})

    def build(self, data: base.PlotData, options: Scatter3dOptions) -> PlotResult:
        """One plot and its raw data."""
        table = data.table.require_runs()
        if len(table.markers) > MARKERS_IN_SPACE:
            table = replace(table, markers=dict.fromkeys(table.markers, MARKERS[0]))
        cloud = _cloud(table, [options.x, options.y, options.z], options)
        x, y, z = cloud.columns
        chart = Chart(
            key=f"scatter_3d_{'_'.join(cloud.keys)}",
            title=options.title or f"{z.label} over {x.label} and {y.label}",
            x=cloud.axes[0],
            y=cloud.axes[1],
            z=cloud.axes[2],
            marks=(*cloud.points(), *cloud.failed_points(), *legend(cloud.table)),
            caption=base.caption(
                cloud.table,
                len(cloud.shown),
                cloud.protocol,
                "Crosses: failed runs, at 1.2 times the largest value.",
                cloud.scaling,
                rule_words(len(cloud.shown), space=True),
            ),
            height=1.4,
        )
        return cloud.result(chart)


@dataclass(frozen=True, slots=True)
class _Cloud:
    """Good runs that have a value on each axis.

    Attributes:
        table: The selected runs, with errors scaled by coverage on request.
        columns: The columns of the axes; the last one is numeric.
        axes: Logarithmic where values span decades; categories for text.
        shown: The rows that become points.
        protocol: In words; None if no axis depends on one.
        scaling: A sentence on the scaling by coverage for the caption; may be empty.
    """

    table: RunTable
    columns: tuple[Column, ...]
    axes: tuple[Axis, ...]
    shown: pd.DataFrame
    protocol: str | None
    scaling: str

    @property
    def keys(self) -> list[str]:
        """The keys of the columns."""
        return [column.key for column in self.columns]

    def points(self) -> Iterator[Points]:
        """The points, with colour by algorithm and marker by dataset."""
        for (algorithm, dataset), rows in self.shown.groupby(["algorithm", "dataset"], sort=True):
            x, y, *z = (places_on(axis, rows[key]) for axis, key in zip(self.axes, self.keys, strict=True))
            yield Points(
                **look_of(self.table, str(algorithm), str(dataset)),
                x=x,
                y=y,
                z=z[0] if z else None,
                marker=self.table.marker(str(algorithm), str(dataset)),
                runs=rows["run_id"].to_numpy(dtype=int),
            )

        places = [places_on(axis, self.shown[key]) for axis, key in zip(self.axes, self.keys, strict=True)]
        yield from disturbed_rings(self.shown, *places)

    def failed_points(self) -> Iterator[Points]:
        """Failed runs in space, above all others: they have parameters, but no value on the last axis.

        Those without a value on another axis are left out; the raw data lists them.
        """
        heights = base.number_column(self.shown, self.keys[-1])
        failed = self.table.failed().dropna(subset=self.keys[:-1])
        for algorithm, rows in failed.groupby("algorithm", sort=True) if len(heights) else ():
            x, y = (places_on(axis, rows[key]) for axis, key in zip(self.axes[:2], self.keys[:2], strict=True))
            yield Points(
                f"{algorithm}, failed",
                x,
                y,
                z=np.full(len(rows), _FAILED_HEIGHT * heights.max()),
                colour=self.table.colours[str(algorithm)],
                marker=FAILED_MARKER,
                runs=rows["run_id"].to_numpy(dtype=int),
                in_legend=False,
                group=str(algorithm),
            )

    def result(self, chart: Chart) -> PlotResult:
        """The plot with its raw data."""
        raw = base.raw_table(chart.key, self.table, self.keys)
        return base.result_of(self.table, self.protocol, (chart,), (raw,), lacking=self.keys)


def _cloud(table: RunTable, keys: list[str], options: CoverageScaleOptions) -> _Cloud:
    """The runs over the columns ``keys``; raises InvalidInput or NotFound if a column does not fit."""
    if len(set(keys)) < len(keys):
        named = " and ".join(_NAMES[place] for place, key in enumerate(keys) if keys.count(key) > 1)
        twice = next(key for key in keys if keys.count(key) > 1)
        raise InvalidInput(f"{named} are both {twice!r}", "choose different columns")
    last = _NAMES[len(keys) - 1]
    columns = (*(table.column(key) for key in keys[:-1]), table.numeric(keys[-1], f"the {last} axis"))
    protocol = table.one_protocol(keys)
    table, scaling = scaled_by_coverage(table, keys, options)
    shown = base.with_values(table, keys)
    axes = tuple(
        base.axis_of(
            column,
            log=column.numeric and base.spans_decades(base.number_column(shown, column.key)),
            values=table.frame[column.key].dropna(),
        )
        for column in columns
    )
    return _Cloud(table, columns, axes, shown, protocol, scaling)
