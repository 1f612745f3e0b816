"""The content of a plot, independent of how it is drawn: marks and axes.

:mod:`slamhive.analysis.plotly_chart` draws it for the screen, :mod:`slamhive.analysis.print_chart` for paper. Arrays
have one entry for each point, in the units of the axes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from slamhive.analysis.colours import MARKERS, OKABE_ITO
from slamhive.schema import arrays
from slamhive.schema.arrays import Kind

Array = arrays.Array

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
        """``ATE RMSE [m]``."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


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
    """Whether the plot has a density, so that single points are small."""
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
