"""The rows of an archive as JSON lines: what the run folders do not say. The ledger uses some of them too."""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple, Self

from pydantic import AfterValidator, AliasChoices, BeforeValidator, Field, FiniteFloat, model_validator
from pydantic import StrictBool as Flag
from pydantic import StrictInt as Whole

from slamhive.documents.model import (
    ContentHash,
    Definitions,
    Document,
    Moment,
    RowNumber,
    Uid,
    Values,
    cut,
    defined,
    described,
)
from slamhive.documents.protocol import StatedProtocol
from slamhive.documents.record import ConfigurationContent, StoredOptions
from slamhive.documents.run import Pinned
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import Configuration, InputMap, Playback, PlaybackMode, Variant
from slamhive.domain.names import check_name
from slamhive.domain.parameters import Parameter
from slamhive.domain.question import ExperimentQuestion


def _named(kind: str) -> Any:
    return AfterValidator(lambda name: check_name(kind, name))


KIND = "slamhive-archive"


class ArchiveManifest(Document):
    """Description of an archive, stored inside it."""

    kind: str = KIND
    format: int = 2
    made_at: Annotated[str, described("Time of the export.")]
    software: Annotated[str, described("Version of SLAM Hive that made it.")]
    counts: Annotated[dict[str, int], described("Rows of each kind.")]
    without: Annotated[tuple[str, ...], described("Kinds of files that were left out on request.")] = ()
    left_out: Annotated[dict[str, int], described("Runs that were left out, by reason.")] = Field(default_factory=dict)
    files_left_out: Annotated[dict[str, int], described("Files that were left out, by reason.")] = Field(
        default_factory=dict
    )
    checksums: Annotated[str | None, described("SHA-256 of the list of checksums in the first format.")] = Field(
        default=None, exclude=True
    )


ExperimentName = Annotated[str, _named("experiment")]


class EvaluationLine(Document):
    """An evaluation that has ended."""

    protocol: StatedProtocol
    state: str
    reason: Annotated[str | None, cut(10_000)]
    artefacts: str
    engine: Annotated[str | None, cut(190)]
    created_at: Moment
    started_at: Moment | None
    ended_at: Moment | None
    attempt: RowNumber


class RunLine(Document):
    """A run."""

    id: Annotated[RowNumber, described("Number where it comes from; its folder is runs/ID.")]
    uid: Uid
    attempt: RowNumber
    retry_of: Annotated[Uid | None, described("The uid of the run that it repeats.")]
    experiment: Annotated[str | None, described("Name of its experiment.")]
    current_protocol: Annotated[str | None, described("Fingerprint of the protocol whose metrics are shown.")]
    record: Annotated[dict[str, Any] | None, described("Stands for the run.json of a run without a folder.")]
    evaluations: tuple[EvaluationLine, ...]
    visibility: Annotated[Visibility | None, described("Who may see it; null for everybody who is signed in.")] = None


class ConfigurationLine(Document):
    """A configuration with what users say about it."""

    id: Annotated[RowNumber, described("Number where it comes from.")]
    request: ConfigurationContent = Field(validation_alias=AliasChoices("request", "configuration"))
    created_at: Moment
    name: str | None
    note: str
    groups: tuple[str, ...]
    parameters: Definitions

    @model_validator(mode="after")
    def _check_values(self) -> Self:
        for key in self.parameters:
            if key not in self.request.parameters:
                raise ValueError(f"the parameter {key!r} has no value")
        return self

    @property
    def configuration(self) -> Configuration:
        """Return the exact inputs of the run."""
        return self.request.configuration

    @property
    def definitions(self) -> tuple[Parameter, ...]:
        """Definitions of the parameters."""
        return defined(self.parameters, self.request.parameters)


class ExperimentLine(Document):
    """An experiment."""

    uid: Uid
    name: ExperimentName
    description: str
    content_hash: ContentHash
    source: Annotated[str, described("The experiment file as it was given.")]
    state: str
    executor: str
    priority: Whole
    repeats: RowNumber
    cells: RowNumber
    runs: RowNumber
    complete: Annotated[Flag, described("All cells and runs are stored.")]
    created_at: Moment
    visibility: Annotated[Visibility | None, described("Who may see it; null for everybody who is signed in.")] = None
    question: Annotated[ExperimentQuestion | None, described("What it is asked, if it chooses its runs itself.")] = None
    conclusion: Annotated[str | None, described("Its answer in one sentence.")] = None


class ArchivedCell(Document):
    """A cell of an experiment."""

    experiment: ExperimentName
    number: RowNumber
    name: Annotated[str, cut(80)]
    configuration: Annotated[RowNumber, described("Number of the configuration.")] = Field(
        validation_alias=AliasChoices("configuration_id", "configuration")
    )
    values: Annotated[Values, described("Its value on each axis.")]


class DatasetLine(Document):
    """A dataset that runs are stored for."""

    name: Annotated[str, _named("dataset")]
    checksum: Annotated[str, cut(80)]
    duration_s: Annotated[FiniteFloat, described("Duration of the recording.", unit="s")]
    title: Annotated[str, cut(255)]
    sensors: tuple[dict[str, Any], ...]
    registered_at: Moment


class AlgorithmLine(Document):
    """An algorithm that runs are stored for."""

    name: Annotated[str, _named("algorithm")]
    package: str = Field(max_length=64)
    mode: str = Field(max_length=64)


class SearchLine(Document):
    """A saved search."""

    name: Annotated[str, _named("saved search")]
    filter: str = Field(validation_alias=AliasChoices("filter_text", "filter"))
    columns: tuple[str, ...]
    sort: Annotated[
        tuple[Annotated[str, cut(190)], bool],
        BeforeValidator(lambda raw: raw if isinstance(raw, list | tuple) else (raw.key, raw.descending)),
        described("Key, and whether the largest value comes first."),
    ]
    grouped: Flag
    pinned: Pinned = 0
    colours: Flag = False
    sparks: Flag = False
    created_at: Moment


class AnalysisLine(Document):
    """An analysis as it is stated; results are computed again."""

    token: Uid
    name: Annotated[str, cut(200)]
    created_at: Moment
    source: Annotated[str, described("The analysis file.")]
    visibility: Annotated[Visibility | None, described("Who may see it; null for everybody who is signed in.")] = None


# The lines of the ledger. Rows that were stored together share a line, and a row is a list without keys.


class LedgerConfigurationLine(NamedTuple):
    """A configuration with its number."""

    id: Whole
    algorithm: str
    dataset: str
    parameters: Values
    mode: PlaybackMode
    rate: FiniteFloat
    variant: Variant
    sensors: dict[str, str] = {}  # noqa: RUF012 - a field of a named tuple, which nobody changes
    version: Whole | None = None
    map: InputMap | None = None

    @property
    def configuration(self) -> Configuration:
        """Return the exact inputs of the run."""
        playback, steps = Playback(self.mode, self.rate), self.variant
        more = (self.sensors, self.version, self.map)
        return Configuration(self.algorithm, self.dataset, self.parameters, playback, steps, *more)


class ConfigurationsLine(Document):
    """Configurations that were stored together."""

    at: Moment
    parameters: Definitions
    configurations: tuple[LedgerConfigurationLine, ...] = ()


class LabelLine(Document):
    """Users' notes on a configuration."""

    label: Annotated[int, described("Number of the configuration.")]
    name: str | None
    note: str
    groups: tuple[str, ...]


class RunRow(NamedTuple):
    """Fields that distinguish a run from the others of its line."""

    id: Whole
    uid: Uid
    configuration_id: Whole
    seed: Whole
    cell: Whole | None
    retry_of: Whole | None


class SharedRequest(StoredOptions):
    """Fields that the runs of a line have in common. A new option has a default, so that older lines can be read."""

    executor: str
    evaluate: bool = False
    affinity: str = ""
    experiment: Annotated[str | None, described("The uid of their experiment.")]
    protocol: StatedProtocol | None
    owner: str | None = None
    visibility: Visibility | None = None


class RunsLine(Document):
    """Runs that were queued together."""

    at: Moment
    request: SharedRequest
    runs: tuple[RunRow, ...] = ()


class CellRow(NamedTuple):
    """A cell of an experiment with its value on each axis."""

    number: Whole
    name: str
    configuration_id: Whole
    values: Values


class CellsLine(Document):
    """Cells of one experiment."""

    experiment: Annotated[str, described("The uid of the experiment.")]
    cells: tuple[CellRow, ...] = ()


class CancelledLine(Document):
    """Runs that were cancelled while they waited."""

    cancelled: tuple[int, ...]
    at: Moment
    why: str


class SharedLine(Document):
    """Owner and readers of runs that have no folder yet; later lines and the folder of a run override it."""

    shared: tuple[int, ...]
    owner: Annotated[str | None, described("Null also for a run of an experiment, whose owner it has.")]
    visibility: Visibility | None


class AskedLine(Document):
    """Evaluations that were queued together."""

    at: Moment
    protocol: StatedProtocol
    artefacts: str
    asked: Annotated[tuple[int, ...], described("Numbers of the runs.")]
    makes_current: Annotated[bool, described("Whether lists show the metrics of this protocol from then on.")] = False


class EndedLine(Document):
    """An evaluation that has ended. The line of its request holds the protocol."""

    ended: Annotated[int, described("Number of the run.")]
    protocol: Annotated[str, described("Fingerprint.")]
    state: str
    reason: str | None
    artefacts: str
    engine: str | None
    times: Annotated[
        tuple[Moment, Moment | None, Moment | None], described("When it was requested, when it began, when it ended.")
    ]
    attempt: int


class VersionRow(Document):
    """A version without a number, as lines of algorithms held it before versions had numbers."""

    identity: str
    package_hash: str
    version: str
    created_at: Moment


class LedgerAlgorithmLine(Document):
    """An algorithm that runs are stored for."""

    algorithm: str = Field(validation_alias=AliasChoices("name", "algorithm"))
    package: str
    mode: str
    versions: tuple[VersionRow, ...] = ()


class VersionLine(VersionRow):
    """A version of a package."""

    versions_of: Annotated[str, described("The package.")] = Field(
        validation_alias=AliasChoices("package", "versions_of")
    )
    number: Annotated[int, described("Counts the versions of the package.")]
    removed_at: Annotated[Moment | None, described("When its image was removed on purpose.")] = None


LedgerLine = (
    LedgerAlgorithmLine
    | VersionLine
    | ConfigurationsLine
    | LabelLine
    | CellsLine
    | RunsLine
    | CancelledLine
    | SharedLine
    | AskedLine
    | EndedLine
)
"""Lines of all books of the ledger, apart from bare lists of numbers."""
