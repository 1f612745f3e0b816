"""Colours by value: how good a number is among those that it can be compared with."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence

from slamhive.domain.metrics import Direction

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
