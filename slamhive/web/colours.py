"""One colour per algorithm on every page and figure, out of a palette that colour-blind people can tell apart."""

from __future__ import annotations

from collections.abc import Iterable

OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#B8A800")
"""M. Okabe and K. Ito, Color Universal Design (2008); the yellow is darkened to be seen on white, black is left out."""


def algorithm_colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each known algorithm, by its place in the alphabet; the palette starts again when it is used up."""
    return {name: OKABE_ITO[place % len(OKABE_ITO)] for place, name in enumerate(sorted(set(names)))}


def colour_of(name: str, known: Iterable[str]) -> str:
    """The colour of one algorithm; one that has left the installation gets the first."""
    return algorithm_colours(known).get(name, OKABE_ITO[0])
