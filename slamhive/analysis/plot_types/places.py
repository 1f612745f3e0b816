"""Positions of values on an axis, and marks that several plot types share."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from slamhive.analysis.chart import REFERENCE, Array, Axis, FailedRuns, Points
from slamhive.analysis.table import RunTable, is_disturbed

_NOWHERE = np.zeros(0)


def places_on(axis: Axis, values: pd.Series) -> Array:
    """Values as numbers; for categories, their positions (NaN where there is none)."""
    if axis.categories is None:
        return np.asarray(values, dtype=float)
    position = {name: float(place) for place, name in enumerate(axis.categories)}
    return np.array([position.get(str(value), np.nan) for value in values], dtype=float)


def failed_marks(table: RunTable, axis: Axis, key: str) -> Iterator[FailedRuns]:
    """Failed runs by algorithm, at their value on the x axis. They have parameters, but no metrics."""
    for algorithm, rows in table.failed().groupby("algorithm", sort=True):
        yield FailedRuns(
            x=places_on(axis, rows[key]),
            runs=rows["run_id"].to_numpy(dtype=int),
            colour=table.colours[str(algorithm)],
            name=f"{algorithm}, failed",
            group=str(algorithm),
        )


def disturbed_rings(shown: pd.DataFrame, x: Array, y: Array, z: Array | None = None) -> Iterator[Points]:
    """A ring around each run that was measured on a disturbed machine; hovering shows the disturbance.

    Args:
        shown: The rows behind the points.
        x, y, z: Positions of the points.
    """
    chosen = is_disturbed(shown).to_numpy(dtype=bool)
    if chosen.any():
        yield Points(
            "disturbed machine",
            x[chosen],
            y[chosen],
            z=None if z is None else z[chosen],
            colour=REFERENCE,
            runs=shown["run_id"].to_numpy(dtype=int)[chosen],
            texts=tuple(f"disturbed by {words}" for words in shown["disturbed"][chosen]),
            ring=True,
        )


def look_of(table: RunTable, algorithm: str, dataset: str) -> dict[str, Any]:
    """The look of one algorithm on one dataset; :func:`legend` explains it."""
    return {
        "name": f"{algorithm} on {dataset}",
        "colour": table.colours[algorithm],
        "in_legend": False,
        "group": algorithm,
    }


def legend(table: RunTable, *, markers: bool = True) -> Iterator[Points]:
    """Legend entries for the colours of algorithms and, if there are several, the markers of datasets.

    Args:
        table: The runs of the plot.
        markers: Whether the plot has markers.
    """
    algorithms = sorted(table.frame["algorithm"].unique())
    datasets = sorted(table.frame["dataset"].unique())
    shapes = {table.markers[name] for name in datasets} if markers else set()
    told_apart = len(shapes) > 1
    for name in algorithms:
        yield Points(name, _NOWHERE, _NOWHERE, colour=table.colours[name], marker=table.marker(name), group=name)
    for name in datasets if told_apart else ():
        yield Points(f"on {name}", _NOWHERE, _NOWHERE, colour=REFERENCE, marker=table.markers[name])


def settings_words(table: RunTable) -> pd.Series:
    """The settings of each run in words: the parameters that vary in the selection."""
    varied = [column.key for column in table.varied()]

    def words(row: pd.Series) -> str:
        return ", ".join(f"{key} {value_words(row[key])}" for key in varied if not pd.isna(row[key])) or "as given"

    unique = table.frame[["configuration_id", *varied]].drop_duplicates("configuration_id")
    named = dict(zip(unique["configuration_id"], unique.apply(words, axis=1), strict=True)) if len(unique) else {}
    return table.frame["configuration_id"].map(named)


def value_words(value: object) -> str:
    """A value as axes and tables show it: 20 instead of 20.0."""
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
