"""Plots of many points: a density in place of points, and the rows of failed runs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from slamhive.analysis.chart import Array, Axis, Chart, Density, FailedRuns, Mark, Points

DENSITY_FROM = 10_000
"""A plot with more points shows their density: single points would overlap and draw slowly."""

SINGLE_MOST = 1_500
"""Points in sparse regions that stay single points beside a density."""

SPACE_MOST = 20_000
"""Most points in three dimensions, where a density would hide what is behind it."""

COLUMNS, ROWS = 180, 110
SHARES_OF_A_CATEGORY = 5
NEIGHBOURS = 4
"""Number of cells on each side of a cell in its neighbourhood."""

FAILED_ROWS = 5
FAILED_COLUMNS = 300


def rule_words(count: int, *, space: bool = False) -> str:
    """A sentence for the caption if a plot does not draw each of ``count`` points; else empty."""
    if space:
        every = -(-count // SPACE_MOST)
        return f"The plot shows one of {every} points." if every > 1 else ""
    if count <= DENSITY_FROM:
        return ""
    return (
        f"More than {DENSITY_FROM:,} points: shades show the number of runs in each cell of a grid, single points "
        "lie in sparse regions. Zoom in on the page to see all points."
    )


def thinned(chart: Chart) -> Chart:
    """The plot with as many marks as a reader can distinguish; unchanged if it has few points."""
    clouds = [mark for mark in chart.marks if isinstance(mark, Points) and not mark.ring]
    count = sum(len(mark.x) for mark in clouds)
    marks = tuple(_told_apart(mark, chart) if isinstance(mark, FailedRuns) else mark for mark in chart.marks)
    if chart.z is not None and count > SPACE_MOST:
        every = -(-count // SPACE_MOST)
        marks = tuple(_chosen(mark, np.arange(0, len(mark.x), every)) if mark in clouds else mark for mark in marks)
    elif chart.z is None and count > DENSITY_FROM:
        dense: list[Mark] = []
        grid = grid_of(clouds, chart)
        rows, columns = len(grid.y_edges) - 1, len(grid.x_edges) - 1
        binned = [_Binned(mark, _cells(mark, chart, grid)) for mark in clouds if len(mark.x)]
        counts = np.zeros(rows * columns, dtype=int)
        for entry in binned:
            counts += np.bincount(entry.cells[entry.cells >= 0], minlength=rows * columns)
        sparse = _apart(counts.reshape(rows, columns)).ravel()
        groups: dict[str, list[_Binned]] = {}
        for entry in binned:
            groups.setdefault(entry.mark.group or entry.mark.name, []).append(entry)
        most = int(counts[~sparse].max(initial=1))
        for name, entries in groups.items():
            held = np.zeros(rows * columns, dtype=int)
            for entry in entries:
                held += np.bincount(entry.cells[entry.cells >= 0], minlength=rows * columns)
            held[sparse] = 0
            colour = entries[0].mark.colour
            dense.append(Density(name, grid.x_edges, grid.y_edges, held.reshape(rows, columns), most, colour, name))
        for entry in binned:
            apart = np.flatnonzero((entry.cells >= 0) & sparse[entry.cells])
            dense.append(_chosen(entry.mark, apart))
        marks = (*dense, *(mark for mark in marks if not isinstance(mark, Points) or not len(mark.x)))
        return replace(chart, marks=marks, x=_numbered(chart.x), y=_numbered(chart.y))
    return replace(chart, marks=marks)


def _numbered(axis: Axis) -> Axis:
    return axis if axis.categories is None else replace(axis, numbered=True)


class Grid(NamedTuple):
    """Edges of cells, in the units of the axes, or their logarithms for logarithmic axes."""

    x_edges: Array
    y_edges: Array


def grid_of(clouds: list[Points], chart: Chart) -> Grid:
    """A grid over all points."""
    x = np.concatenate([on_page(mark.x, chart.x) for mark in clouds])
    y = np.concatenate([on_page(mark.y, chart.y) for mark in clouds])
    known = np.isfinite(x) & np.isfinite(y)
    return Grid(_edges(x[known], chart.x, COLUMNS), _edges(y[known], chart.y, ROWS))


def on_page(values: Array, axis: Axis) -> Array:
    """Positions on a linear scale: logarithms for a logarithmic axis, NaN for values that it cannot show."""
    places: Array = np.asarray(values, dtype=float)
    return np.log10(np.where(places > 0, places, np.nan)) if axis.log else places


def failed_rows(mark: FailedRuns, chart: Chart) -> Array:
    """Heights from 0 to 1 in the band of failures, spread so that runs with equal x do not overlap."""
    marks = [other for other in chart.marks if isinstance(other, FailedRuns)]
    place = next(place for place, other in enumerate(marks) if other is mark)
    rows = FAILED_ROWS * len(marks)
    return ((np.arange(len(mark.x)) * len(marks) + place) % rows + 0.5) / rows


@dataclass(frozen=True, slots=True)
class _Binned:
    mark: Points
    cells: Array
    """The cell of each point, -1 for points outside."""


def _cells(mark: Points, chart: Chart, grid: Grid) -> Array:
    x, y = on_page(mark.x, chart.x), on_page(mark.y, chart.y)
    columns = np.clip(np.searchsorted(grid.x_edges, x, side="right") - 1, 0, len(grid.x_edges) - 2)
    rows = np.clip(np.searchsorted(grid.y_edges, y, side="right") - 1, 0, len(grid.y_edges) - 2)
    known = np.isfinite(x) & np.isfinite(y)
    return np.where(known, rows * (len(grid.x_edges) - 1) + columns, -1)


def _apart(counts: Array) -> Array:
    """The cells with the sparsest neighbourhoods, which contain at most :data:`SINGLE_MOST` points together."""
    sums = np.pad(counts, NEIGHBOURS).cumsum(axis=0).cumsum(axis=1)
    sums = np.pad(sums, ((1, 0), (1, 0)))
    wide = 2 * NEIGHBOURS + 1
    around = sums[wide:, wide:] - sums[:-wide, wide:] - sums[wide:, :-wide] + sums[:-wide, :-wide]
    order = np.argsort(around, axis=None, kind="stable")
    chosen = np.zeros(counts.size, dtype=bool)
    chosen[order[counts.ravel()[order].cumsum() <= SINGLE_MOST]] = True
    return chosen.reshape(counts.shape)


def _edges(values: Array, axis: Axis, count: int) -> Array:
    if axis.categories is not None:
        places = len(axis.categories)
        return np.linspace(-0.5, places - 0.5, places * SHARES_OF_A_CATEGORY + 1)
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 1.0)
    if high <= low:
        low, high = low - 0.5, high + 0.5
    return np.linspace(low, high, count + 1)


def _told_apart(mark: FailedRuns, chart: Chart) -> FailedRuns:
    """The failed runs without those that would cover each other."""
    places = on_page(mark.x, chart.x)
    known = np.isfinite(places)
    if known.sum() <= SINGLE_MOST:
        return mark
    low, high = places[known].min(), places[known].max()
    columns = np.zeros(len(places)) if high <= low else np.floor((places - low) / (high - low) * FAILED_COLUMNS)
    rows = np.arange(len(places)) % FAILED_ROWS
    cells = np.where(known, columns * FAILED_ROWS + rows, -1)
    _, first = np.unique(cells, return_index=True)
    kept = np.sort(first[known[first]])
    return replace(mark, x=mark.x[kept], runs=mark.runs[kept], count=mark.total)


def _chosen(mark: Points, rows: Array) -> Points:
    def part(values: Array | None) -> Array | None:
        return None if values is None else values[rows]

    return replace(
        mark,
        x=mark.x[rows],
        y=mark.y[rows],
        z=part(mark.z),
        low=part(mark.low),
        high=part(mark.high),
        runs=part(mark.runs),
        shades=part(mark.shades),
        texts=None if mark.texts is None else tuple(mark.texts[row] for row in rows),
    )
