"""One colour per algorithm and one marker per dataset on every page and figure."""

from __future__ import annotations

from collections.abc import Iterable

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#B8A800")
"""M. Okabe and K. Ito, Color Universal Design (2008); the yellow is darkened to be seen on white, black is left out."""

MARKERS = ("circle", "square", "triangle-up", "diamond", "cross", "star", "triangle-down", "pentagon")
"""The shapes that datasets are told apart by."""


def algorithm_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each known algorithm, by its place in the alphabet; the palette starts again when it is used up."""
    return {name: OKABE_ITO[place % len(OKABE_ITO)] for place, name in enumerate(sorted(set(names)))}


def colour_of(name: str, known: Iterable[str]) -> str:
    """The colour of one algorithm; one that has left the installation gets the first."""
    return algorithm_colours(known).get(name, OKABE_ITO[0])


def dataset_markers(names: Iterable[str]) -> dict[str, str]:
    """A marker for each dataset by its place in the alphabet."""
    return {name: MARKERS[place % len(MARKERS)] for place, name in enumerate(sorted(set(names)))}
