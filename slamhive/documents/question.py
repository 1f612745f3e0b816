"""The answer of an experiment that chooses its runs, as JSON."""

from __future__ import annotations

from typing import Annotated

from slamhive.documents.model import Document, Values, described
from slamhive.domain.question import CandidateStanding, ExperimentQuestion, QuestionAnswer


class DecisionCandidate(Document):
    """One candidate: a combination of everything but the dataset."""

    label: Annotated[str, described("What sets it apart.")]
    values: Values
    cells: Annotated[dict[str, int], described("The number of its configuration in the experiment, by dataset.")]
    standing: CandidateStanding
    runs: Annotated[int, described("Runs that have ended and count.")]
    failed: Annotated[int, described("Those of them that failed.")]
    mean: Annotated[
        float | None, described("Mean over the datasets, failed runs included; null before the first round.")
    ]
    beaten_by: Annotated[str | None, described("Who is certainly better; null for a candidate that is left.")] = None
    rounds: Annotated[int, described("Rounds until it was beaten, or until now.")] = 0
    difference: Annotated[float | None, described("Its mean less that of the best one; null if that is not known.")] = (
        None
    )
    difference_within: Annotated[
        float | None, described("Half of the interval of the difference, which holds however often one looks.")
    ] = None


class Decision(Document):
    """State of an experiment that finds out which candidate is best."""

    experiment: str
    question: ExperimentQuestion
    answer: QuestionAnswer
    words: Annotated[str, described("The answer in one sentence.")]
    metric: str
    label: Annotated[str, described("The metric in words.")]
    unit: str
    difference: Annotated[str, described("The largest difference that does not matter.")]
    error: Annotated[float, described("The largest chance that the answer is false.")]
    budget: str
    runs: Annotated[int, described("Runs so far, those that wait included.")]
    datasets: tuple[str, ...]
    candidates: Annotated[tuple[DecisionCandidate, ...], described("The best first.")]
    next: Annotated[str, described("What comes next, and why.")]
    notes: Annotated[tuple[str, ...], described("What was left out, and why.")]


class ExpectedValue(Document):
    """A value that a candidate is expected to have, failed runs included."""

    expected: float
    low: Annotated[float, described("The smaller end of an interval that holds it with 95 %.")]
    high: Annotated[float, described("The larger end.")]


class SearchedCandidate(Document):
    """One of the candidates that may be best, or one of the best trade-offs."""

    label: Annotated[str, described("What sets it apart.")]
    values: Values
    cells: Annotated[dict[str, int], described("The number of its configuration in the experiment, by dataset.")]
    runs: Annotated[int, described("Runs that have ended and count.")]
    failed: Annotated[int, described("Those of them that failed, or broke a limit.")]
    expected: Annotated[float, described("Expected typical value, failed runs included.")]
    low: Annotated[float, described("The smaller end of an interval that holds it with 95 %.")]
    high: Annotated[float, described("The larger end.")]
    failing: Annotated[float, described("Expected share of failed runs.")]
    against: Annotated[dict[str, ExpectedValue], described("The same of each further objective.")]
    on_front: Annotated[bool, described("No other candidate is better in all objectives.")]


class AxisImportance(Document):
    """The influence of one axis of a search on one objective."""

    axis: str
    objective: str
    share: Annotated[float, described("Share of the variance over all candidates that it explains alone.")]


class SearchObjective(Document):
    """A further objective of a search: a metric, or the share of failed runs."""

    metric: str
    label: str
    unit: str


class SearchGrowth(Document):
    """State of a search after so many runs."""

    runs: int
    gap: Annotated[float, described("How far the best was from the truly best at most, as a share.")]
    front: Annotated[tuple[dict[str, float], ...], described("The expected values of each of the best, by objective.")]


class SearchStanding(Document):
    """State of an experiment that searches for the best of many candidates."""

    experiment: str
    question: ExperimentQuestion
    answer: QuestionAnswer
    words: Annotated[str, described("The answer in one sentence.")]
    metric: str
    label: Annotated[str, described("The metric in words.")]
    unit: str
    against: Annotated[tuple[SearchObjective, ...], described("What is traded against the metric.")]
    limits: Annotated[tuple[str, ...], described("What a run must keep.")]
    within: Annotated[float, described("How near to the truly best is near enough, as a share.")]
    confidence: float
    gap: Annotated[
        float | None, described("How far the best one is from the truly best at most, as a share; null if unknown.")
    ]
    expected_gain: Annotated[float | None, described("What going on may gain on average, as a share; null if unknown.")]
    budget: str
    runs: Annotated[int, described("Runs so far, those that wait included.")]
    combinations: Annotated[int, described("All combinations with all datasets.")]
    datasets: tuple[str, ...]
    candidates: Annotated[tuple[SearchedCandidate, ...], described("Those that may be best, the best first.")]
    importance: Annotated[
        tuple[AxisImportance, ...], described("The axes that vary, by objective, the most important first.")
    ]
    growth: Annotated[tuple[SearchGrowth, ...], described("After 24, 48, 96 runs and so on, and now.")]
    next: Annotated[str, described("What comes next, and why.")]
    notes: Annotated[tuple[str, ...], described("What was left out, and why.")]
