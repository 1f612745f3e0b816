"""Sentences that describe a list of runs: what it shows, how many, and what it leaves out."""

from __future__ import annotations

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.numbers import plural
from slamhive.services.searches.service import LeftOut
from slamhive.store.records import Count, RunSort


def summary(
    shown: int, count: Count, words: str, left_out: LeftOut, *, grouped: bool = False, further: bool = False
) -> str:
    """``Showing 2 of 12 runs: state failed, newest first. Left out: ...``.

    Args:
        shown: Number of runs on the page, or of configurations if ``grouped``.
        count: Number of matching runs.
        words: Search and order as the end of a sentence.
        left_out: The runs that do not match.
        grouped: Whether configurations are shown.
        further: Whether the page is not the first.
    """
    if left_out.total == 0:
        return "No runs yet."
    what = f"{plural(shown, 'configuration')} with" if grouped else f"{shown:,} of"
    text = f"Showing {'the next ' if further else ''}{what} {counted(count)}: {words}."
    if count.exact and count.number == 0:
        text = f"No run matches: {words}."
    if count.number < left_out.total:
        rest = left_out.total - count.number
        most = "" if count.exact else "at most "
        text += f" Left out: {most}{plural(rest, 'run')} that the filter does not match."
    for key, number in left_out.without.items():
        text += f" {plural(number, 'run')} {'has' if number == 1 else 'have'} no {CATALOGUE[key].label}."
    return text


def counted(count: Count) -> str:
    """``12 runs``, ``more than 10,000 runs``."""
    return plural(count.number, "run") if count.exact else f"more than {plural(count.number, 'run')}"


def order_in_words(sort: RunSort, title: str, *, numeric: bool) -> str:
    """``newest first``, ``sorted by ATE RMSE, smallest first``; ``title`` is the title of the sort column."""
    if sort.key in {"id", "configuration"}:
        return "newest first" if sort.descending else "oldest first"
    way = ("largest first", "smallest first") if numeric else ("Z to A", "A to Z")
    if sort.key.endswith("_at"):
        way = ("latest first", "earliest first")
    return f"sorted by {title}, {way[0] if sort.descending else way[1]}"
