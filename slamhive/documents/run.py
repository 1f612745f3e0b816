"""A run and its evaluations as JSON: what the command line, the web API and exports show."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AliasChoices, Field, ValidatorFunctionWrapHandler, WrapValidator
from typing_extensions import TypedDict

from slamhive.documents.limits import Limits
from slamhive.documents.model import Document, FoundDisturbance, Moment, Rules, Timestamp, Values, described
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import InputMap, Playback, Variant
from slamhive.domain.finding import MOST_PINNED
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import TrustLevel
from slamhive.domain.verdict import Hint, Outcome, VerdictKind


class MetricValueDocument(TypedDict):
    """One metric of a run. A plain dictionary: a run has some seventy of them."""

    value: float
    unit: Annotated[str | None, described("Unit of the value; null for a metric that is not in the catalogue.")]


_NUMBERS = {float, int}


def _metrics(raw: Any, read: ValidatorFunctionWrapHandler) -> Any:
    """``{key: value}`` of a record in the order of the catalogue, other keys last; or what JSON holds."""
    if not raw or not set(map(type, raw.values())) <= _NUMBERS:
        return read(raw or {})
    known = {key: {"value": raw[key], "unit": metric.unit} for key, metric in CATALOGUE.items() if key in raw}
    return known | {key: {"value": value, "unit": None} for key, value in raw.items() if key not in known}


Metrics = Annotated[dict[str, MetricValueDocument], WrapValidator(_metrics)]


class VerdictDocument(Document):
    """Verdict on a run: failed or not, and why."""

    kind: VerdictKind
    failed: bool
    words: str


class TrustReasonDocument(Document):
    """One reason why a run cannot be trusted fully, and what to do about it."""

    kind: str
    level: TrustLevel
    words: str
    remedy: str


class TrustDocument(Document):
    """Trust in the measurements of a run, with reasons."""

    level: Annotated[TrustLevel | None, described("Null if too little was measured.")]
    doubt: Annotated[str, described("The mark that people read: doubtful or very doubtful; empty for none.")] = ""
    reasons: tuple[TrustReasonDocument, ...]
    not_measured: Annotated[tuple[str, ...], described("What was not measured, if the level is null.")]


class ProtocolName(Document):
    """The protocol of the metrics that are shown."""

    fingerprint: str
    label: str


class Event(Document):
    """One move of a run."""

    at: Moment
    from_state: RunState | None = Field(alias="from")
    to_state: RunState = Field(alias="to")
    why: str


class ShownEvent(Event):
    """One move of a run, its time to the millisecond."""

    at: Timestamp


class RunDocument(Document):
    """A run with its metrics. What is not known is null; absent metrics are left out."""

    id: Annotated[int, described("Number in this installation.")]
    uid: Annotated[str, described("Identifies the run in every installation.")]
    algorithm: str
    version: Annotated[str | None, described("The version of its package that ran, such as aloam@2.")] = Field(
        validation_alias=AliasChoices("version_label", "version")
    )
    dataset: str
    configuration: Annotated[int, described("Number of the configuration.")] = Field(
        validation_alias=AliasChoices("configuration_id", "configuration")
    )
    parameters: Values
    playback: Playback
    variant: Annotated[Variant, described("Pre-processing steps of the dataset, in order.")]
    sensors: Annotated[dict[str, str], described("Sensors that were chosen in place of the rule, by role.")]
    map: Annotated[InputMap | None, described("The map that the algorithm started with.")] = Field(
        default=None, validation_alias=AliasChoices("input_map", "map")
    )
    executor: str
    seed: int
    state: RunState
    reason: Annotated[FailureReason | None, described("Why the run failed.")]
    detail: str | None
    created_at: Timestamp
    started_at: Timestamp | None
    ended_at: Timestamp | None
    exit_code: int | None
    poses: Annotated[int | None, described("Poses of the estimated trajectory.")]
    trajectory: Annotated[TrajectoryKind | None, described("Which trajectory that is; null if it is not stated.")]
    limits: Limits
    retry_of: Annotated[int | None, described("Number of the run that this one repeats.")]
    experiment: str | None
    cell: Annotated[int | None, described("Number of the configuration within the experiment.")]
    held: Annotated[bool, described("Queued, but not to be started: its experiment is paused.")]
    stop_when: Rules
    repeat_disturbed: int
    disturbance: FoundDisturbance | None
    owner: Annotated[str | None, described("The account that the run belongs to; null for nobody.")] = None
    visibility: Annotated[Visibility, described("Who may see the run, besides admins.")] = Field(
        default=Visibility.TEAM, validation_alias=AliasChoices("seen_by", "visibility")
    )
    note: Annotated[str | None, described("What somebody wrote about the run.")] = None
    tags: Annotated[tuple[str, ...], described("Tags that somebody gave the run.")] = ()
    trust: TrustDocument | None = None
    protocol: ProtocolName | None
    outcome: Annotated[Outcome, described("Good, failed, lost and so on: the state together with the verdict.")]
    outcome_words: Annotated[str, described("The outcome with its reason, such as: failed: out of memory.")] = ""
    verdict: VerdictDocument | None
    metrics: Metrics

    @property
    def content(self) -> dict[str, Any]:
        """The document as JSON. Metrics are JSON already, and most of it."""
        return {**self.model_dump(mode="json", by_alias=True, exclude={"metrics"}), "metrics": self.metrics}


class RunWith(RunDocument):
    """A run with its moves and evaluations, the oldest first."""

    evaluations: tuple[EvaluationDocument, ...]
    events: tuple[ShownEvent, ...]


class EvaluationDocument(Document):
    """One evaluation: under which protocol, how it went, why it failed, and hints at mistakes."""

    id: int
    run: Annotated[int, described("Number of the run.")] = Field(validation_alias=AliasChoices("run_id", "run"))
    protocol: ProtocolName
    state: str
    reason: str | None
    hints: tuple[Hint, ...] = ()
    engine: Annotated[str | None, described("Software that computed the metrics, with its version.")]
    created_at: Timestamp
    ended_at: Timestamp | None


# What a run or a recording shows at a moment.


Position = tuple[float, float, float]


class FrameFateDocument(Document):
    """The end of a frame that an algorithm was given."""

    timestamp_s: Annotated[float, described("Its timestamp in the recording.")]
    dropped: bool
    latency_s: Annotated[float | None, described("From its arrival to its result; null without a result.")]


class RunMoment(Document):
    """State of a run at a moment."""

    timestamp_s: Annotated[float, described("The timestamp that was asked for.")]
    error_m: Annotated[float | None, described("Position error of the nearest matched pose; null if none is near.")]
    frame: Annotated[FrameFateDocument | None, described("The nearest frame; null if none is near.")]


class SweepDocument(Document):
    """One sweep of a LiDAR."""

    time_s: Annotated[float, described("When it was received, from the start of the recording.")]
    points: Annotated[int, described("How many points it has.")]
    positions_m: Annotated[
        tuple[Position, ...], described("In the frame of the sensor, thinned out if there are many.")
    ]


# The fields that say how a list of runs looks.


Pinned = Annotated[int, described("How many of the first columns stay in view.", ge=0, le=MOST_PINNED)]
Colours = Annotated[bool, described("Metrics have a background by their value.")]
Sparks = Annotated[bool, described("Errors over time, or the repeats of a configuration, are drawn in the list.")]
