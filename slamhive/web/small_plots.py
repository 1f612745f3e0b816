"""Small plots beside the numbers of lists: sparklines as paths in SVG, and colours by value."""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slamhive.domain.metrics import Direction
from slamhive.services.runs import Samples
from slamhive.web.formatting import significant

WIDTH, HEIGHT = 96, 20
"""Of the box in which paths are drawn, in units of SVG."""
MOST_POINTS = 192
INK = "#2f86c8"
"""Seen on white and on black, since an image does not know which of them the page is."""
_MARGIN = 2.0
_LINE = '<path d="{path}" fill="none" stroke="{ink}" stroke-width="1.3" stroke-linejoin="round"/>'
_NONE = '<text x="0" y="15" font-size="13" fill="#808890">–</text>'


def error_image(error: Samples | None) -> str:
    """The position error of a run from 0 to its maximum, as an SVG image; a dash if there is none."""
    content = _NONE if error is None else _LINE.format(path=_over_time(error.thinned(MOST_POINTS)), ink=INK)
    return f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}">{content}</svg>'


def repeats_path(values: Sequence[float]) -> str:
    """A dot for each value, in order, from the smallest at the bottom to the largest; empty for fewer than two."""
    if len(values) < 2:
        return ""
    low, high = min(values), max(values)
    heights = [0.5 if high == low else (value - low) / (high - low) for value in values]
    places = np.linspace(0.0, 1.0, len(values))
    return "".join(f"M{_point(x, y)}h0" for x, y in zip(places, heights, strict=True))


def repeats_words(values: Sequence[float], factor: float, unit: str) -> str:
    """The drawing of :func:`repeats_path` in words: ``5 good runs in order, from 0.10 to 0.12 m``."""
    low, high = (significant(value * factor) for value in (min(values), max(values)))
    return f"{len(values)} good runs in order, from {low} to {high} {unit}".strip()


def _over_time(error: Samples) -> str:
    """A line, interrupted where the poses have a gap."""
    span, most = float(np.ptp(error.times_s)) or 1.0, float(error.values.max()) or 1.0
    starts = np.flatnonzero(np.diff(error.pieces, prepend=error.pieces[:1] - 1))
    points = [
        _point((at - error.times_s[0]) / span, value / most)
        for at, value in zip(error.times_s, error.values, strict=True)
    ]
    new = set(starts.tolist())
    return "".join(f"{'M' if place in new else 'L'}{point}" for place, point in enumerate(points))


def _point(x: float, y: float) -> str:
    """A place in the box; ``y`` = 0 is at the bottom."""
    across, up = WIDTH - 2 * _MARGIN, HEIGHT - 2 * _MARGIN
    return f"{_MARGIN + across * x:.1f} {HEIGHT - _MARGIN - up * y:.1f}"


# -- strips: the values of one configuration on an axis that others share, and its failed runs beside them -------------

# All places are percentages of the width, so that dots stay round and text keeps its size at any width.

FIRST, LAST = 4.0, 96.0
LAST_WITH_FAILURES = 78.0
FAILURES_FROM, FAILURES_TO = 86.0, 98.0
"""Failed runs have a band of their own, right of the axis."""
MOST_FAILURES = 6
"""Drawn in the band; the table says how many there are."""
DECADES = 30.0
"""If the largest value is more than this many times the smallest, the axis is logarithmic."""
_STEPS = (1.0, 2.0, 5.0, 10.0)
_MOST_TICKS = 4


@dataclass(frozen=True, slots=True)
class StripAxis:
    """From ``low`` to ``high``, up to the place ``last``; ``ticks`` are (place, value)."""

    low: float
    high: float
    last: float
    logarithmic: bool
    ticks: tuple[tuple[float, float], ...]

    def place(self, value: float) -> float:
        """Where a value is drawn, in percent of the width."""
        return _place(value, self.low, self.high, self.last, logarithmic=self.logarithmic)


def axis_of(values: Iterable[float], *, failures: bool) -> StripAxis | None:
    """The axis for all ``values``; None without any. ``failures``: whether there is a band for failed runs."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return None
    last = LAST_WITH_FAILURES if failures else LAST
    low, high = min(known), max(known)
    logarithmic = low > 0 and high / low > DECADES
    if low == high:
        low, high = low - (abs(low) or 1.0) * 0.1, high + (abs(high) or 1.0) * 0.1
    if logarithmic:
        # Powers of ten within the limits, thinned to four.
        powers = range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1)
        every = max(1, math.ceil(len(powers) / _MOST_TICKS))
        found = [10.0**power for power in powers[::every]]
    else:
        # Round numbers within the limits, two to four if possible.
        power = 10.0 ** math.floor(math.log10((high - low) / _MOST_TICKS))
        step = next(step * power for step in _STEPS if (high - low) / (step * power) <= _MOST_TICKS)
        first_number, last_number = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        found = [number * step for number in range(first_number, last_number + 1)]
    ticks = tuple((_place(value, low, high, last, logarithmic=logarithmic), value) for value in found)
    return StripAxis(low, high, last, logarithmic, ticks)


def failure_places(count: int) -> list[float]:
    """Where so many failed runs are drawn; at most :data:`MOST_FAILURES`."""
    shown = min(count, MOST_FAILURES)
    step = (FAILURES_TO - FAILURES_FROM) / MOST_FAILURES
    return [round(FAILURES_FROM + step * (place + 0.5), 2) for place in range(shown)]


def _place(value: float, low: float, high: float, last: float, *, logarithmic: bool) -> float:
    share = math.log(value / low) / math.log(high / low) if logarithmic else (value - low) / (high - low)
    return round(FIRST + (last - FIRST) * share, 2)


# -- colours by value: how good a number is among those that it can be compared with -----------------------------------

WORST = 6
"""The largest level; half of it is neither good nor bad."""
OUTER_SHARE = 0.1
"""The best and the worst tenth have the full colours, so that one outlier does not take the colour of the others."""

ComparableClass = Hashable
"""Values of equal classes may be compared."""


def levels(
    values: Sequence[float | None], classes: Sequence[ComparableClass], direction: Direction
) -> list[int | None]:
    """The level of each value among those of its class: 0 is best, ``WORST`` is worst.

    None for a missing value, for equal values, and for a metric of which neither direction is better.
    """
    found: list[int | None] = [None] * len(values)
    if direction is Direction.NEUTRAL:
        return found
    known: dict[ComparableClass, list[tuple[int, float]]] = {}
    for place, (value, kind) in enumerate(zip(values, classes, strict=True)):
        if value is not None and math.isfinite(value):
            known.setdefault(kind, []).append((place, value))
    for members in known.values():
        low, high = _ends([value for _, value in members])
        # Means of equal values differ by rounding; nobody sees a difference of a part in a billion.
        for place, value in members if high - low > 1e-9 * max(abs(high), abs(low)) else ():
            share = min(1.0, max(0.0, (value - low) / (high - low)))
            found[place] = round(WORST * (1 - share if direction is Direction.HIGHER else share))
    return found


def _ends(values: Sequence[float]) -> tuple[float, float]:
    """Where the full colours begin; the extremes where the inner values are all equal."""
    ordered = sorted(values)
    last = len(ordered) - 1
    low, high = ordered[math.floor(OUTER_SHARE * last)], ordered[math.ceil((1 - OUTER_SHARE) * last)]
    return (low, high) if high > low else (ordered[0], ordered[-1])
