"""The words of an experiment that chooses its runs."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.documents.question import Decision, DecisionCandidate
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


def facts(found: Decision) -> list[tuple[str, str]]:
    """The question, and the runs so far."""
    return [
        ("Compared", f"{found.label}, mean over {', '.join(found.datasets)}"),
        ("Does not matter", f"a difference of {found.difference}"),
        ("Chance of a false answer", f"{100 * found.error:.3g} % at most"),
        ("Runs", f"{thousands(found.runs)}; budget {found.budget}"),
    ]


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


def _behind(entry: DecisionCandidate, metric: Metric) -> str:
    if entry.difference is None or entry.difference_within is None:
        return DASH
    factor = display_unit(metric).factor
    return f"{significant(entry.difference * factor, 3)} ± {significant(entry.difference_within * factor, 2)}"
