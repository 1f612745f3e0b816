"""What a plot shows, apart from how it is drawn: the screen and the printed page draw the same plot.

A plot type states marks and axes; :mod:`slamhive.analysis.plotly_chart` makes the interactive plot of them and
:mod:`slamhive.analysis.print_chart` the printable one. Arrays have one entry for each point, in the axes' units.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from slamhive.analysis.colours import MARKERS, OKABE_ITO

Array = np.ndarray[Any, np.dtype[Any]]

REFERENCE = "reference"
"""The colour of ground truth: dark grey on white, light grey on black."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis: what it shows, in which unit; ``categories`` makes it one of names, in their order.

    ``numbered``: places between the categories mean something, their positions are 0, 1, 2 ...
    """

    label: str
    unit: str = ""
    log: bool = False
    categories: tuple[str, ...] | None = None
    numbered: bool = False

    @property
    def title(self) -> str:
        """``ATE RMSE [m]``."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


@dataclass(frozen=True, slots=True)
class Points:
    """Points, one for each run or summary. ``z`` is for plots in three dimensions.

    ``low`` and ``high`` are ends of an interval of y. ``runs`` holds run ids (0 where there is none): a click opens
    the run. ``texts`` is shown on hover. ``shades`` colours each point by a value, named by ``shade_label``. Marks of
    one ``group`` are hidden and shown together by its entry in the legend; a mark without points is only that entry.
    """

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
    """Larger and outlined, as the points of a front."""
    ring: bool = False
    """Open rings around points that other marks draw; not counted as points."""


@dataclass(frozen=True, slots=True)
class FailedRuns:
    """Runs that have no value: drawn above the plot in a band of their own, at their place on the x axis.

    ``x`` is their value on the x axis (NaN where they have none either), ``runs`` their ids. ``count`` is how many
    they stand for if some would be drawn over others and are left out.
    """

    x: Array
    runs: Array
    colour: str = OKABE_ITO[0]
    name: str = "failed"
    group: str = ""
    count: int | None = None

    @property
    def total(self) -> int:
        """How many failed."""
        return len(self.x) if self.count is None else self.count


@dataclass(frozen=True, slots=True)
class Line:
    """A line, with a band between ``low`` and ``high`` if they are given; ``group`` as for :class:`Points`."""

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

    ``medians`` are lines across the bars. ``texts`` stand above bars without interval, and are shown on hover.
    ``colours`` are those of single bars.
    """

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
    """A box with its points for each value of ``categories``: quartiles, whiskers to 1.5 times their distance."""

    name: str
    categories: tuple[str, ...]
    values: Array
    runs: Array | None = None
    colour: str = OKABE_ITO[0]


@dataclass(frozen=True, slots=True)
class Cells:
    """A heat map over the categories of both axes: ``values`` and ``texts`` by row (y), then column (x); NaN is empty.

    ``log`` spreads the colours over decades; ``lower_is_better`` decides which end is the dark one. ``span`` is what
    the colours reach over, for maps that are to be compared; None for the span of these values.
    """

    values: Array
    texts: tuple[tuple[str, ...], ...]
    label: str
    unit: str = ""
    log: bool = False
    lower_is_better: bool = True
    span: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Density:
    """How many points of one colour the cells of a grid hold, drawn from pale to full over decades.

    ``counts`` by row (y), then column (x); ``most`` is what the full colour stands for. Edges are in the units of the
    axes, in decades where those are logarithmic.
    """

    name: str
    x_edges: Array
    y_edges: Array
    counts: Array
    most: int
    colour: str = OKABE_ITO[0]
    group: str = ""


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight strokes from (x0, y0) to (x1, y1): brackets of a critical-difference diagram, limits."""

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
    """Words at places; ``anchor`` is the side of the words that lies at the place."""

    x: Array
    y: Array
    texts: tuple[str, ...]
    anchor: str = "left"


@dataclass(frozen=True, slots=True)
class Dimension:
    """One axis of parallel coordinates; categories are given by their positions in ``axis.categories``."""

    axis: Axis
    values: Array


@dataclass(frozen=True, slots=True)
class Parallel:
    """Parallel coordinates: one line for each run through all dimensions, coloured by ``shades``."""

    dimensions: tuple[Dimension, ...]
    shades: Array
    shade_axis: Axis
    runs: Array


MOST_THICK = 12
"""More lines than these are drawn thin."""

Mark = Points | FailedRuns | Line | Bars | Boxes | Cells | Density | Segments | Labels | Parallel


@dataclass(frozen=True, slots=True)
class Chart:
    """One plot. ``caption`` states n, failures and protocol in words.

    ``key`` names its files: only letters, digits, ``_``, ``.`` and ``-`` are kept of it.

    ``equal_aspect`` gives both (all three) axes one scale, as trajectories need. ``bare`` leaves the axes out.
    """

    key: str
    title: str
    x: Axis
    y: Axis
    marks: tuple[Mark, ...]
    caption: str
    z: Axis | None = None
    equal_aspect: bool = False
    bare: bool = False
    height: float = 1.0
    """Relative to the usual height."""
    least_width_px: int = 0
    """Narrower its words would overlap; a small screen scrolls it."""

    def __post_init__(self) -> None:
        if self.marks:
            object.__setattr__(self, "least_width_px", max(_least_width_px(mark, self) for mark in self.marks))
        object.__setattr__(self, "key", re.sub(r"[^A-Za-z0-9_.-]+", "_", self.key)[:100])

    @property
    def bare_margin(self) -> float:
        """Room left and right of a plot without axes for the words there, as a share of the width of the rest.

        A letter takes about 1/140 of the whole width, on screen and paper.
        """
        letters = max((len(t) for m in self.marks if isinstance(m, Labels) for t in m.texts), default=0)
        share = min(0.42, (letters + 2) / 140)
        return share / (1 - 2 * share)

    @property
    def legend_entries(self) -> int:
        """How many marks have a line in the legend."""
        named = (mark for mark in self.marks if isinstance(mark, Points | Line | Bars | Boxes))
        return sum(getattr(mark, "in_legend", True) for mark in named)


def crowded(chart: Chart) -> bool:
    """Whether points lie around a density: then they are drawn small."""
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
    """How thick a line of a plot is, in points of a screen; references are seen over many others."""
    few = sum(isinstance(mark, Line) for mark in chart.marks) <= MOST_THICK
    return 2.0 if few or line.colour == REFERENCE else 1.0
