"""Sparklines: plots as small as a word, as paths in SVG."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

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
    """What :func:`repeats_path` draws, in words: ``5 good runs in order: 0.10, 0.12 m``."""
    low, high = (significant(value * factor, 3) for value in (min(values), max(values)))
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
