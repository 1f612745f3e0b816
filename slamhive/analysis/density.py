"""Where many points go: the density of more than can be drawn one by one, and the rows of failed runs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.analysis.chart import Array, Chart, FailedRuns

COLUMNS, ROWS = 240, 160
FAILED_ROWS = 5


@dataclass(frozen=True, slots=True)
class Density:
    """Counts by row (y), then column (x), and the middles of the cells in the units of the axes."""

    x_centres: Array
    y_centres: Array
    counts: Array


def bin_points(x: Array, y: Array, *, log_x: bool = False, log_y: bool = False) -> Density:
    """Count the points in a grid that spans them; cells of a logarithmic axis are equally wide on the page.

    Args:
        x: (n,) places; points with a NaN are left out.
        y: (n,) places.
        log_x: The x axis is logarithmic; places of 0 and below are left out.
        log_y: The same for y.
    """
    kept = np.isfinite(x) & np.isfinite(y)
    if log_x:
        kept &= x > 0
    if log_y:
        kept &= y > 0
    u, v = x[kept].astype(float), y[kept].astype(float)
    u, v = (np.log10(u) if log_x else u), (np.log10(v) if log_y else v)
    counts, v_edges, u_edges = np.histogram2d(v, u, bins=(ROWS, COLUMNS))
    u_centres, v_centres = (u_edges[:-1] + u_edges[1:]) / 2, (v_edges[:-1] + v_edges[1:]) / 2
    return Density(10**u_centres if log_x else u_centres, 10**v_centres if log_y else v_centres, counts.astype(int))


def failed_rows(mark: FailedRuns, chart: Chart) -> Array:
    """Heights from 0 to 1 in the band of failures: spread out, so that runs at one place can be told apart."""
    marks = [other for other in chart.marks if isinstance(other, FailedRuns)]
    place = next(place for place, other in enumerate(marks) if other is mark)
    rows = FAILED_ROWS * len(marks)
    return ((np.arange(len(mark.x)) * len(marks) + place) % rows + 0.5) / rows
