"""The time offset between two clocks, found where the trajectories fit best."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slamhive.errors import InvalidInput

PRECISION_S = 1e-5
"""The search ends when the offset is known to this: a fiftieth of the shortest frame time of a camera or less."""

_GOLDEN = (math.sqrt(5) - 1) / 2


Misfit = Callable[[float], tuple[float, int]]
"""Of an offset in s: the error, and over how many poses; infinite and 0 where nothing can be compared."""


def search_offset(misfit: Misfit, centre_s: float, within_s: float, step_s: float) -> float:
    """The offset in s with the least error, within ``within_s`` of ``centre_s``.

    The error is taken every ``step_s``, and between the neighbours of the best by golden-section search (Kiefer 1953).
    Offsets that leave less than half of the poses to compare do not count: a few poses always fit.

    Args:
        misfit: What to make small.
        centre_s: Middle of the search.
        within_s: Half its width.
        step_s: No deeper valley of the error is narrower than twice this.

    Raises:
        InvalidInput: They can be compared nowhere, or the best is at an end of the search, so that more lies beyond.
    """
    count = max(1, math.ceil(within_s / step_s))
    offsets_s = centre_s + np.linspace(-within_s, within_s, 2 * count + 1)
    found = [misfit(float(offset_s)) for offset_s in offsets_s]
    most = max(count for _, count in found)
    errors = [error if 2 * count >= most else math.inf for error, count in found]
    best = int(np.argmin(errors))
    if not math.isfinite(errors[best]):
        raise InvalidInput(
            f"no time offset within {within_s:g} s of {centre_s:g} s makes estimate and ground truth overlap",
            "give the offset, or search further",
        )
    if best in {0, len(errors) - 1}:
        raise InvalidInput(
            f"the time offset is not within {within_s:g} s of {centre_s:g} s: the error still falls at "
            f"{offsets_s[best]:+g} s",
            "search further, or give the offset",
        )
    return _golden_section(lambda offset_s: misfit(offset_s)[0], float(offsets_s[best - 1]), float(offsets_s[best + 1]))


def _golden_section(error: Callable[[float], float], low_s: float, high_s: float) -> float:
    inner = [high_s - _GOLDEN * (high_s - low_s), low_s + _GOLDEN * (high_s - low_s)]
    errors = [error(inner[0]), error(inner[1])]
    while high_s - low_s > PRECISION_S:
        if errors[0] <= errors[1]:
            high_s = inner[1]
            inner = [high_s - _GOLDEN * (high_s - low_s), inner[0]]
            errors = [error(inner[0]), errors[0]]
        else:
            low_s = inner[0]
            inner = [inner[1], low_s + _GOLDEN * (high_s - low_s)]
            errors = [errors[1], error(inner[1])]
    return (low_s + high_s) / 2
