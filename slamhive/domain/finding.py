"""Something with a name that a search over everything found, and which of several fit best."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

MOST_OF_A_KIND = 8


class FoundKind(StrEnum):
    """Kind of thing found, in the order of display."""

    RUN = "run"
    RUNS = "runs"
    EXPERIMENT = "experiment"
    ALGORITHM = "algorithm"
    DATASET = "dataset"
    CONFIGURATION = "configuration"
    ANALYSIS = "analysis"
    SEARCH = "search"
    METRIC = "metric"
    HELP = "help"


@dataclass(frozen=True, slots=True)
class Found:
    """Something with a name. ``key`` is its address: a number, a name, a token, a filter of runs.

    ``words`` are shown beside the name; ``text`` is searched, but not shown.
    """

    kind: FoundKind
    key: str
    name: str
    words: str = ""
    text: str = ""


def best(text: str, entries: Iterable[Found], most: int = MOST_OF_A_KIND) -> tuple[Found, ...]:
    """Those that hold every word of ``text``, the best first: same name, name that begins so, words in the name."""
    wanted = text.casefold().split()
    ranked = [(_rank(text.casefold().strip(), wanted, entry), entry.name, entry) for entry in entries]
    found = sorted((entry for entry in ranked if entry[0] is not None), key=lambda entry: (entry[0] or 0, entry[1]))
    return tuple(entry for _, _, entry in found[:most])


def _rank(text: str, wanted: list[str], entry: Found) -> int | None:
    name = entry.name.casefold()
    everywhere = f"{name} {entry.key} {entry.words} {entry.text}".casefold()
    if not wanted or not all(word in everywhere for word in wanted):
        return None
    if text == name:
        return 0
    if name.startswith(text):
        return 1
    return 2 if all(word in name for word in wanted) else 3


# What can be done to all runs of a search.


class FoundAction(StrEnum):
    """One action; its value is the last part of its address in the web API."""

    EVALUATE = "evaluate"
    RETRY = "retry"
    TAGS = "tags"
    SHARE = "share"
    DELETE = "delete"


# How a list of runs may look.


MOST_PINNED = 20
"""Columns that stay in view when a list is scrolled sideways."""
