"""What goes into the store and comes out of it: frozen values, never rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from typing import Any, NamedTuple, TypedDict

from slamhive.domain.configuration import InputMap, Playback, PlaybackMode
from slamhive.domain.disturbance import Disturbance
from slamhive.domain.external import IMPORTED
from slamhive.domain.host import Host
from slamhive.domain.notes import NO_NOTES, RunNotes
from slamhive.domain.parameters import Value
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import FailureReason, RunEvent, RunState
from slamhive.domain.sensor_choice import Chosen
from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.domain.trust import Trust, judge_trust
from slamhive.domain.variant import Variant
from slamhive.domain.verdict import Verdict, VerdictKind, ended_badly, judge, not_evaluable
from slamhive.domain.versions import version_label
from slamhive.domain.visibility import TEAM_SEES, Visibility, visibility_of
from slamhive.errors import Conflict
from slamhive.evaluation.job import Artefacts
from slamhive.schema.limits import NEVER, Limits, StopWhen


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
    """What exactly ran. ``identity`` is the image digest, or the environment's hash for the process executor.

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
        """How users name it: ``aloam@2``."""
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
class RunRequest:
    """A run to queue. ``uid`` (32 hex digits, made by the caller) identifies it across installations.

    ``cpu_cores``, ``memory_mb``, ``timeout_s``: limits asked for, None for the installation's. ``priority``: higher
    goes first. ``evaluate``: evaluate it when it has succeeded, under ``protocol`` or the default of its sensors.
    ``cell``: number of the configuration in the experiment ``experiment_id``, the same for its repeats and retries.
    ``owner`` and ``visibility``: see :class:`slamhive.domain.visibility.Sharing`; who stores it fills them in.
    ``held``: queued, but no worker may claim it. ``affinity``: see :mod:`slamhive.domain.affinity`.
    ``repeat_disturbed``: how often it is repeated at most if the machine was disturbed.
    """

    uid: str
    configuration_id: int
    executor: str
    seed: int = 0
    priority: int = 0
    evaluate: bool = False
    cpu_cores: float | None = None
    memory_mb: int | None = None
    timeout_s: float | None = None
    retry_of: int | None = None
    protocol: Protocol | None = None
    experiment_id: int | None = None
    cell: int | None = None
    held: bool = False
    affinity: str = ""
    stop_when: StopWhen = NEVER
    repeat_disturbed: int = 0
    owner: str | None = None
    visibility: Visibility | None = None


class RunFields(TypedDict, total=False):
    """What a move or ``update`` may write. A field that is left out does not change."""

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


@dataclass(frozen=True, slots=True)
class RunRecord:
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
    priority: int
    evaluate: bool
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    exit_code: int | None
    poses: int | None
    cpu_cores: float | None
    memory_mb: int | None
    timeout_s: float | None
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
    stop_when: StopWhen
    disturbance: Disturbance | None = None
    repeat_disturbed: int = 0
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
        """Who sees the run besides admins."""
        return visibility_of(self.audience)

    @property
    def note(self) -> str | None:
        """What somebody wrote about the run; None for nothing."""
        return self.notes.note or None

    @property
    def tags(self) -> tuple[str, ...]:
        """Its tags, in order."""
        return self.notes.tags

    @property
    def limits(self) -> Limits:
        """The limits that were asked for or, once the run has started, set."""
        return Limits(self.cpu_cores, self.memory_mb, self.timeout_s)

    @property
    def version_label(self) -> str | None:
        """The version that ran, such as ``aloam@2``; None if the run never started."""
        number = None if self.version is None else self.version.number
        return None if number is None else version_label(self.package, number)

    @property
    def verdict(self) -> Verdict | None:
        """Whether the run is good, and if not why; None if it has not ended, was cancelled or was never evaluated."""
        if self.state is RunState.FAILED:
            return ended_badly(self.reason or self.state)
        if self.judged is None:
            return None
        return not_evaluable(None) if self.judged is VerdictKind.NOT_EVALUABLE else judge(self.metrics or {})

    @property
    def trust(self) -> Trust | None:
        """How far the measurements can be trusted; None for a run that did not end by itself or was imported."""
        if self.metrics is None or self.executor == IMPORTED:
            return None
        if self.state not in (RunState.SUCCEEDED, RunState.FAILED):
            return None
        realtime = self.playback.mode is PlaybackMode.REALTIME
        return judge_trust(self.metrics, self.disturbance, realtime=realtime)


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
    """The order of a list: one of :data:`slamhive.store.run_order.SORT_KEYS`, a metric or a parameter.

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
        """How many runs match, or the number at which counting stopped."""
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

    ``disturbed``: how many ran on a disturbed machine. ``figures``: {protocol, None for measured metrics:
    {metric: spread}}.
    """

    configuration_id: int
    algorithm: str
    dataset: str
    parameters: dict[str, Value]
    runs: int
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
class EvaluationRecord:
    """One evaluation of one run. ``engine`` computed the metrics; ``reason`` is why it failed."""

    id: int
    run_id: int
    protocol: Protocol
    state: EvaluationState
    reason: str | None
    artefacts: Artefacts
    engine: str | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    attempt: int
    lease_owner: str | None
