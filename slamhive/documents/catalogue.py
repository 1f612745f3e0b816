"""Catalogue of what can run, as JSON: algorithms, datasets and configurations."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AliasPath, BeforeValidator, Field
from pydantic.json_schema import SkipJsonSchema

from slamhive.documents.model import Document, Timestamp, described
from slamhive.domain import dataset as domain
from slamhive.domain.algorithm import RunUser
from slamhive.domain.collection import Collection, NeedKind, Sequence
from slamhive.domain.configuration import Playback, Variant
from slamhive.domain.finding import FoundKind
from slamhive.domain.matching import Match, Origin
from slamhive.domain.names import plain
from slamhive.domain.parameters import ParameterType, Value
from slamhive.domain.protocol import Alignment, PoseTime, TrajectoryKind
from slamhive.domain.sensors import SensorKind, SensorSetup


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


class ParameterDocument(Document):
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


class BoundDocument(Document):
    """Bounds that runs of an algorithm on one dataset keep."""

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
    bound: BoundDocument
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


class AlgorithmDocument(Document):
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
        dict[str, ParameterDocument],
        BeforeValidator(lambda raw: raw if isinstance(raw, dict) else {entry.key: entry for entry in raw}),
    ]
    bounds: Annotated[tuple[BoundDocument, ...], described("What its runs on some datasets keep.")] = ()


class SensorDocument(Document):
    """One sensor of a dataset."""

    name: str
    kind: SensorKind
    topic: str
    rate_hz: Annotated[float, described("Messages per second.", unit="Hz")]
    T_body_sensor: Annotated[tuple[float, ...], described("Pose of the sensor in the body frame, row by row.")]
    calibration: dict[str, Any]


class GroundTruthDocument(Document):
    """The reference trajectory of a dataset."""

    file: str
    exists: Annotated[bool, described("The file is there.")]
    gravity_aligned: Annotated[bool, described("The z axis points up.")]
    positions_only: bool
    source: Annotated[str, described("What measured it.")]


class DatasetDocument(Document):
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
    sensors: tuple[SensorDocument, ...]
    groundtruth: GroundTruthDocument | None
    relations: Annotated[str | None, described("File of relative poses measured by people.")]


class ParameterValue(Document):
    """A value with the definition that it was stored with."""

    value: Value
    type: str
    unit: str
    general: str | None


class ConfigurationDocument(Document):
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


# How an algorithm and a dataset fit together, as JSON.


class UsedSensor(Document):
    """The sensor in a role, as the run sees it."""

    name: str
    kind: SensorKind
    topic: str
    rate_hz: Annotated[float, described("Messages per second.", unit="Hz")]
    fitting: Annotated[tuple[str, ...], described("All sensors of the dataset that fit the role.")]


class BoundParameter(Document):
    """A parameter that is taken from a sensor unless the user sets it."""

    value: Value
    source: Annotated[str, described("The property, for instance left.fx.")]
    sensors: Annotated[tuple[str, ...], described("The sensors that it belongs to.")]
    origin: Annotated[Origin, described("Where the value comes from: the sensor, the package's default, or the user.")]
    found: Annotated[Value | None, described("What the dataset has; null if nothing.")]
    words: Annotated[str, described("Where the value comes from, for people.")]


class MatchDocument(Document):
    """Sensors assigned to roles, and the parameters taken from them."""

    sensors: dict[str, UsedSensor]
    parameters: dict[str, BoundParameter]
    topics: Annotated[dict[str, str], described("How the messages of each role reach the algorithm, for people.")] = (
        Field(default_factory=dict)
    )

    @classmethod
    def of_match(cls, match: Match) -> Self:
        """The document of a match."""
        return cls(
            sensors={
                role: UsedSensor.of(sensor, fitting=[entry.name for entry in match.fitting[role]])
                for role, sensor in match.sensors.items()
            },
            parameters={entry.key: BoundParameter.of(entry) for entry in match.bound},
            topics={entry.role: entry.words for entry in match.remaps},
        )


# Variants of datasets and the steps that make them, as JSON.


class CachedVariant(Document):
    """A variant in the cache."""

    key: Annotated[str, described("Identifies its recording: the same data and steps give the same key.")]
    dataset: str
    steps: Variant
    size_bytes: Annotated[int, described("Space that it takes.", unit="bytes")]
    made_at: Timestamp
    used_at: Annotated[Timestamp, described("When it was last used.")]
    in_use: bool


class StepOptionDocument(Document):
    """An option of a step."""

    name: str
    type: str
    default: Any
    required: bool
    unit: str
    allowed: Annotated[str, described("The range or the choices; empty if every value is allowed.")]
    help: str
    choices: Annotated[SkipJsonSchema[tuple[str, ...]], Field(exclude=True)] = ()
    """For forms: the words of an option that takes only some."""

    @property
    def explanation(self) -> str:
        """The help with what is allowed: ``Width and height times this; above 0, at most 1``."""
        return f"{self.help.removesuffix('.')}; {self.allowed or self.type}."

    @property
    def hint(self) -> str:
        """The default for an empty field: ``default 4``, ``required``, ``not set``."""
        if self.required:
            return "required"
        if isinstance(self.default, int | float) and not isinstance(self.default, bool):
            return f"default {plain(self.default)}"
        return "not set" if self.default is None else f"default {str(self.default).lower()}"


class StepDocument(Document):
    """A kind of step with its options."""

    kind: str
    help: str
    options: tuple[StepOptionDocument, ...]


# The report of the checks of a dataset, as JSON.


class FindingDocument(Document):
    """One thing that is wrong with a dataset."""

    check: Annotated[str, described("The check that found it.")]
    severity: Annotated[domain.Severity, described("How bad it is.")]
    about: Annotated[str, described("The sensor, groundtruth or recording.")]
    topic: Annotated[str | None, described("The topic of the sensor.")]
    message: Annotated[str, described("What was found.")]
    remedy: Annotated[str, described("What to do about it.")]
    at_s: Annotated[float | None, described("First place, from the start; null: everywhere.", unit="s")]
    count: Annotated[int, described("In how many places.")]
    value: Annotated[float | None, described("What was measured; null if it is no number.")]
    unit: Annotated[str, described("The unit of the value.")]
    expected: Annotated[str, described("What was expected instead.")]


class NotCheckedDocument(Document):
    """A check that could not be done."""

    check: Annotated[str, described("The check.")]
    about: Annotated[str, described("The sensor, or what else it is about.")]
    reason: Annotated[str, described("Why it was not done.")]


class DatasetCheck(Document):
    """The result of all checks of one dataset."""

    dataset: str
    checksum: Annotated[str, described("Of the dataset that was checked.")]
    files: Annotated[str, described("Identifies dataset.yaml and the ground truth that were checked.")]
    version: Annotated[int, described("Of the checks; reports of other versions are outdated.")]
    checks: Annotated[tuple[str, ...], described("The names of all checks.")]
    findings: Annotated[tuple[FindingDocument, ...], described("The worst first.")]
    not_checked: Annotated[tuple[NotCheckedDocument, ...], described("What could not be checked, and why.")]

    def count(self, severity: domain.Severity) -> int:
        """The number of findings of one severity."""
        return sum(finding.severity == severity for finding in self.findings)


# Trials of a ground truth as JSON.


class ContradictionDocument(Document):
    """A stretch in which systems agree with each other and contradict the ground truth."""

    begin_s: Annotated[float, described("First timestamp, on the clock of the ground truth.", unit="s")]
    end_s: Annotated[float, described("Last timestamp.", unit="s")]
    rms_m: Annotated[float, described("RMS difference from the systems' common path, aligned around it.", unit="m")]
    max_m: Annotated[float, described("The largest difference.", unit="m")]
    agreeing: Annotated[tuple[str, ...], described("The systems that agree.")]
    differing: Annotated[tuple[str, ...], described("The systems there that do not.")]
    ratio: Annotated[float, described("What the systems have in common over what they have not.")]
    blame: Annotated[domain.Blame, described("The side that it speaks against: truth, or undecided.")]
    because: Annotated[str, described("Reason for that.")]
    confidence: Annotated[str, described("high, medium or low.")]


class ConstantOffsetDocument(Document):
    """A constant between ground truth and sensors on which the systems agree."""

    kind: Annotated[str, described("lever_arm or time_offset.")]
    values: Annotated[tuple[float, ...], described("x, y, z in m, or the offset in s.")]
    sigmas: Annotated[tuple[float, ...], described("Standard errors.")]
    agreeing: Annotated[tuple[str, ...], described("The systems that agree.")]


class TruthTrialDocument(Document):
    """The systems on a dataset against its ground truth."""

    dataset: str
    files: Annotated[str, described("Identifies dataset.yaml and the ground truth that were judged.")]
    version: Annotated[int, described("Of the rules; trials of other versions are outdated.")]
    systems: Annotated[tuple[str, ...], described("Those that took part.")]
    runs: Annotated[dict[str, int], described("The run that stands for each system.")]
    left_out: Annotated[dict[str, str], described("Systems that took no part, and why.")]
    fewest: Annotated[int, described("Number of systems that is needed.")]
    why_not: Annotated[str, described("Reason why nothing could be judged; empty if it could.")]
    judged_share: Annotated[float, described("Share of the ground truth's time with enough systems.")]
    start_s: Annotated[float, described("First timestamp of the ground truth.", unit="s")]
    stretches: Annotated[tuple[ContradictionDocument, ...], described("In order of time.")]
    constants: Annotated[tuple[ConstantOffsetDocument, ...], described("Constants that the systems agree on.")]
    leave_out_s: Annotated[tuple[float, ...], described("The stretches as a protocol leaves them out.", unit="s")]
    times_s: Annotated[tuple[float, ...], described("Times of the residuals since start_s.", unit="s")]
    residuals_m: Annotated[
        dict[str, tuple[float | None, ...]],
        described("Distance of each system from the ground truth, aligned over 6 s; null: not known.", unit="m"),
    ]
    common_m: Annotated[tuple[float | None, ...], described("The same of what they have in common.", unit="m")]

    @property
    def against_truth(self) -> int:
        """The number of stretches that speak against the ground truth."""
        return sum(entry.blame is domain.Blame.TRUTH for entry in self.stretches)


# Public sequences and the addresses of their files as JSON.


class NeedDocument(Document):
    """Terms to accept or access to ask for before a download."""

    kind: NeedKind
    text: Annotated[str, described("What to do.")]
    address: Annotated[str, described("Where; empty if it does not matter.")]
    variable: Annotated[str, described("The environment variable that holds the token; empty for other kinds.")]


class PublicSequence(Document):
    """A recording of a public collection, which `slamhive dataset fetch` makes a dataset of."""

    name: Annotated[str, described("What to fetch: COLLECTION/SEQUENCE.")]
    title: str
    homepage: str
    importer: Annotated[str, described("The format of its files.")]
    licence: Annotated[str, described("As its publisher states it; empty if nothing is stated.")]
    citation: str
    attributes: tuple[str, ...]
    setups: Annotated[tuple[SensorSetup, ...], described("The sensor set-ups that it can serve.")]
    groundtruth: Annotated[bool, described("The files contain ground truth.")]
    download_bytes: Annotated[int | None, described("Of the default source; null if unknown.", unit="bytes")]
    exact: Annotated[bool, described("The size is exact, not rounded.")]
    shared: Annotated[bool, described("Its files hold other sequences too.")]
    sources: tuple[str, ...]
    needs: tuple[NeedDocument, ...]
    unverified: Annotated[bool, described("Nobody has tried the addresses since they were written down.")]


class LinkReportDocument(Document):
    """Answer of an address in the catalogue."""

    address: str
    problem: Annotated[str | None, described("Why it gives no file; null if it does.")]
    size_bytes: Annotated[int | None, described("What it offers.", unit="bytes")]
    ranges: Annotated[bool | None, described("Downloads can be continued.")]
    duration_s: Annotated[float, described("Until it answered.", unit="s")]


def public_sequence(collection: Collection, sequence: Sequence) -> PublicSequence:
    """A sequence of a collection as JSON shows it."""
    files = {part.file.name: part.file for part in sequence.parts}.values()
    sizes = [file.estimate_bytes for file in files]
    known = bool(sizes) and None not in sizes
    return PublicSequence(
        name=sequence.full_name,
        title=collection.title,
        homepage=collection.homepage,
        importer=collection.importer,
        licence=collection.licence,
        citation=collection.citation,
        attributes=sequence.attributes,
        setups=sequence.setups,
        groundtruth=sequence.groundtruth,
        download_bytes=sum(size for size in sizes if size is not None) if known else None,
        exact=known and all(file.size_bytes is not None for file in files),
        shared=any(collection.sharing(file) > 1 for file in files),
        sources=tuple(sequence.sources),
        needs=tuple(NeedDocument.of(need) for need in collection.needs),
        unverified=collection.unverified,
    )


# Plug-ins as JSON.


class PlugIn(Document):
    """Implementation that fills one seam."""

    seam: str
    name: str
    package: Annotated[str, described("The Python package that it comes from.")]
    version: str
    entry_point: Annotated[str | None, BeforeValidator(lambda text: text or None)]
    state: Annotated[str, described("loaded or broken.")]
    problem: Annotated[str | None, described("Why it cannot be used.")]
    remedy: Annotated[str | None, described("What to do about it.")]


# What a search over everything found, as JSON.


class FoundThing(Document):
    """Something with a name that holds the words."""

    kind: FoundKind
    key: Annotated[str, described("Its number, name or token; for runs, the filter that lists them.")]
    name: str
    words: Annotated[str, described("What is known of it; empty for nothing.")]
