"""One colour per algorithm and one marker per dataset on every page and plot."""

from __future__ import annotations

from collections.abc import Iterable

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#B8A800")
"""M. Okabe and K. Ito, Color Universal Design (2008); the yellow is darkened to be seen on white, black is left out."""

PALETTE = (*OKABE_ITO, "#4A3B8F", "#7A2E00", "#00553E", "#8C3F6B", "#8A8F98", "#2B6E8F", "#6B6100")
"""Colours of algorithms: the well separated ones first, then darker ones."""

RUN_COLOURS = (*PALETTE, "#B0413E", "#3E8E41", "#A87BD1", "#C77C4E", "#5F9EA0", "#D4577B")
"""Colours of single runs and configurations, where these are compared: as many as a comparison may have."""

MARKERS = (
    "circle", "square", "triangle-up", "diamond", "cross", "star", "triangle-down", "pentagon",
    "triangle-left", "triangle-right", "hexagon", "diamond-tall",
)  # fmt: skip
"""The markers of datasets."""

MARKERS_IN_SPACE = 7
"""The first ones can be drawn in three dimensions."""

FAILED_MARKER = "failed"
"""The marker of failed runs where they are points, in three dimensions."""


def algorithm_colours(names: Iterable[str], known: Iterable[str] = ()) -> dict[str, str]:
    """A colour for each algorithm.

    A ``known`` (installed) algorithm has the same colour in every plot, by its place in the alphabet, unless another
    of ``names`` has that colour. Others take the first free colour. Colours repeat if there are too many algorithms.
    """
    wanted = set(names)
    installed = sorted(set(known))
    chosen: dict[str, str] = {}
    ordered = [name for name in installed if name in wanted] + sorted(wanted - set(installed))
    for place, name in enumerate(ordered):
        start = installed.index(name) if name in installed else 0
        turns = [PALETTE[(start + step) % len(PALETTE)] for step in range(len(PALETTE))]
        taken = set(chosen.values())
        chosen[name] = next((colour for colour in turns if colour not in taken), PALETTE[place % len(PALETTE)])
    return dict(sorted(chosen.items()))


def colour_of(name: str, known: Iterable[str]) -> str:
    """The colour of one algorithm; an algorithm that is not installed gets the first colour."""
    installed = set(known)
    return algorithm_colours([name] if name in installed else [], installed).get(name, PALETTE[0])


def dataset_markers(names: Iterable[str]) -> dict[str, str]:
    """A marker for each dataset by its place in the alphabet; circles for all if there are too many datasets."""
    ordered = sorted(set(names))
    shapes = MARKERS if len(ordered) <= len(MARKERS) else MARKERS[:1] * len(ordered)
    return dict(zip(ordered, shapes, strict=False))
