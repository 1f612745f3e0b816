"""Scatter plots of two or three columns, and the Pareto front of several metrics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from pydantic import Field, model_validator

from slamhive.analysis.chart import (
    FAILED_MARKER,
    MARKERS,
    MARKERS_IN_SPACE,
    REFERENCE,
    Array,
    Axis,
    Chart,
    Line,
    Points,
    rule_words,
)
from slamhive.analysis.plot_types import base
from slamhive.analysis.plot_types.coverage import CoverageScaleOptions, scaled_by_coverage
from slamhive.analysis.plot_types.looks import disturbed_rings, failed_marks, legend, look_of, places_on
from slamhive.analysis.report import PlotResult, ResultTable, TableColumn
from slamhive.analysis.table import FAILED, UNDER_LIMITS, Column, RunTable
from slamhive.base.errors import InvalidInput
from slamhive.documents.model import explained
from slamhive.domain.metrics import Direction

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


# The Pareto front: configurations that no other configuration beats in all metrics at once.


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
        points_are = "sets of configuration, limits" if table.varied_limits else "pairs of configuration"
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
                f"One point for each of {len(means)} {points_are} and dataset (mean over good runs). Outlined"
                f"{joined}: the {int(front.sum())} that no other on the same dataset beats in {', '.join(beaten)}.",
            ),
        )
        table_columns = [
            TableColumn("algorithm", "Algorithm"),
            TableColumn("dataset", "Dataset"),
            TableColumn("configuration_id", "Configuration"),
            *([TableColumn(UNDER_LIMITS, "Limits")] if table.varied_limits else []),
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
    """One row per configuration, limits and dataset that has all metrics: means over good runs, runs, failures."""
    keys = ["algorithm", "dataset", "configuration_id", UNDER_LIMITS]
    frame = table.with_limits()
    good = frame[frame[FAILED].isna()].dropna(subset=metrics)
    means = good.groupby(keys, sort=True)[metrics].mean()
    means["good"] = good.groupby(keys, sort=True).size()
    counts = frame.groupby(keys, sort=True)[FAILED].agg(["size", "count"])
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
                f"configuration {row.configuration_id}{row.under_limits and f', {row.under_limits}'}: "
                f"{row.good} good of {row.runs} runs"
                for row in rows.itertuples(index=False)
            ),
        )
    yield from legend(table)
