"""One colour and one marker for each algorithm, on every page and in every plot; markers of datasets; dark pages."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from functools import cache

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
