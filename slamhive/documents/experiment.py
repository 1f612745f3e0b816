"""An experiment as JSON: what starting it would do, its progress, its cells and grid, the answer to its question."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any

from pydantic import AliasChoices, BeforeValidator, Field
from pydantic.json_schema import SkipJsonSchema

from slamhive.documents.model import Document, Moment, Values, cut, described
from slamhive.documents.plain import ShownAs, ToFetchDocument
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import Variant
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.parameters import Value
from slamhive.domain.question import CandidateStanding, ExperimentQuestion, QuestionAnswer
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.side_by_side import PlannedMixture
from slamhive.domain.verdict import VerdictKind

Counts = Annotated[dict[str, int], described("Runs by state.")]
Failures = Annotated[dict[str, int], described("Failed runs by reason.")]


class PreviewRowDocument(Document):
    """One of the first cells."""

    cell: int
    name: str
    values: Values
    known: Annotated[bool, described("Its configuration is stored already.")]
    known_runs: int


class VariantNeedDocument(Document):
    """A variant of a dataset that runs need."""

    dataset: str
    steps: Variant
    key: str
    needed_bytes: Annotated[int, described("Space it takes at most.", unit="bytes")]
    make_s: Annotated[float, described("Estimated time to make it.", unit="s")]
    made: bool


class NodesPlanDocument(Document):
    """The runs of an experiment on the nodes of a cluster."""

    nodes: int
    used_nodes: Annotated[int, described("Nodes that have something to do.")]
    time_s: Annotated[float, described("Estimated time of runs and of moving their data.", unit="s")]
    moved_bytes: Annotated[int, described("Data that all nodes get.", unit="bytes")]
    node_bytes: Annotated[int, described("The most that one node gets.", unit="bytes")]
    bytes_per_s: Annotated[float, described("How fast a node is assumed to get data.", unit="bytes/s")]


class ExperimentPreviewDocument(Document):
    """Effect of starting an experiment."""

    name: str
    description: str
    combinations: Annotated[int, described("Combinations before conditions, without first looks.")]
    cells: Annotated[int, described("Different configurations that meet the conditions.")]
    first_looks: Annotated[
        int, described("Those of them that are first looks at a clip, one for each on the whole recording.")
    ] = 0
    merged: Annotated[int, described("Combinations that are identical to another.")]
    runs: int
    axes: Annotated[dict[str, int], described("How many values each axis has.")]
    known_cells: Annotated[int, described("Configurations that are stored already.")]
    known_runs: int
    time_s: Annotated[float, described("Estimated time until all is evaluated.", unit="s")]
    variant_time_s: Annotated[float, described("The part of it that making variants takes.", unit="s")]
    build_time_s: Annotated[float, described("The part of it that building packages takes.", unit="s")] = 0.0
    between_s: Annotated[float, described("Added to each run: preparing, collecting, evaluating.", unit="s")] = 0.0
    cluster: Annotated[NodesPlanDocument | None, described("Null if the plan is for the slots of this machine.")] = None
    measured_runs: Annotated[int, described("Runs whose time is known from earlier ones.")]
    slots: int
    variants: tuple[VariantNeedDocument, ...]
    variant_bytes: Annotated[int, described("Space that missing variants take at most.", unit="bytes")]
    run_bytes: Annotated[int, described("Estimated space of the run folders.", unit="bytes")]
    free_bytes: Annotated[int, described("Free space.", unit="bytes")]
    warnings: tuple[str, ...]
    mixed_protocols: Annotated[
        str | None, described("Which runs would use which protocol, and the remedy, if errors would not be comparable.")
    ] = None
    refusals: Annotated[tuple[str, ...], described("Why it would be refused.")]
    to_fetch: Annotated[ToFetchDocument | None, described("Null if all datasets are here.")] = None
    repeat_disturbed: int
    standing: Annotated[str | None, described("State of the experiment if it is stored already.")]
    rows: Annotated[tuple[PreviewRowDocument, ...], described("The first cells.")]
    mixed: Annotated[SkipJsonSchema[PlannedMixture | None], Field(exclude=True)] = None
    """What ``mixed_protocols`` says, for pages that offer the remedy."""


class CellRunDocument(Document):
    """A run of a cell."""

    id: int
    seed: int
    state: RunState
    reason: FailureReason | None
    verdict: VerdictKind | None = Field(validation_alias=AliasChoices("judged", "verdict"))
    retried: bool
    disturbed: Annotated[bool | None, described("Null if that is not known.")]


class SpreadDocument(Document):
    """Mean and sample standard deviation of ``n`` values."""

    n: int
    mean: float
    std: float | None
    unit: str | None


def _spread(key: str, found: Any) -> Any:
    if isinstance(found, dict):
        return found
    return SpreadDocument.of(found, unit=CATALOGUE[key].unit if key in CATALOGUE else None)


class CellFiguresDocument(Document):
    """Metrics of the runs of a cell that did not fail, under one protocol."""

    protocol: Annotated[str | None, described("Fingerprint; null where no run was evaluated.")]
    runs: int
    disturbed: int
    metrics: Annotated[
        dict[str, SpreadDocument],
        BeforeValidator(lambda raw: {key: _spread(key, found) for key, found in raw.items()}),
    ]


class CellDocument(Document):
    """One configuration of an experiment, with its runs and metrics."""

    cell: int = Field(validation_alias=AliasChoices("number", "cell"))
    name: str
    configuration: int = Field(validation_alias=AliasChoices("configuration_id", "configuration"))
    values: Values
    counts: Counts
    failures: Failures
    runs: tuple[CellRunDocument, ...]
    figures: Annotated[tuple[CellFiguresDocument, ...], described("Metrics, those of each protocol by themselves.")]


class Certainty(StrEnum):
    """Degree to which the answer of an experiment is settled."""

    SEPARATED = "separated"
    NOT_SEPARATED = "not separated"
    TOO_FEW = "too few repeats"
    ALONE = "nothing to compare"
    OPEN = "no result yet"

    @property
    def undecided(self) -> bool:
        """True if more repeats may change it."""
        return self in (Certainty.NOT_SEPARATED, Certainty.TOO_FEW)


class DatasetAnswerDocument(Document):
    """The answer of an experiment on one dataset."""

    dataset: str
    certainty: Annotated[
        Certainty,
        described("separated, not separated, too few repeats, nothing to compare, or no result yet."),
        ShownAs(str, "Certainty"),
    ]
    leaders: Annotated[tuple[str, ...], described("The best, then those that no test separates from it.")]
    p_value: Annotated[float | None, described("Of the test behind the sentence; null without one.")]
    more_repeats: Annotated[int | None, described("Repeats of each that would settle it; null if none would.")]
    sentence: str


class ExperimentAnswerDocument(Document):
    """The question of an experiment, and its answer from the statistics."""

    question: str
    sentence: Annotated[str, described("The answer in words.")]
    certainty: Annotated[Certainty, described("The least settled of the datasets."), ShownAs(str, "Certainty")]
    more_repeats: Annotated[int | None, described("Repeats of each to add; null if none are called for.")]
    by: Annotated[str, described("What is compared: algorithm or configuration.")]
    datasets: tuple[DatasetAnswerDocument, ...]
    notes: Annotated[tuple[str, ...], described("What the answer leaves out.")]


class GridCellDocument(Document):
    """The cells that share two values. ``row`` and ``column`` are places in the lists of the grid."""

    row: int
    column: int
    cells: int
    first: Annotated[int, described("Number of the first of them.")]
    counts: Counts
    failures: Failures


def _placed(raw: Any) -> Any:
    if not isinstance(raw, Mapping):
        return raw
    return [GridCellDocument.of(cell, row=row, column=column) for (row, column), cell in raw.items()]


class GridDocument(Document):
    """Progress over two axes."""

    row_axis: str
    column_axis: str
    rows: tuple[Value | None, ...]
    columns: tuple[Value | None, ...]
    cells: Annotated[tuple[GridCellDocument, ...], BeforeValidator(_placed)]


# What a webhook is sent about an experiment.


class NoticeEvent(StrEnum):
    """Kind of event."""

    FINISHED = "finished"
    FAILING = "failing"
    TEST = "test"


class Notice(Document):
    """One thing that has happened to an experiment."""

    event: NoticeEvent
    experiment: Annotated[str, described("Its name; empty for a test.")]
    words: Annotated[str, described("One sentence for people.")]
    counts: Annotated[dict[str, int], described("Runs by phase: good, failed, queued and so on.")]
    failures: Annotated[dict[str, int], described("Failed runs by reason.")]
    address: Annotated[str | None, described("The page of the experiment; null unless PUBLIC_URL is set.")]
    at: datetime


# A stored analysis: the state that its folder holds.


class StoredAnalysis(Document):
    """``state.json`` in the folder of an analysis."""

    format: int = 1
    name: Annotated[str, cut(200)]
    state: str
    listed: Annotated[bool, described("Shown in the list of analyses.")]
    visitor: Annotated[bool, described("A visitor of a view-only server made it.")]
    created_at: Moment
    ended_at: Moment | None
    content_hash: Annotated[str | None, described("Identifies its file, runs and metrics; null until known.")]
    reason: Annotated[str | None, described("Why it failed.")]
    owner: Annotated[str | None, described("The account that it belongs to; null for nobody.")] = None
    visibility: Annotated[Visibility | None, described("Who sees it; null for everybody who is signed in.")] = None


# The answer of an experiment that chooses its runs, as JSON.


def all_failed(runs: int, failed: int) -> str | None:
    """``failed: 3 of 3`` for a candidate of which no run was good; None for another. It has no value to show."""
    return f"failed: {failed} of {runs}" if runs and failed == runs else None


class DecisionCandidate(Document):
    """One candidate: a combination of everything but the dataset."""

    label: Annotated[str, described("What sets it apart.")]
    values: Values
    cells: Annotated[dict[str, int], described("The number of its configuration in the experiment, by dataset.")]
    standing: CandidateStanding
    runs: Annotated[int, described("Runs that have ended and count.")]
    failed: Annotated[int, described("Those of them that failed.")]
    mean: Annotated[
        float | None,
        described("Mean over the datasets, failed runs included; null before the first round, and if all failed."),
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
    """A value that a candidate is expected to have, failed runs included; null if all of its runs failed."""

    expected: float | None
    low: Annotated[float | None, described("The smaller end of an interval that holds it with 95 %.")]
    high: Annotated[float | None, described("The larger end.")]


class SearchedCandidate(Document):
    """One of the candidates that may be best, or one of the best trade-offs."""

    label: Annotated[str, described("What sets it apart.")]
    values: Values
    cells: Annotated[dict[str, int], described("The number of its configuration in the experiment, by dataset.")]
    runs: Annotated[int, described("Runs that have ended and count.")]
    failed: Annotated[int, described("Those of them that failed, or broke a limit.")]
    expected: Annotated[
        float | None, described("Expected typical value, failed runs included; null if all of its runs failed.")
    ]
    low: Annotated[float | None, described("The smaller end of an interval that holds it with 95 %.")]
    high: Annotated[float | None, described("The larger end.")]
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
    runs: Annotated[int, described("Runs on whole recordings so far, those that wait included.")]
    first_looks: Annotated[int, described("Runs on the beginning of a recording, which only rank.")]
    combinations: Annotated[int, described("All combinations with all datasets.")]
    datasets: tuple[str, ...]
    candidates: Annotated[tuple[SearchedCandidate, ...], described("Those that may be best, the best first.")]
    importance: Annotated[
        tuple[AxisImportance, ...], described("The axes that vary, by objective, the most important first.")
    ]
    growth: Annotated[tuple[SearchGrowth, ...], described("After 24, 48, 96 runs and so on, and now.")]
    next: Annotated[str, described("What comes next, and why.")]
    notes: Annotated[tuple[str, ...], described("What was left out, and why.")]
