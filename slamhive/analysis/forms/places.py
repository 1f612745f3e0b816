"""Where values lie on an axis, and the marks that all charts over a parameter or a name share."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from slamhive.analysis.chart import Array, Axis, FailedRuns
from slamhive.analysis.colours import algorithm_colours
from slamhive.analysis.table import RunTable


def places_on(axis: Axis, values: pd.Series) -> Array:
    """Values as numbers; of categories, their positions (NaN where there is none)."""
    if axis.categories is None:
        return np.asarray(values, dtype=float)
    position = {name: float(place) for place, name in enumerate(axis.categories)}
    return np.array([position.get(str(value), np.nan) for value in values], dtype=float)


def failed_marks(table: RunTable, axis: Axis, key: str) -> Iterator[FailedRuns]:
    """Failed runs by algorithm, at their place on the x axis: a parameter they do have, a metric they do not."""
    colours = algorithm_colours(table.frame["algorithm"])
    for algorithm, rows in table.failed().groupby("algorithm", sort=True):
        yield FailedRuns(
            x=places_on(axis, rows[key]),
            runs=rows["run_id"].to_numpy(dtype=int),
            colour=colours[str(algorithm)],
            name=f"{algorithm}, failed",
        )


def value_words(value: object) -> str:
    """A value as axes and tables show it: 20, not 20.0."""
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
