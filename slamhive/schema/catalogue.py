"""What can run, and on what, as JSON: algorithms, datasets and configurations."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AliasPath, BeforeValidator, Field

from slamhive.domain.algorithm import RunUser
from slamhive.domain.configuration import Playback
from slamhive.domain.parameters import ParameterType, Value
from slamhive.domain.pose_time import PoseTime
from slamhive.domain.protocol_choices import Alignment
from slamhive.domain.sensors import SensorKind, SensorSetup
from slamhive.domain.trajectory_kind import TrajectoryKind
from slamhive.domain.variant import Variant
from slamhive.schema.fields import described
from slamhive.schema.model import Document
from slamhive.schema.types import Timestamp


class Package(Document):
    """The code that the modes of an algorithm share."""

    name: str
    title: str
    version: str
    upstream: str
    licence: str
    citation: str
    image: Annotated[str, described("The Docker image.")]
    user: Annotated[RunUser, described("Who its runs are in a container.")]
    origin: Annotated[
        str | None,
        BeforeValidator(lambda origin: None if origin is None else origin.public.words),
        described("Where it was imported from; null if it was written for SLAM Hive."),
    ]


class Version(Document):
    """One version of a package, and what is here of it."""

    version: Annotated[str, described("How filters and commands name it: aloam@2.")] = Field(
        validation_alias=AliasPath("record", "label")
    )
    number: int = Field(validation_alias=AliasPath("record", "number"))
    upstream_version: str = Field(validation_alias=AliasPath("record", "version"))
    identity: Annotated[str, described("Digest of the image, or hash of the environment.")] = Field(
        validation_alias=AliasPath("record", "identity")
    )
    package_hash: str = Field(validation_alias=AliasPath("record", "package_hash"))
    created_at: Timestamp = Field(validation_alias=AliasPath("record", "created_at"))
    removed_at: Timestamp | None = Field(validation_alias=AliasPath("record", "removed_at"))
    runs: Annotated[int, described("How many runs used it.")] = Field(validation_alias=AliasPath("record", "runs"))
    runs_on: Annotated[tuple[str, ...], described("Executors that can run it now.")]
    kept: Annotated[bool, described("The folder of the package is kept as it was.")]


class Parameter(Document):
    """One parameter of an algorithm."""

    type: ParameterType
    default: Annotated[Value | None, described("Null if it is always taken from a sensor.")]
    source: Annotated[
        str | None,
        BeforeValidator(lambda source: None if source is None else str(source)),
        described("The property of a sensor that gives the value unless the user does, for instance left.fx."),
    ] = None
    unit: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    general: Annotated[str | None, described("Its name across algorithms.")]
    help: str


class Bound(Document):
    """What runs of an algorithm on one dataset keep."""

    dataset: str
    poses: Annotated[int, described("The trajectory has at least so many poses.")]
    ate_rmse_m: Annotated[float | None, described("The absolute trajectory error (RMSE) is at most this.", unit="m")]
    alignment: Annotated[Alignment, described("How the estimate is aligned to the ground truth.")]
    playback: Playback
    parameters: Annotated[dict[str, Value], described("Values that differ from the defaults.")]
    relations_m: Annotated[
        float | None, described("The mean translation error over the dataset's relations is at most this.", unit="m")
    ] = None
    relations_deg: Annotated[
        float | None, described("The mean rotation error over the dataset's relations is at most this.", unit="deg")
    ] = None


class BoundResult(Document):
    """A run that tested a bound."""

    algorithm: str
    bound: Bound
    run: Annotated[int, described("The number of the run.")]
    poses: Annotated[int | None, described("Poses of its trajectory.")]
    ate_rmse_m: Annotated[float | None, described("Its absolute trajectory error (RMSE).", unit="m")]
    relations_m: Annotated[
        float | None, described("Its mean translation error over the dataset's relations.", unit="m")
    ] = None
    relations_deg: Annotated[
        float | None, described("Its mean rotation error over the dataset's relations.", unit="deg")
    ] = None
    latency_median_ms: Annotated[float | None, described("Median time from a frame to its pose.", unit="ms")]
    memory_max_mb: Annotated[float | None, described("Largest memory use.", unit="MB")]
    problem: Annotated[str | None, described("Why the bound is not kept; null if it is.")]


class Algorithm(Document):
    """An algorithm: a package in one mode."""

    name: str
    title: str
    mode: str
    setup: SensorSetup
    inputs: Annotated[
        dict[str, SensorKind],
        BeforeValidator(lambda raw: raw if isinstance(raw, dict) else {entry.role: entry.kind for entry in raw}),
        described("The kind of sensor that each role needs."),
    ]
    trajectory: Annotated[
        TrajectoryKind | None, described("Which trajectory traj.txt is: live, final, keyframes; null if not stated.")
    ] = None
    pose_time: Annotated[
        PoseTime | None,
        described("The instant that poses describe: message (timestamp of the image or scan), or sweep_start, ..."),
    ] = None
    package: Package
    unknown: Annotated[tuple[str, ...], described("What an import did not find and nobody has filled in.")]
    parameters: Annotated[
        dict[str, Parameter],
        BeforeValidator(lambda raw: raw if isinstance(raw, dict) else {entry.key: entry for entry in raw}),
    ]
    bounds: Annotated[tuple[Bound, ...], described("What its runs on some datasets keep.")] = ()


class Sensor(Document):
    """One sensor of a dataset."""

    name: str
    kind: SensorKind
    topic: str
    rate_hz: Annotated[float, described("Messages per second.", unit="Hz")]
    T_body_sensor: Annotated[tuple[float, ...], described("Pose of the sensor in the body frame, row by row.")]
    calibration: dict[str, Any]


class GroundTruth(Document):
    """The reference trajectory of a dataset."""

    file: str
    exists: Annotated[bool, described("The file is there.")]
    gravity_aligned: Annotated[bool, described("The z axis points up.")]
    positions_only: bool
    source: Annotated[str, described("What measured it.")]


class Dataset(Document):
    """A dataset. Files are named relative to its folder, whose place is private."""

    name: str
    title: str
    description: str
    licence: str
    citation: str
    source: str
    attributes: tuple[str, ...]
    duration_s: Annotated[float, described("Duration of the recording.", unit="s")]
    bag: Annotated[
        str | None, BeforeValidator(lambda name: name or None), described("The recording; null if there is none.")
    ]
    checksum: str
    sensors: tuple[Sensor, ...]
    groundtruth: GroundTruth | None
    relations: Annotated[str | None, described("File of relative poses measured by people.")]


class ParameterValue(Document):
    """A value with the definition that it was stored with."""

    value: Value
    type: str
    unit: str
    general: str | None


class Configuration(Document):
    """A configuration with what users say about it."""

    id: int
    name: str | None
    note: str
    groups: tuple[str, ...]
    algorithm: str
    dataset: str
    parameters: dict[str, ParameterValue]
    variant: Variant
    sensors: Annotated[dict[str, str], described("Sensors that were chosen in place of the rule, by role.")]
    playback: Playback
    content_hash: str
    created_at: Timestamp
    runs: Annotated[int, described("How many runs it has.")]
    experiments: tuple[str, ...]
