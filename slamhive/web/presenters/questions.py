"""The words of an experiment that chooses its runs."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.documents.question import Decision, DecisionCandidate, SearchStanding
from slamhive.domain.metrics import Metric
from slamhive.web.formatting import DASH, TableCell, display_unit, metric_cell, significant, thousands


@dataclass(frozen=True, slots=True)
class CandidateRow:
    """A candidate. ``behind``: how far it is behind the best one, with an interval that holds whenever one looks."""

    label: str
    standing: str
    rounds: int
    runs: str
    failed: int
    mean: TableCell
    behind: str
    beaten_by: str


@dataclass(frozen=True, slots=True)
class SearchRow:
    """A candidate of a search, with an interval that holds its typical value with 95 %."""

    label: str
    runs: str
    failed: int
    expected: TableCell
    interval: str
    failing: str


def facts(found: Decision | SearchStanding) -> list[tuple[str, str]]:
    """The question, and the runs so far."""
    if isinstance(found, Decision):
        return [
            ("Compared", f"{found.label}, mean over {', '.join(found.datasets)}"),
            ("Does not matter", f"a difference of {found.difference}"),
            ("Chance of a false answer", f"{100 * found.error:.3g} % at most"),
            ("Runs", f"{thousands(found.runs)}; budget {found.budget}"),
        ]
    rows = [
        ("To be best", f"{found.label} on {', '.join(found.datasets)}"),
        ("A run must keep", ", ".join(found.limits)),
        ("Near enough", f"{found.within:.3g} of the best, at {found.confidence:.1%} confidence"),
        ("Runs", f"{thousands(found.runs)} of {thousands(found.combinations)}; budget {found.budget}"),
        ("Going on may gain", "" if found.expected_gain is None else f"{found.expected_gain:.1%} on average"),
        ("What matters", ", ".join(f"{entry.axis} {entry.share:.0%}" for entry in found.importance)),
    ]
    return [(term, text) for term, text in rows if text]


def unit_of(metric: Metric) -> str:
    """The unit in which the table shows the metric."""
    return display_unit(metric).unit or "1"


def candidate_rows(found: Decision, metric: Metric) -> list[CandidateRow]:
    """One row for each candidate, the best first."""
    return [
        CandidateRow(
            entry.label,
            entry.standing.value,
            entry.rounds,
            thousands(entry.runs),
            entry.failed,
            metric_cell(metric, entry.mean),
            _behind(entry, metric),
            entry.beaten_by or DASH,
        )
        for entry in found.candidates
    ]


def search_rows(found: SearchStanding, metric: Metric) -> list[SearchRow]:
    """One row for each candidate that may be best, the best first."""
    factor = display_unit(metric).factor
    return [
        SearchRow(
            entry.label,
            thousands(entry.runs),
            entry.failed,
            metric_cell(metric, entry.expected),
            f"{significant(entry.low * factor)} to {significant(entry.high * factor)}",
            f"{entry.failing:.0%}",
        )
        for entry in found.candidates
    ]


def _behind(entry: DecisionCandidate, metric: Metric) -> str:
    if entry.difference is None or entry.difference_within is None:
        return DASH
    factor = display_unit(metric).factor
    return f"{significant(entry.difference * factor)} ± {significant(entry.difference_within * factor, 2)}"
