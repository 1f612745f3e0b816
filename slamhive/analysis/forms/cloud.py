"""Runs as points over two or three columns: what the scatter diagrams share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pandas as pd

from slamhive.analysis.chart import Axis, Chart, Points
from slamhive.analysis.forms.base import (
    axis_of,
    number_column,
    raw_table,
    require_runs,
    result_of,
    spans_decades,
    with_values,
)
from slamhive.analysis.forms.coverage_scale import CoverageScaleOptions, scaled_by_coverage
from slamhive.analysis.forms.places import disturbed_rings, look_of, places_on
from slamhive.analysis.result import FormResult
from slamhive.analysis.table import Column, RunTable
from slamhive.errors import InvalidInput

NAMES = "xyz"


@dataclass(frozen=True, slots=True)
class Cloud:
    """Good runs that have a value on each axis.

    Attributes:
        table: The selected runs, errors scaled by coverage if that is asked.
        columns: What the axes show; the last one holds numbers.
        axes: Logarithmic where values spread over decades, with categories where they are words.
        shown: The rows that become points.
        protocol: In words; None if no axis depends on one.
        scaling: What a caption says of the scaling by coverage.
    """

    table: RunTable
    columns: tuple[Column, ...]
    axes: tuple[Axis, ...]
    shown: pd.DataFrame
    protocol: str | None
    scaling: str

    @property
    def keys(self) -> list[str]:
        """The columns' keys."""
        return [column.key for column in self.columns]

    def points(self) -> Iterator[Points]:
        """Colour by algorithm, marker by dataset."""
        for (algorithm, dataset), rows in self.shown.groupby(["algorithm", "dataset"], sort=True):
            x, y, *z = (places_on(axis, rows[key]) for axis, key in zip(self.axes, self.keys, strict=True))
            yield Points(
                **look_of(self.table, str(algorithm), str(dataset)),
                x=x,
                y=y,
                z=z[0] if z else None,
                marker=self.table.markers[str(dataset)],
                runs=rows["run_id"].to_numpy(dtype=int),
            )

        places = [places_on(axis, self.shown[key]) for axis, key in zip(self.axes, self.keys, strict=True)]
        yield from disturbed_rings(self.shown, *places)

    def result(self, chart: Chart) -> FormResult:
        """The plot with its raw data."""
        raw = raw_table(chart.key, self.table, self.keys)
        return result_of(self.table, self.protocol, (chart,), (raw,), lacking=self.keys)


def cloud_of(table: RunTable, keys: list[str], options: CoverageScaleOptions) -> Cloud:
    """The runs over the columns ``keys``; raises InvalidInput or NotFound for columns that do not fit."""
    require_runs(table)
    if len(set(keys)) < len(keys):
        named = " and ".join(NAMES[place] for place, key in enumerate(keys) if keys.count(key) > 1)
        twice = next(key for key in keys if keys.count(key) > 1)
        raise InvalidInput(f"{named} are both {twice!r}", "choose different columns")
    last = NAMES[len(keys) - 1]
    columns = (*(table.column(key) for key in keys[:-1]), table.numeric(keys[-1], f"the {last} axis"))
    protocol = table.one_protocol(keys)
    table, scaling = scaled_by_coverage(table, keys, options)
    shown = with_values(table, keys)
    axes = tuple(
        axis_of(
            column,
            log=column.numeric and spans_decades(number_column(shown, column.key)),
            values=table.frame[column.key].dropna(),
        )
        for column in columns
    )
    return Cloud(table, columns, axes, shown, protocol, scaling)
