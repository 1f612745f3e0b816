"""``run.json``: the record in a run folder, from which the row of the run can be rebuilt."""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Annotated, Any, Self, get_args, get_type_hints

from pydantic import AliasChoices, ConfigDict, Field, FiniteFloat, create_model, model_validator
from pydantic import StrictBool as Flag
from pydantic import StrictFloat as Number
from pydantic import StrictInt as Whole

from slamhive.documents.imports import OriginDocument
from slamhive.documents.limits import RunOptions, StopWhen
from slamhive.documents.model import Document, FoundDisturbance, Moment, Rules, Values, described
from slamhive.documents.protocol import StatedProtocol
from slamhive.documents.run import Event
from slamhive.domain.configuration import Configuration, InputMap, Playback, Variant
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import FailureReason, RunEvent, RunState

FORMAT = 1


class ConfigurationContent(Document):
    """The configuration that is run."""

    algorithm: str
    dataset: str
    parameters: Values
    playback: Playback
    variant: Variant = ()
    sensors: Annotated[dict[str, str], described("Sensors that were chosen in place of the rule, by role.")] = Field(
        default_factory=dict
    )
    version: Annotated[Whole | None, described("Version of the package that was asked for; null for the newest.")] = (
        Field(default=None, validation_alias=AliasChoices("asked_version", "version"))
    )
    map: Annotated[InputMap | None, described("The map that the algorithm starts with.")] = Field(
        default=None, validation_alias=AliasChoices("input_map", "map")
    )

    @property
    def configuration(self) -> Configuration:
        """The configuration with this content."""
        more = (self.sensors, self.version, self.map)
        return Configuration(self.algorithm, self.dataset, self.parameters, self.playback, self.variant, *more)


_STRICT: dict[Any, Any] = {float: Number, int: Whole, bool: Flag, StopWhen: Rules}


def _stored(kind: Any) -> Any:
    """The type of an option in a file: not checked against what may be asked for today, which may change."""
    optional = type(None) in get_args(kind)
    plain = get_args(kind)[0] if optional else kind
    strict = _STRICT.get(plain, plain)
    return strict | None if optional else strict


if TYPE_CHECKING:

    class StoredOptions(Document):
        """The options of a run in a file."""
else:
    _KINDS = get_type_hints(RunOptions)
    StoredOptions = create_model(
        "StoredOptions",
        __base__=Document,
        __module__=__name__,
        **{option.name: (_stored(_KINDS[option.name]), option.default) for option in fields(RunOptions)},
    )


class RecordedRequest(StoredOptions, ConfigurationContent):
    """The request for the run."""

    executor: str
    seed: Whole
    retry_of: Annotated[Whole | None, described("Number of the run that this one repeats.")]
    experiment: Annotated[str | None, described("Name of its experiment.")] = None
    cell: Any = None
    protocol: Annotated[
        StatedProtocol | None, described("The protocol that was asked for; null for that of the sensors.")
    ] = Field(default=None, validation_alias=AliasChoices("protocol_override", "protocol"))


class Handle(Document):
    """The data for finding a started run again."""

    executor: str
    data: dict[str, str]


class RunStart(Document):
    """The record of a run that is about to be prepared."""

    format: int = FORMAT
    id: Annotated[int, described("Number in the installation that ran it.")]
    uid: Annotated[str, described("Identifies the run in every installation.")]
    request: RecordedRequest
    created_at: Moment
    attempt: Annotated[int, described("How many times a worker has taken the run.")] = 1
    state: RunState


class RecordedOutcome(Document):
    """The end of a run."""

    state: RunState
    reason: FailureReason | None = None
    detail: str | None = None
    started_at: Moment | None = None
    ended_at: Moment | None = None
    exit_code: Whole | None = None
    poses: Whole | None = None
    handle: Annotated[dict[str, Any] | None, described("What the executor needs to find the run again.")] = None
    disturbance: FoundDisturbance | None = None


class RecordedVersion(Document):
    """The version that ran."""

    package: str | None = None
    mode: str = ""
    identity: Annotated[str | None, described("Digest of the image, or hash of the environment.")] = None
    package_hash: str | None = None
    version: str | None = None
    number: Annotated[Whole | None, described("Number of the version within its package.")] = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.identity is not None and None in (self.package_hash, self.version):
            raise ValueError("package_hash or version is missing")
        return self


class RecordedMachine(Document):
    """The machine a run was measured on."""

    cpu_model: str
    cpu_count: Whole
    memory_bytes: Whole
    kernel: str
    os: str


class DatasetVersion(Document):
    """The dataset as it was."""

    checksum: str | None = None


class RunFile(RecordedOutcome, RunStart):
    """The record of a run. Keys that are not listed here are kept as they are."""

    model_config = ConfigDict(extra="allow", title="SLAM Hive run record")
    algorithm: RecordedVersion = RecordedVersion()
    dataset: DatasetVersion = DatasetVersion()
    host: RecordedMachine | None = None
    trajectory: Annotated[
        TrajectoryKind | None, described("Which trajectory traj.txt is; null if it is not stated.")
    ] = None
    metrics: Annotated[dict[str, FiniteFloat], described("What was measured while the run was active.")] = Field(
        default_factory=dict
    )
    spec: Annotated[dict[str, Any], described("The frozen specification that the executor was given.")] = Field(
        default_factory=dict
    )
    events: tuple[Event, ...] = ()
    imported: Annotated[OriginDocument | None, described("Where the trajectory of an imported run comes from.")] = None

    @property
    def moves(self) -> tuple[RunEvent, ...]:
        """The moves of the run, the oldest first."""
        return tuple(RunEvent(event.at, event.from_state, event.to_state, event.why) for event in self.events)
