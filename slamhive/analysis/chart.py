"""What a figure shows, apart from how it is drawn: the screen and the printed page draw the same chart.

A form states marks and axes; :mod:`slamhive.analysis.plotly_chart` makes the interactive figure of them and
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

BARE_MARGIN = 0.45
"""Room left and right of a chart without axes, for the words there, as a share of its width."""


@dataclass(frozen=True, slots=True)
class Axis:
    """One axis: what it shows, in which unit; ``categories`` makes it one of names, in their order."""

    label: str
    unit: str = ""
    log: bool = False
    categories: tuple[str, ...] | None = None

    @property
    def title(self) -> str:
        """``ATE RMSE [m]``."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label


@dataclass(frozen=True, slots=True)
class Points:
    """Points, one for each run or summary. ``z`` is for charts in three dimensions.

    ``low`` and ``high`` are ends of an interval of y. ``runs`` holds run ids (0 where there is none): a click opens
    the run. ``texts`` is shown on hover. ``shades`` colours each point by a value, named by ``shade_label``.
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


@dataclass(frozen=True, slots=True)
class FailedRuns:
    """Runs that have no value: drawn above the plot in a band of their own, at their place on the x axis.

    ``x`` is their value on the x axis (NaN where they have none either), ``runs`` their ids.
    """

    x: Array
    runs: Array
    colour: str = OKABE_ITO[0]
    name: str = "failed"


@dataclass(frozen=True, slots=True)
class Line:
    """A line, with a band between ``low`` and ``high`` if they are given."""

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


@dataclass(frozen=True, slots=True)
class Bars:
    """One bar for each category of the x axis (NaN: no bar). ``striped`` is for failures."""

    name: str
    heights: Array
    low: Array | None = None
    high: Array | None = None
    colour: str = OKABE_ITO[0]
    striped: bool = False
    texts: tuple[str, ...] | None = None


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

    ``log`` spreads the colours over decades; ``lower_is_better`` decides which end is the dark one.
    """

    values: Array
    texts: tuple[tuple[str, ...], ...]
    label: str
    unit: str = ""
    log: bool = False
    lower_is_better: bool = True


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


Mark = Points | FailedRuns | Line | Bars | Boxes | Cells | Segments | Labels | Parallel


@dataclass(frozen=True, slots=True)
class Chart:
    """One figure. ``caption`` tells n, failures and protocol in words.

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

    def __post_init__(self) -> None:
        object.__setattr__(self, "key", re.sub(r"[^A-Za-z0-9_.-]+", "_", self.key)[:100])
