"""The content of a plot, independent of how it is drawn: marks and axes, and densities of many points.

:mod:`slamhive.analysis.plotly_chart` draws it for the screen, :mod:`slamhive.analysis.print_chart` for paper. Arrays
have one entry for each point, in the units of the axes.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field

from slamhive.documents.arrays import Array, Kind

# One colour and one marker for each algorithm, on every page and in every plot; markers of datasets; dark pages.


OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#B8A800")
"""M. Okabe and K. Ito, Color Universal Design (2008); the yellow is darkened to be seen on white, black is left out."""

PALETTE = (*OKABE_ITO, "#4A3B8F", "#7A2E00", "#00553E", "#8C3F6B", "#8A8F98", "#2B6E8F", "#6B6100")
"""The well separated colours first, then darker ones."""

RUN_COLOURS = (*PALETTE, "#B0413E", "#3E8E41", "#A87BD1", "#C77C4E", "#5F9EA0", "#D4577B")
"""Colours of single runs and configurations, where these are compared: as many as a comparison may have."""

MARKERS = (
    "circle", "square", "triangle-up", "diamond", "cross", "star", "triangle-down",
    "square-open", "triangle-up-open", "diamond-open", "cross-open", "triangle-down-open",
)  # fmt: skip
"""The markers of datasets; none looks like another one, or like that of failed or disturbed runs."""

MARKERS_IN_SPACE = 7
"""The first ones can be drawn in three dimensions; algorithms have these."""

FAILED_MARKER = "failed"
"""The marker of failed runs where they are points, in three dimensions."""

_SHADES = 3
_LIGHT_ENOUGH, _LEAST_CONTRAST = 0.18, 3.5
_DARK_PAGE = "#212529"


def algorithm_colours(names: Iterable[str], known: Iterable[str] = ()) -> dict[str, str]:
    """A colour for each algorithm.

    An algorithm that is not in ``known`` (installed) takes the next free colour if another of ``names`` has its own.
    """
    wanted, installed = set(names), frozenset(known)
    chosen = {name: colour_of(name, installed) for name in sorted(wanted & installed)}
    for name in sorted(wanted - installed):
        place = _place(name, installed)
        turns = [_colour(place + step) for step in range(_SHADES * len(RUN_COLOURS))]
        chosen[name] = next((colour for colour in turns if colour not in chosen.values()), turns[0])
    return dict(sorted(chosen.items()))


def colour_of(name: str, known: Iterable[str]) -> str:
    """The colour of one algorithm, by its place in the alphabet of the ``known`` (installed) ones.

    The first 60 have different colours. The colour of others follows from their name.
    """
    return _colour(_place(name, frozenset(known)))


def marker_of(name: str, known: Iterable[str]) -> str:
    """The marker of one algorithm, for plots in which markers do not mean datasets."""
    return MARKERS[_place(name, frozenset(known)) % MARKERS_IN_SPACE]


def dataset_markers(names: Iterable[str]) -> dict[str, str]:
    """A marker for each dataset by its place in the alphabet; circles for all if there are too many datasets."""
    ordered = sorted(set(names))
    shapes = MARKERS if len(ordered) <= len(MARKERS) else MARKERS[:1] * len(ordered)
    return dict(zip(ordered, shapes, strict=False))


@cache
def on_dark(colour: str) -> str:
    """The colour, with more white until it has a contrast of at least 3.5 : 1 on a dark page."""
    lighter = (_mixed(colour, 255, step / 20) for step in range(21))
    return next(mixed for mixed in lighter if contrast(mixed, _DARK_PAGE) >= _LEAST_CONTRAST)


def contrast(first: str, second: str) -> float:
    """The contrast of two colours, 1 to 21 (WCAG 2.2, relative luminance)."""
    low, high = sorted((_luminance(first), _luminance(second)))
    return (high + 0.05) / (low + 0.05)


def _place(name: str, known: frozenset[str]) -> int:
    return sorted(known).index(name) if name in known else zlib.crc32(name.encode())


def _colour(place: int) -> str:
    """Colour number ``place``: after 20 colours their darker or lighter shades follow, and then the others."""
    base = RUN_COLOURS[place % len(RUN_COLOURS)]
    turn = place // len(RUN_COLOURS) % _SHADES
    if not turn:
        return base
    darker = (_luminance(base) > _LIGHT_ENOUGH) == (turn == 1)
    return _mixed(base, 0 if darker else 255, 0.4)


def _mixed(colour: str, other: int, share: float) -> str:
    parts = (round((1 - share) * part + share * other) for part in _parts(colour))
    return "#" + "".join(f"{part:02X}" for part in parts)


def _luminance(colour: str) -> float:
    shares = (part / 255 for part in _parts(colour))
    linear = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def _parts(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[place : place + 2], 16) for place in (1, 3, 5))


REFERENCE = "reference"
"""The colour of ground truth: dark grey on white, light grey on black."""

PRINT_FORMATS = ("pdf", "svg", "png")
"""The file formats of :func:`slamhive.analysis.print_chart.print_chart`, whose module takes long to load."""
PAPER_FORMATS = ("88mm.pdf", "180mm.pdf")
"""Files of one and two columns of a paper, without title and caption, which LaTeX adds."""
THUMBNAIL = "small.png"
"""The ending of a picture without words, for the page on which an analysis is written."""
Font = Literal["serif", "sans"]


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis. ``categories`` makes it an axis of names, in that order.

    ``numbered``: the categories have the positions 0, 1, 2 ..., and marks may lie between them.
    """

    kind: Kind[Literal["Axis"]] = field(default="Axis", kw_only=True, repr=False)
    label: str
    unit: str = ""
    log: bool = False
    categories: tuple[str, ...] | None = None
    numbered: bool = False

    @property
    def title(self) -> str:
        """``ATE RMSE [m]``. Numbers of bytes have their unit at each number, such as 500 MB."""
        return titled(self.label, self.unit)


def titled(label: str, unit: str) -> str:
    """A label with its unit, unless the numbers beside it state one."""
    return f"{label} [{unit}]" if unit and unit != "bytes" else label


@dataclass(frozen=True, slots=True)
class Points:
    """Points, one for each run or summary. ``z`` is for plots in three dimensions.

    ``low`` and ``high`` are the ends of an interval of y. ``runs`` contains run ids (0 for none); a click opens the
    run. Hovering shows ``texts``. ``shades`` colours each point by a value, labelled ``shade_label``. A legend entry
    hides and shows all marks of its ``group``; a mark without points is only a legend entry.
    """

    kind: Kind[Literal["Points"]] = field(default="Points", kw_only=True, repr=False)
    name: str
    x: Array
    y: Array
    z: Array | None = None
    colour: str = OKABE_ITO[0]
    marker: str = MARKERS[0]
    low: Array | None = None
    high: Array | None = None
    runs: Array | None = None
    texts: tuple[str, ...] | None = None
    shades: Array | None = None
    shade_label: str = ""
    in_legend: bool = True
    group: str = ""
    emphasis: bool = False
    """Larger and outlined, for points of a front."""
    ring: bool = False
    """Open rings around points of other marks; they do not count as points."""


@dataclass(frozen=True, slots=True)
class FailedRuns:
    """Runs without a value of y: drawn in a band above the plot, at their value on the x axis.

    ``x`` is NaN for runs without a value on the x axis. ``count`` is the number of failed runs, if marks that would
    cover each other are left out.
    """

    kind: Kind[Literal["FailedRuns"]] = field(default="FailedRuns", kw_only=True, repr=False)
    x: Array
    runs: Array
    colour: str = OKABE_ITO[0]
    name: str = "failed"
    group: str = ""
    count: int | None = None

    @property
    def total(self) -> int:
        """Number of failed runs."""
        return len(self.x) if self.count is None else self.count


@dataclass(frozen=True, slots=True)
class Line:
    """A line, with a band between ``low`` and ``high`` if given; ``group`` as in :class:`Points`."""

    kind: Kind[Literal["Line"]] = field(default="Line", kw_only=True, repr=False)
    name: str
    x: Array
    y: Array
    z: Array | None = None
    low: Array | None = None
    high: Array | None = None
    colour: str = OKABE_ITO[0]
    dashed: bool = False
    steps: bool = False
    runs: int = 0
    in_legend: bool = True
    group: str = ""


@dataclass(frozen=True, slots=True)
class Bars:
    """One bar for each category of the x axis (NaN: no bar). ``striped`` is for failures.

    ``medians`` are lines across the bars. ``texts`` appear above bars without an interval, and when hovering.
    ``colours`` apply to single bars.
    """

    kind: Kind[Literal["Bars"]] = field(default="Bars", kw_only=True, repr=False)
    name: str
    heights: Array
    low: Array | None = None
    high: Array | None = None
    colour: str = OKABE_ITO[0]
    striped: bool = False
    texts: tuple[str, ...] | None = None
    colours: tuple[str, ...] | None = None
    medians: Array | None = None


@dataclass(frozen=True, slots=True)
class Boxes:
    """A box with points for each of ``categories``: quartiles, whiskers up to 1.5 times the interquartile range."""

    kind: Kind[Literal["Boxes"]] = field(default="Boxes", kw_only=True, repr=False)
    name: str
    categories: tuple[str, ...]
    values: Array
    runs: Array | None = None
    colour: str = OKABE_ITO[0]


@dataclass(frozen=True, slots=True)
class Cells:
    """A heat map over the categories of both axes: ``values`` and ``texts`` by row (y), then column (x); NaN is empty.

    ``log`` makes the colour scale logarithmic; ``lower_is_better`` selects the dark end. ``span`` is the range of the
    colour scale, to compare several maps; None for the range of these values.
    """

    kind: Kind[Literal["Cells"]] = field(default="Cells", kw_only=True, repr=False)
    values: Array
    texts: tuple[tuple[str, ...], ...]
    label: str
    unit: str = ""
    log: bool = False
    lower_is_better: bool = True
    span: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Density:
    """The number of points of one colour in the cells of a grid, drawn from pale to full over decades.

    ``counts`` by row (y), then column (x); the full colour means ``most`` points. Edges are in the units of the axes,
    or their logarithms for logarithmic axes.
    """

    kind: Kind[Literal["Density"]] = field(default="Density", kw_only=True, repr=False)
    name: str
    x_edges: Array
    y_edges: Array
    counts: Array
    most: int
    colour: str = OKABE_ITO[0]
    group: str = ""


@dataclass(frozen=True, slots=True)
class Segments:
    """Lines from (x0, y0) to (x1, y1), such as the bars of a critical-difference diagram."""

    kind: Kind[Literal["Segments"]] = field(default="Segments", kw_only=True, repr=False)
    x0: Array
    y0: Array
    x1: Array
    y1: Array
    name: str = ""
    colour: str = REFERENCE
    width: float = 1.5
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Labels:
    """Text at positions; ``anchor`` is the side of the text that is at the position."""

    kind: Kind[Literal["Labels"]] = field(default="Labels", kw_only=True, repr=False)
    x: Array
    y: Array
    texts: tuple[str, ...]
    anchor: str = "left"


@dataclass(frozen=True, slots=True)
class Dimension:
    """One axis of parallel coordinates; values of categories are positions in ``axis.categories``."""

    kind: Kind[Literal["Dimension"]] = field(default="Dimension", kw_only=True, repr=False)
    axis: Axis
    values: Array


@dataclass(frozen=True, slots=True)
class Parallel:
    """Parallel coordinates: one line per run through all dimensions, coloured by ``shades``."""

    kind: Kind[Literal["Parallel"]] = field(default="Parallel", kw_only=True, repr=False)
    dimensions: tuple[Dimension, ...]
    shades: Array
    shade_axis: Axis
    runs: Array


def file_key(text: str) -> str:
    """The key of a plot or table for the name of its files, reduced to letters, digits, ``_``, ``.`` and ``-``."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text)[:100]


MOST_THICK = 12
"""A plot with more lines draws them thin."""

Mark = Points | FailedRuns | Line | Bars | Boxes | Cells | Density | Segments | Labels | Parallel


@dataclass(frozen=True, slots=True)
class Chart:
    """One plot. ``caption`` states the number of runs, failures and protocol.

    ``key`` names its files, reduced to letters, digits, ``_``, ``.`` and ``-``. ``equal_aspect`` gives all axes one
    scale, for trajectories. ``bare`` omits the axes.
    """

    kind: Kind[Literal["Chart"]] = field(default="Chart", kw_only=True, repr=False)
    key: str
    title: str
    x: Axis
    y: Axis
    marks: tuple[Annotated[Mark, Field(discriminator="kind")], ...]
    caption: str
    z: Axis | None = None
    equal_aspect: bool = False
    bare: bool = False
    height: float = 1.0
    """Relative to the default height."""
    least_width_px: int = 0
    """Text would overlap in a narrower plot; a small screen scrolls it."""

    def __post_init__(self) -> None:
        if self.marks:
            object.__setattr__(self, "least_width_px", max(_least_width_px(mark, self) for mark in self.marks))
        object.__setattr__(self, "key", file_key(self.key))

    def bare_margin(self, whole_letters: float = 140) -> float:
        """Margin for the labels left and right of a plot without axes, as a share of the inner width.

        ``whole_letters`` fit into the whole width: about 140 on a screen.
        """
        letters = max((len(t) for m in self.marks if isinstance(m, Labels) for t in m.texts), default=0)
        share = min(0.42, (letters + 2) / whole_letters)
        return share / (1 - 2 * share)

    @property
    def legend_entries(self) -> int:
        """Number of marks in the legend."""
        named = (mark for mark in self.marks if isinstance(mark, Points | Line | Bars | Boxes))
        return sum(getattr(mark, "in_legend", True) for mark in named)


def crowded(chart: Chart) -> bool:
    """True if the plot has a density, so that single points are small."""
    return any(isinstance(mark, Density) for mark in chart.marks)


def _least_width_px(mark: Mark, chart: Chart) -> int:
    columns = len(chart.x.categories or ())
    if isinstance(mark, Parallel):
        return 90 * (len(mark.dimensions) + 1)
    if isinstance(mark, Cells):
        letters = max((len(line) for row in mark.texts for text in row for line in text.split("\n")), default=0)
        return 220 + columns * max(48, 8 * letters)
    if isinstance(mark, Bars | Boxes):
        groups = sum(isinstance(other, type(mark)) for other in chart.marks)
        return 80 + 14 * columns * groups
    if isinstance(mark, Labels) and chart.bare:
        return 260 + 14 * max(map(len, mark.texts), default=0)
    return 0


def line_width(line: Line, chart: Chart) -> float:
    """Width of a line in pixels; references stay visible among many lines."""
    few = sum(isinstance(mark, Line) for mark in chart.marks) <= MOST_THICK
    return 2.0 if few or line.colour == REFERENCE else 1.0


# Plots of many points: a density in place of points, and the rows of failed runs.


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
