"""Values that go into the store and come out of it. They are frozen, and never rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any, NamedTuple, TypedDict

from slamhive.base.errors import Conflict
from slamhive.documents.limits import RunOptions
from slamhive.domain.accounts import TEAM_SEES, Sharing, Visibility, visibility_of
from slamhive.domain.algorithm import IMPORTED
from slamhive.domain.configuration import Configuration, InputMap, Playback, PlaybackMode, Variant
from slamhive.domain.packages import version_label
from slamhive.domain.parameters import Parameter, Value
from slamhive.domain.protocol import Protocol, TrajectoryKind
from slamhive.domain.question import ExperimentQuestion
from slamhive.domain.roles import Chosen
from slamhive.domain.run import NO_NOTES, FailureReason, Host, RunEvent, RunNotes, RunState
from slamhive.domain.side_by_side import ProtocolUse
from slamhive.domain.trust import Disturbance, Trust, judge_trust
from slamhive.domain.verdict import Outcome, Verdict, VerdictKind, ended_badly, judge, not_evaluable, outcome_words
from slamhive.evaluation.job import Artefacts


class LeaseLost(Conflict):
    """Another worker holds the run now; this one must let go of it."""


class EvaluationState(StrEnum):
    """The state of an evaluation. It never changes the state of its run."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class AlgorithmVersion:
    """The exact software that ran. ``identity`` is the image digest; the process executor uses the environment's hash.

    ``version`` is that of upstream. ``number`` is the one within the package; for a version that is about to be stored,
    it is the one that it should get, None for the next one.
    """

    identity: str
    package_hash: str
    version: str
    number: int | None = None


@dataclass(frozen=True, slots=True)
class VersionRecord:
    """A version of a package. ``removed_at``: when its image or environment was removed on purpose."""

    package: str
    number: int
    identity: str
    package_hash: str
    version: str
    created_at: datetime
    removed_at: datetime | None = None
    runs: int = 0

    @property
    def label(self) -> str:
        """The name that users give it: ``aloam@2``."""
        return version_label(self.package, self.number)


@dataclass(frozen=True, slots=True)
class AlgorithmRecord:
    """An algorithm with stored runs; its folder may be gone."""

    id: int
    name: str
    package: str
    mode: str


@dataclass(frozen=True, slots=True)
class DatasetRecord:
    """A dataset with stored runs."""

    id: int
    name: str
    checksum: str
    duration_s: float
    folder: str
    title: str
    sensors: tuple[dict[str, Any], ...]
    registered_at: datetime


@dataclass(frozen=True, slots=True)
class RunRequest(RunOptions):
    """A run to queue. ``uid`` (32 hex digits, made by the caller) identifies it across installations.

    It is evaluated under ``protocol`` or the default of its sensors.
    ``cell``: number of the configuration in the experiment ``experiment_id``, the same for its repeats and retries.
    ``owner`` and ``visibility``: see :class:`slamhive.domain.accounts.Sharing`; who stores it fills them in.
    ``held``: queued, but no worker may claim it. ``affinity``: see :mod:`slamhive.domain.placement`.
    """

    uid: str
    configuration_id: int
    executor: str
    seed: int = 0
    evaluate: bool = field(default=False, kw_only=True)
    retry_of: int | None = None
    protocol: Protocol | None = None
    experiment_id: int | None = None
    cell: int | None = None
    held: bool = False
    affinity: str = ""
    owner: str | None = None
    visibility: Visibility | None = None


class RunFields(TypedDict, total=False):
    """The fields that a move or ``update`` may write. A field that is left out does not change."""

    reason: FailureReason | None
    detail: str | None
    started_at: datetime | None
    ended_at: datetime | None
    exit_code: int | None
    poses: int | None
    handle: dict[str, Any] | None
    algorithm_version_id: int | None
    host_id: int | None
    dataset_checksum: str | None
    cpu_cores: float | None
    memory_mb: int | None
    timeout_s: float | None
    disturbance: Disturbance | None
    trajectory: TrajectoryKind | None


@dataclass(frozen=True, slots=True)
class ProtocolLabel:
    """The protocol of the metrics that a run shows; the label of a run's names the kind of its trajectory."""

    fingerprint: str
    label: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RunRecord(RunOptions):
    """A run with everything that lists and pages show.

    ``attempt`` counts the times a worker took the run. ``protocol_override`` is what the user asked for,
    ``protocol`` what the latest successful evaluation used. ``metrics`` holds the measured metrics and those of
    ``protocol``, {metric key: value}; None if they were not asked for. ``judged`` is the stored verdict, which comes
    with them. ``trajectory`` says which one ``traj.txt`` is, None if it is not stated. ``host`` and ``version`` are
    known once the run has started. ``disturbance`` is None where nothing was recorded of the machine.
    ``asked_version`` is the version that its configuration names, ``input_map`` the map that it starts with.
    ``notes`` are its note and tags. ``owner`` is the account that asked for it, None if nobody had signed in.
    ``visibility`` is that of the run itself, None if it follows its experiment; ``audience`` is who sees it.
    ``experiment`` is the name of the one that it belongs to, ``cell`` its place there; for the rest see
    :class:`RunRequest`.
    """

    id: int
    uid: str
    algorithm: str
    package: str
    dataset: str
    configuration_id: int
    parameters: dict[str, Value]
    playback: Playback
    variant: Variant
    sensors: Chosen
    executor: str
    state: RunState
    reason: FailureReason | None
    detail: str | None
    trajectory: TrajectoryKind | None
    seed: int
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    exit_code: int | None
    poses: int | None
    attempt: int
    lease_owner: str | None
    lease_expires_at: datetime | None
    handle: dict[str, Any] | None
    cancel_requested: bool
    retry_of: int | None
    dataset_checksum: str | None
    protocol_override: Protocol | None
    protocol: ProtocolLabel | None
    version: AlgorithmVersion | None
    host: Host | None
    experiment_id: int | None
    experiment: str | None
    cell: int | None
    held: bool
    affinity: str
    disturbance: Disturbance | None = None
    asked_version: int | None = None
    input_map: InputMap | None = None
    metrics: dict[str, float] | None = None
    judged: VerdictKind | None = None
    notes: RunNotes = NO_NOTES
    owner: str | None = None
    visibility: Visibility | None = None
    audience: str = TEAM_SEES

    @property
    def seen_by(self) -> Visibility:
        """The group that sees the run besides admins."""
        return visibility_of(self.audience)

    @property
    def note(self) -> str | None:
        """The note on the run; None if there is none."""
        return self.notes.note or None

    @property
    def tags(self) -> tuple[str, ...]:
        """Its tags, in order."""
        return self.notes.tags

    @property
    def version_label(self) -> str | None:
        """The version that ran, such as ``aloam@2``; None if the run never started."""
        number = None if self.version is None else self.version.number
        return None if number is None else version_label(self.package, number)

    @property
    def outcome(self) -> Outcome:
        """The outcome, from the state and the stored verdict; without metrics, a good run counts as not evaluated."""
        return Outcome.of(self)

    @property
    def outcome_words(self) -> str:
        """The outcome with its reason, as people read it everywhere."""
        return outcome_words(self)

    @property
    def verdict(self) -> Verdict | None:
        """The verdict: good, or why not. None if it has not ended, was cancelled, lost or never evaluated."""
        kind = verdict_kind(self.state, self.reason, self.judged)
        if kind is VerdictKind.ENDED_BADLY:
            return ended_badly(self.reason or self.state)
        if kind is None:
            return None
        return not_evaluable(None) if self.judged is VerdictKind.NOT_EVALUABLE else judge(self.metrics or {})

    @property
    def trust(self) -> Trust | None:
        """The trust in the measurements; None for a run that did not end by itself or was imported."""
        if self.metrics is None:
            return None
        return trust_in(self.metrics, self.disturbance, self.state, self.executor, self.playback.mode)


def protocol_uses(runs: Iterable[RunRecord]) -> list[ProtocolUse]:
    """The protocols and trajectories behind the errors of these runs; runs without errors are left out."""
    return [
        ProtocolUse(run.protocol.fingerprint, run.protocol.label, run.trajectory)
        for run in runs
        if run.protocol is not None
    ]


def group_uses(groups: Iterable[GroupRecord]) -> list[ProtocolUse]:
    """The protocols behind the errors of these groups; the kinds of their trajectories are not known."""
    labels = (label for group in groups for label in group.figures if label is not None)
    return [ProtocolUse(label.fingerprint, label.label, None) for label in labels]


def trust_in(
    metrics: Mapping[str, float],
    disturbance: Disturbance | None,
    state: RunState,
    executor: str,
    playback: PlaybackMode,
) -> Trust | None:
    """The trust in the measurements of a run; None for one that did not end by itself or was imported."""
    if executor == IMPORTED or state not in (RunState.SUCCEEDED, RunState.FAILED):
        return None
    return judge_trust(metrics, disturbance, realtime=playback is PlaybackMode.REALTIME)


def verdict_kind(state: RunState, reason: FailureReason | None, judged: VerdictKind | None) -> VerdictKind | None:
    """The kind of :attr:`RunRecord.verdict`, from the stored verdict alone.

    A lost run has none: that it was taken away says nothing about it.
    """
    if state is RunState.FAILED:
        return None if reason is FailureReason.LOST else VerdictKind.ENDED_BADLY
    return judged


@dataclass(frozen=True, slots=True)
class RunSnapshot:
    """A run as its sealed folder describes it, to rebuild the row under the same ``id``."""

    id: int
    request: RunRequest
    state: RunState
    created_at: datetime
    fields: RunFields = field(default_factory=RunFields)
    attempt: int = 1
    events: tuple[RunEvent, ...] = ()


@dataclass(frozen=True, slots=True)
class RunSort:
    """The order of a list: one of :data:`slamhive.store.run_listing.SORT_KEYS`, a metric or a parameter.

    Runs without a value come last in both directions; equal values are ordered by id.
    """

    key: str = "id"
    descending: bool = True


class Count(NamedTuple):
    """A number of rows; if it is not ``exact``, there are more than ``number``."""

    number: int
    exact: bool = True


@dataclass(frozen=True, slots=True)
class Page:
    """One page of a list. ``count``: all runs that match. ``next_key``: asks for the next page; None at the end."""

    records: tuple[RunRecord, ...]
    count: Count
    next_key: str | None

    @property
    def total(self) -> int:
        """The number of runs that match, or the number at which counting stopped."""
        return self.count.number


@dataclass(frozen=True, slots=True)
class Spread:
    """A metric over ``n`` runs: mean, median, standard deviation of the sample (None for one run), and the extremes."""

    n: int
    mean: float
    median: float
    std: float | None
    minimum: float
    maximum: float


@dataclass(frozen=True, slots=True)
class GroupRecord:
    """A configuration and its runs that a search found: how many, how many failed, and their metrics.

    ``all_runs``: how many runs it has, those that the search omits included. ``disturbed``: how many ran on a disturbed
    machine. ``figures``: {protocol, None for measured metrics: {metric: spread}}.
    """

    configuration_id: int
    algorithm: str
    dataset: str
    parameters: dict[str, Value]
    runs: int
    all_runs: int
    failed: int
    disturbed: int
    figures: dict[ProtocolLabel | None, dict[str, Spread]]


@dataclass(frozen=True, slots=True)
class GroupPage:
    """One page of groups. ``runs`` counts the matching runs of all groups."""

    records: tuple[GroupRecord, ...]
    runs: Count
    next_key: str | None


Repeats = dict[tuple[int, str | None, str], list[float]]
"""{(configuration, fingerprint of the protocol or None for measured metrics, metric): values in order of the runs}."""


@dataclass(frozen=True, slots=True)
class SavedSearchRecord:
    """A search with a name: its filter, columns and order, and how the list looks.

    ``pinned``: so many of the first columns stay in view. ``colours``: metrics have a background by their value.
    ``sparks``: errors over time, or the repeats of a configuration, are drawn in the list.
    """

    name: str
    filter_text: str
    columns: tuple[str, ...]
    sort: RunSort
    grouped: bool
    pinned: int = 0
    colours: bool = False
    sparks: bool = False


@dataclass(frozen=True, slots=True)
class EndedEvaluation:
    """An evaluation that has ended, as it is filed. ``engine`` computed the metrics; ``reason`` is why it failed."""

    protocol: Protocol
    state: EvaluationState
    reason: str | None
    artefacts: Artefacts
    engine: str | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    attempt: int


@dataclass(frozen=True, slots=True)
class EvaluationRecord(EndedEvaluation):
    """One evaluation of one run, which may go on."""

    id: int
    run_id: int
    lease_owner: str | None


# -- analyses ----------------------------------------------------------------------------------------------------------


class AnalysisState(StrEnum):
    """Where an analysis is in its life."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"

    @property
    def ended(self) -> bool:
        """True if it stays in this state unless somebody computes it again."""
        return self in (AnalysisState.DONE, AnalysisState.FAILED)


@dataclass(frozen=True, slots=True)
class AnalysisRecord:
    """A stored analysis. Its folder is the truth; this is its place in lists and in the queue.

    ``token`` (32 hex digits) is its permanent address and cannot be guessed. A ``visitor`` made it in view-only mode.
    ``content_hash`` identifies what it shows (the text of its file, its runs and their metrics); None until that is
    known. ``reason``: why it failed. ``size_bytes``: the stored report, None while there is none.
    ``owner`` and ``visibility``: see :class:`slamhive.domain.accounts.Sharing`.
    """

    token: str
    name: str
    state: AnalysisState
    listed: bool
    visitor: bool
    created_at: datetime
    content_hash: str | None = None
    reason: str | None = None
    size_bytes: int | None = None
    ended_at: datetime | None = None
    attempt: int = 0
    lease_owner: str | None = None
    owner: str | None = None
    visibility: Visibility | None = None

    @property
    def sharing(self) -> Sharing:
        """Owner and visibility."""
        return Sharing(self.owner, self.visibility)

    @property
    def seen_by(self) -> Visibility:
        """The group that sees the analysis besides admins."""
        return self.sharing.seen_by


# -- experiments -------------------------------------------------------------------------------------------------------


class ExperimentState(StrEnum):
    """The state that the user last asked for. The runs tell whether the experiment has finished."""

    ACTIVE = "active"
    PAUSED = "paused"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class ExperimentRecord:
    """An experiment. ``source`` is the file as the user gave it, ``content_hash`` identifies its content.

    The uids of its runs follow from ``uid`` (32 hex digits). ``repeats`` is for each seed and may have grown since.
    ``cells`` and ``runs`` (without retries) are upper bounds until all are stored, that is, until it is ``complete``.
    ``cpu_model``: that of all its runs, empty while none has been measured, None if any will do.
    ``owner`` and ``visibility``: see :class:`slamhive.domain.accounts.Sharing`; they are those of its runs, too.
    One with a ``question`` chooses its runs until it has a ``conclusion``, a sentence.
    """

    id: int
    uid: str
    name: str
    description: str
    content_hash: str
    source: str
    state: ExperimentState
    executor: str
    priority: int
    repeats: int
    cells: int
    runs: int
    complete: bool
    created_at: datetime
    cpu_model: str | None = None
    owner: str | None = None
    visibility: Visibility | None = None
    question: ExperimentQuestion | None = None
    conclusion: str | None = None

    @property
    def undecided(self) -> bool:
        """It still chooses runs."""
        return self.question is not None and self.conclusion is None

    @property
    def sharing(self) -> Sharing:
        """Owner and visibility."""
        return Sharing(self.owner, self.visibility)

    @property
    def seen_by(self) -> Visibility:
        """The group that sees the experiment besides admins."""
        return self.sharing.seen_by


@dataclass(frozen=True, slots=True)
class CellRecord:
    """A cell: its configuration, and its value on each axis that applies to it."""

    number: int
    name: str
    configuration_id: int
    values: Mapping[str, Value]


@dataclass(frozen=True, slots=True)
class CellRun:
    """A run of a cell, for tables of cells. ``retried``: a later run replaced it; ``retry_of``: the one it replaced.

    ``disturbed``: it was measured on a disturbed machine; None if that is not known. ``judged``: the stored verdict,
    None if nobody has evaluated it.
    """

    id: int
    cell: int
    seed: int
    state: RunState
    reason: FailureReason | None
    retried: bool
    retry_of: int | None = None
    disturbed: bool | None = None
    protocol: str | None = None
    metrics: dict[str, float] = field(default_factory=dict)
    judged: VerdictKind | None = None


@dataclass(frozen=True, slots=True)
class StateCount:
    """The number of runs in a state for a reason; ``retried`` runs, which another run replaced, count separately.

    ``judged``: their stored verdict, None where nobody has evaluated them.
    """

    state: RunState
    reason: FailureReason | None
    retried: bool
    count: int
    judged: VerdictKind | None = None


@dataclass(frozen=True, slots=True)
class NewConfiguration:
    """A configuration to store; its algorithm and dataset are stored already.

    ``definitions``: the algorithm's parameters; a key without one is filed under its value's own type.
    """

    configuration: Configuration
    content_hash: str
    algorithm_id: int
    dataset_id: int
    definitions: Sequence[Parameter] = ()


@dataclass(frozen=True, slots=True)
class KnownConfiguration:
    """The number of runs of a stored configuration, and their mean duration; None if no duration is known."""

    runs: int
    measured_runs: int
    duration_s: float | None
