"""The rows of an archive as JSON lines: what the run folders do not say. The ledger uses some of them too."""

from __future__ import annotations

from typing import Annotated, Any, Self

from pydantic import AfterValidator, AliasChoices, BeforeValidator, Field, FiniteFloat, model_validator
from pydantic import StrictBool as Flag
from pydantic import StrictInt as Whole

from slamhive.domain.configuration import Configuration
from slamhive.domain.names import check_name
from slamhive.domain.parameters import Parameter
from slamhive.domain.visibility import Visibility
from slamhive.schema.fields import described
from slamhive.schema.list_look import Pinned
from slamhive.schema.model import Document
from slamhive.schema.protocol import StatedProtocol
from slamhive.schema.record import ConfigurationContent
from slamhive.schema.types import ContentHash, Definitions, Moment, RowNumber, Uid, Values, cut, defined


def _named(kind: str) -> Any:
    return AfterValidator(lambda name: check_name(kind, name))


KIND = "slamhive-archive"


class Manifest(Document):
    """How an archive describes itself."""

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
        """What exactly is run."""
        return self.request.configuration

    @property
    def definitions(self) -> tuple[Parameter, ...]:
        """How the parameters are defined."""
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


class CellLine(Document):
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
