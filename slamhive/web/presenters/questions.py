"""The words of an experiment that chooses its runs."""

from __future__ import annotations

from dataclasses import dataclass

from slamhive.documents.experiment import Decision, DecisionCandidate, SearchedCandidate, SearchStanding, all_failed
from slamhive.domain.metrics import Metric, described
from slamhive.domain.names import value_within
from slamhive.domain.question import CandidateStanding
from slamhive.experiments.experiment import FAILED
from slamhive.web.formatting import DASH, TableCell, display_unit, metric_cell, plural, significant, thousands
from slamhive.web.small_plots import axis_of


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
    against: tuple[TableCell, ...]


@dataclass(frozen=True, slots=True)
class GrowthRow:
    """State of a search after so many runs."""

    runs: str
    best: str
    gap: str


@dataclass(frozen=True, slots=True)
class FrontPlot:
    """The best trade-offs of the first objective against another one, after more and more runs.

    Places are percentages of width and height. ``ticks``: (place, text). ``fronts``: the opacity and the (across, up,
    words) of each step, the last one now.
    """

    across: str
    up: str
    ticks_across: tuple[tuple[float, str], ...]
    ticks_up: tuple[tuple[float, str], ...]
    fronts: tuple[tuple[float, tuple[tuple[float, float, str], ...]], ...]


def facts(found: Decision | SearchStanding) -> list[tuple[str, str]]:
    """The question, and the runs so far."""
    if isinstance(found, Decision):
        return [
            ("Compared", f"{found.label}, mean over {', '.join(found.datasets)}"),
            ("Does not matter", f"a difference of {found.difference}"),
            ("Chance of a false answer", f"{100 * found.error:.3g} % at most"),
            ("Runs", f"{thousands(found.runs)}; budget {found.budget}"),
        ]
    objectives = [(found.metric, found.label), *((other.metric, other.label) for other in found.against)]
    named = " against ".join(
        [found.label, " and ".join(label for _, label in objectives[1:])][: 1 + bool(found.against)]
    )
    told = [
        ("To be best", f"{named} on {', '.join(found.datasets)}"),
        ("A run must keep", ", ".join(found.limits)),
        ("Near enough", f"within {100 * found.within:.3g} % of the best, at {100 * found.confidence:.3g} % confidence"),
        ("Runs", f"{thousands(found.runs)} of {thousands(found.combinations)}; budget {found.budget}"),
        *([("First looks at a clip", thousands(found.first_looks))] if found.first_looks else []),
        ("Going on may gain", "" if found.expected_gain is None else f"{found.expected_gain:.1%} on average"),
        *(
            (
                f"What matters for {label}" if found.against else "What matters",
                ", ".join(f"{entry.axis} {entry.share:.0%}" for entry in found.importance if entry.objective == key),
            )
            for key, label in objectives
        ),
    ]
    return [(term, text) for term, text in told if text]


def rows(found: Decision | SearchStanding, metric: Metric) -> list[CandidateRow] | list[SearchRow]:
    """One row for each candidate, the best first."""
    if isinstance(found, Decision):
        return [
            CandidateRow(
                entry.label,
                "may be best" if entry.standing is CandidateStanding.LEFT else entry.standing.value,
                entry.rounds,
                thousands(entry.runs),
                entry.failed,
                _value(metric, entry.mean, entry),
                _behind(entry, metric),
                entry.beaten_by or DASH,
            )
            for entry in found.candidates
        ]
    factor = display_unit(metric).factor
    return [
        SearchRow(
            entry.label,
            thousands(entry.runs),
            entry.failed,
            _value(metric, entry.expected, entry),
            DASH
            if entry.low is None or entry.high is None
            else f"{significant(entry.low * factor)} to {significant(entry.high * factor)}",
            f"{entry.failing:.0%}",
            tuple(
                TableCell(f"{value.expected:.0%}")
                if key == FAILED and value.expected is not None
                else metric_cell(described(key), value.expected)
                for key, value in entry.against.items()
            ),
        )
        for entry in found.candidates
    ]


def _value(metric: Metric, value: float | None, entry: DecisionCandidate | SearchedCandidate) -> TableCell:
    """The value of a candidate; ``failed: 3 of 3`` instead if no run of it was good."""
    failed = all_failed(entry.runs, entry.failed)
    return metric_cell(metric, value) if failed is None else TableCell(failed, missing=True)


def heads(found: SearchStanding) -> list[str]:
    """The further objectives, with the units of their columns."""
    return [f"{other.label} [{_unit(other.metric)}]" for other in found.against]


def growth_rows(found: SearchStanding) -> list[GrowthRow]:
    """One row for each step in which the best grew."""
    metric = described(found.metric)
    grown = []
    for step in found.growth:
        best = metric_cell(metric, min(values[found.metric] for values in step.front)).text
        best = f"{best} {_unit(found.metric)}"
        if found.against:
            best = f"{plural(len(step.front), 'combination')}, from {best}"
        grown.append(GrowthRow(thousands(step.runs), best, f"{step.gap:.1%}"))
    return grown


def front_plots(found: SearchStanding) -> list[FrontPlot]:
    """One plot for each further objective."""
    plots = []
    for other in found.against:
        points = [
            [
                (values[found.metric] * _factor(found.metric), values[other.metric] * _factor(other.metric))
                for values in step.front
            ]
            for step in found.growth
        ]
        every = [point for step in points for point in step]
        across = axis_of((point[0] for point in every), failures=False)
        up = axis_of((point[1] for point in every), failures=False)
        if across is None or up is None:
            continue
        units = _unit(found.metric), _unit(other.metric)
        fronts = []
        for number, (step, places) in enumerate(zip(found.growth, points, strict=True), 1):
            drawn = tuple(
                (
                    across.place(x),
                    100 - up.place(y),
                    f"{significant(x)} {units[0]}, {significant(y)} {units[1]}, after {plural(step.runs, 'run')}",
                )
                for x, y in places
            )
            fronts.append((round(number / len(points), 2) ** 2, drawn))
        plots.append(
            FrontPlot(
                f"{found.label} [{units[0]}]",
                f"{other.label} [{units[1]}]",
                tuple((place, f"{value:.6g}") for place, value in across.ticks),
                tuple((100 - place, f"{value:.6g}") for place, value in up.ticks),
                tuple(fronts),
            )
        )
    return plots


def _factor(key: str) -> float:
    return 100.0 if key == FAILED else display_unit(described(key)).factor


def _unit(key: str) -> str:
    return "%" if key == FAILED else display_unit(described(key)).unit or "1"


def _behind(entry: DecisionCandidate, metric: Metric) -> str:
    if entry.difference is None or entry.difference_within is None:
        return DASH
    factor = display_unit(metric).factor
    return value_within(entry.difference * factor, entry.difference_within * factor)
