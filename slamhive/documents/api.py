"""Requests and answers of the web API alone. Runs are asked for with :class:`Submission`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import AliasChoices, AliasPath, BaseModel, ConfigDict, Field

from slamhive.base.settings import Mode
from slamhive.documents import catalogue
from slamhive.documents.catalogue import CachedVariant, FoundThing, PublicSequence
from slamhive.documents.experiment import (
    CellDocument,
    ExperimentAnswerDocument,
    GridDocument,
    StoredAnalysis,
)
from slamhive.documents.model import Document, Moment, described
from slamhive.documents.plain import ExperimentStatusDocument
from slamhive.documents.run import Colours, Pinned, RunDocument, Sparks
from slamhive.documents.submission import MAX_REPEATS, Submission
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import PlaybackMode, Variant
from slamhive.domain.metrics import Direction, Group
from slamhive.domain.parameters import Value
from slamhive.domain.run import LONGEST_NOTE, LONGEST_TAG, MOST_TAGS, RunState

LARGEST_RUN_ID = 2**53 - 1
"""What JSON and every database can store."""
MOST_RUNS = 1000
"""Runs that one request may name."""
LONGEST_YAML = 200_000
"""Characters. Longer YAML would take too long to parse within a request."""

RunId = Annotated[int, described("Number of a run.", ge=1, le=LARGEST_RUN_ID)]
RunIds = Annotated[tuple[RunId, ...], described("Numbers of runs.", min_length=1, max_length=MOST_RUNS)]
Tag = Annotated[str, described("A tag.", min_length=1, max_length=LONGEST_TAG)]
Tags = Annotated[tuple[Tag, ...], described("Tags.", max_length=MOST_TAGS)]
Yaml = Annotated[str, described("The text of the file.", max_length=LONGEST_YAML)]
Name = Annotated[str | None, described("Null keeps the name, an empty text removes it.", max_length=200)]
Note = Annotated[str | None, described("Null keeps the note, an empty text removes it.", max_length=LONGEST_NOTE)]
GroupName = Annotated[str | None, described("A group to add the configuration to.", max_length=200)]


class ApiRequest(BaseModel):
    """The body of a request. Types are strict, and unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, defer_build=True)


class RunSelection(ApiRequest):
    """Some runs."""

    runs: RunIds


class TagsRequest(ApiRequest):
    """Tags to give some runs, and to take from them."""

    runs: RunIds
    add: Tags = ()
    remove: Tags = ()


class FoundRuns(ApiRequest):
    """All runs that a filter finds, of which there are as many as the caller expects."""

    where: Annotated[str, described("The filter; empty for all runs.", max_length=64_000)]
    count: Annotated[int, described("How many runs it finds. Nothing is changed if there are more or fewer.", ge=0)]


class FoundEvaluation(FoundRuns):
    """Request to evaluate the runs that a filter finds."""

    protocol: Annotated[str | None, described("Name or fingerprint of a protocol; null: that of each run.")] = None


class FoundTags(FoundRuns):
    """Tags to give what a filter finds, and to take from it."""

    add: Tags = ()
    remove: Tags = ()


class VisibilityRequest(ApiRequest):
    """New visibility of one thing."""

    visibility: Visibility


class SharingRequest(VisibilityRequest):
    """New visibility of some runs."""

    runs: RunIds


class FoundSharing(VisibilityRequest, FoundRuns):
    """New visibility of what a filter finds."""


class DeletionRequest(ApiRequest):
    """Runs that one action deleted."""

    deleted_at: Annotated[str, described("The time in its answer.", max_length=40)]


class NotesRequest(ApiRequest):
    """The note and the tags of one run; null keeps them."""

    note: Annotated[str | None, described("The new note; an empty text removes it.", max_length=LONGEST_NOTE)] = None
    tags: Annotated[tuple[Tag, ...] | None, described("All tags from now on.", max_length=MOST_TAGS)] = None


class EvaluationRequest(ApiRequest):
    """Runs to evaluate, and how."""

    runs: Annotated[
        tuple[RunId, ...] | None, described("Numbers of runs; null: all successful ones that are not evaluated.")
    ] = None
    protocol: Annotated[str | None, described("Name or fingerprint of a protocol; null: by sensors.")] = None
    alignment: Annotated[str | None, described("The default protocol with this alignment.")] = None


class ShownProtocolRequest(ApiRequest):
    """The protocol whose metrics lists show."""

    protocol: Annotated[str, described("Fingerprint of a protocol that the run is evaluated under.")]


class NodeRequest(ApiRequest):
    """A machine that executes runs."""

    executor: Annotated[str, described("Whose node it is.")]
    node: Annotated[str, described("Its name.", max_length=253)]


class SearchRequest(ApiRequest):
    """A search to save."""

    name: Annotated[str, described("Replaces a search of this name.", max_length=200)]
    where: Annotated[str, described("The filter; empty for all runs.", max_length=64_000)] = ""
    columns: Annotated[tuple[str, ...], described("Keys of columns, metrics and parameters.", max_length=200)] = ()
    sort: Annotated[str, described("A column, metric or parameter.")] = "id"
    descending: bool = True
    group: Annotated[bool, described("One row for each configuration.")] = False
    pinned: Pinned = 0
    colours: Colours = False
    sparks: Sparks = False


class ExperimentRequest(ApiRequest):
    """An experiment to start."""

    yaml: Yaml
    executor: Annotated[str | None, described("Overrides the one in the file.")] = None
    visibility: Annotated[
        Visibility | None, described("Who may see it and its runs from the beginning; by default as NEW_RUNS says.")
    ] = None


class YamlRequest(ApiRequest):
    """A file to preview or to check."""

    yaml: Yaml


class RepeatsRequest(ApiRequest):
    """Repeats to add to an experiment."""

    count: Annotated[int, described("For each configuration and seed.", ge=1, le=MAX_REPEATS)]


class AnalysisRequest(ApiRequest):
    """An analysis to compute."""

    yaml: Yaml
    listed: Annotated[bool, described("Shown in the list of analyses.")] = True


class ListingRequest(ApiRequest):
    """Request to show or hide an analysis in the list."""

    listed: bool


class VariantRequest(ApiRequest):
    """A variant of a dataset to make."""

    steps: Annotated[Variant, described("Pre-processing steps, in order.", min_length=1, max_length=100)]


class LabelRequest(ApiRequest):
    """Name and note of a configuration."""

    name: Name = None
    note: Note = None


class ConfigurationRequest(LabelRequest):
    """A configuration to store: what a run would execute."""

    submission: Annotated[Submission, described("Only what belongs to the content is stored, not seed or repeat.")]
    group: GroupName = None


class ConfigurationChanges(LabelRequest):
    """The differences of a changed configuration; null keeps what is."""

    algorithm: Annotated[str | None, described("Another algorithm; values are matched by name.")] = None
    dataset: Annotated[str | None, described("Another dataset.")] = None
    parameters: Annotated[dict[str, Value] | None, described("Values that differ; the others stay.")] = None
    variant: Annotated[Variant | None, described("All pre-processing steps from now on.")] = None
    sensors: Annotated[dict[str, str] | None, described("All chosen sensors from now on, by role.")] = None
    playback_mode: PlaybackMode | None = None
    playback_rate: Annotated[float | None, described("Playback speed.", ge=0.01, le=100)] = None
    map: Annotated[str | None, described("Number or uid of the run whose map the algorithm starts with.")] = None


class ConfigurationYaml(LabelRequest):
    """A configuration to store, as YAML of this or of the published SLAM Hive."""

    yaml: Yaml
    group: GroupName = None


class GroupRequest(ApiRequest):
    """A group to add a configuration to, or to remove it from."""

    group: Annotated[str, described("Its name.", max_length=200)]
    remove: bool = False


# Answers of the web API alone: pages of lists, files of a run, and what a server can do.


Next = Annotated[str | None, described("Address of the next page; null on the last one.")]
Total = Annotated[int, described("How many there are on all pages.")]


class OldError(Document):
    """An error as programs know it that were written before there were problem details."""

    status: int
    message: str
    remedy: str | None


class ProblemDocument(Document):
    """Problem details (RFC 9457)."""

    type: str = "about:blank"
    title: Annotated[str, described("The words for the status.")]
    status: int
    detail: Annotated[str, described("What is wrong, in one line that names the value.")]
    remedy: Annotated[str | None, described("What to do about it.")]
    error: Annotated[OldError, Field(description="The same in another form.", deprecated=True)]


class Server(Document):
    """Identity and abilities of a server."""

    software: Annotated[str, described("Version of SLAM Hive.")]
    mode: Mode
    changes: Annotated[bool, described("Whether it changes anything.")]
    worker: Annotated[bool, described("Whether a worker executes runs on its machine.")]


class RunsDocument(Document):
    """Some runs."""

    runs: tuple[RunDocument, ...]

    @property
    def content(self) -> dict[str, Any]:
        """The document as JSON; each run writes itself, which is faster."""
        return {**self.model_dump(mode="json", exclude={"runs"}), "runs": [run.content for run in self.runs]}


class RunPage(RunsDocument):
    """A page of a list of runs."""

    total: Total
    next: Next


class RunNumbers(Document):
    """Numbers of runs."""

    runs: tuple[int, ...]


class DownloadDocument(Document):
    """One file of a run."""

    key: Annotated[str, described("Its name in addresses.")]
    name: Annotated[str, described("Its name in the run folder.")]
    media_type: str
    size_bytes: Annotated[int, described("Its size.", unit="bytes")]
    address: str


class RunFilesDocument(Document):
    """The files of a run that can be downloaded."""

    files: tuple[DownloadDocument, ...]


class ProgressDocument(Document):
    """Progress of a run. Unknown values are null, as they are for runs that wait or have ended."""

    state: RunState
    text: Annotated[str, described("What it does, in words.")]
    fraction: Annotated[float | None, described("Part of the recording that was played, from 0 to 1.")] = None
    elapsed_s: Annotated[float | None, described("Time since its start.", unit="s")] = None
    left_s: Annotated[float | None, described("Estimated time left.", unit="s")] = None
    cpu_cores: Annotated[float | None, described("CPU use now.", unit="cores")] = None
    memory_bytes: Annotated[int | None, described("Memory use now.", unit="bytes")] = None


class DeletedRunDocument(Document):
    """A run in the trash."""

    id: int = Field(validation_alias=AliasChoices(AliasPath("deleted", "run_id"), "id"))
    algorithm: str
    dataset: str
    deleted_at: Moment = Field(validation_alias=AliasChoices(AliasPath("deleted", "at"), "deleted_at"))


class TrashedRuns(Document):
    """The runs in the trash."""

    runs: tuple[DeletedRunDocument, ...]


class Removed(Document):
    """Number of runs removed for good."""

    removed: int


class Queued(Document):
    """Amount of work queued."""

    queued: int


class ActedOn(Document):
    """Changes made by an action on all runs of a search."""

    done: Annotated[int, described("Runs that were changed.")]
    left_out: Annotated[int, described("Runs that the action does not fit.")]
    reasons: Annotated[tuple[str, ...], described("Why runs were left out, each reason once.")] = Field(
        validation_alias=AliasChoices("words", "reasons")
    )
    deleted_at: Annotated[str | None, described("Restores what was deleted together; null after other actions.")] = (
        Field(validation_alias=AliasChoices("deleted_at_text", "deleted_at"))
    )


class SavedSearchDocument(Document):
    """A search under a name."""

    name: str
    where: Annotated[str, described("The filter; empty for all runs.")] = Field(
        validation_alias=AliasChoices("filter_text", "where")
    )
    columns: tuple[str, ...]
    sort: str = Field(validation_alias=AliasChoices(AliasPath("sort", "key"), "sort"))
    descending: bool = Field(validation_alias=AliasChoices(AliasPath("sort", "descending"), "descending"))
    group: Annotated[bool, described("One row for each configuration.")] = Field(
        validation_alias=AliasChoices("grouped", "group")
    )
    pinned: Pinned
    colours: Colours
    sparks: Sparks


class SavedSearches(Document):
    """All saved searches, sorted by name."""

    searches: tuple[SavedSearchDocument, ...]


class FilterField(Document):
    """A name that a filter may use."""

    name: str
    label: str
    unit: str
    values: Annotated[tuple[str, ...], described("Values to choose from; empty if there is no list.")]


class FilterFields(Document):
    """All names that a filter may use."""

    fields: tuple[FilterField, ...]


class Algorithms(Document):
    """All algorithms."""

    algorithms: tuple[catalogue.AlgorithmDocument, ...]


class PackageVersions(Document):
    """The versions of a package, the newest first."""

    versions: tuple[catalogue.Version, ...]


class Datasets(Document):
    """All datasets."""

    datasets: tuple[catalogue.DatasetDocument, ...]


class FoundThings(Document):
    """Results of a search over everything."""

    found: Annotated[tuple[FoundThing, ...], described("The best 8 of each kind.")]


class PublicDatasets(Document):
    """Public sequences that can be fetched."""

    sequences: tuple[PublicSequence, ...]


class BackgroundWork(Document):
    """Long work on a dataset that goes on, or that failed."""

    dataset: str
    details: Annotated[tuple[str, ...], described("The steps of a variant.")]
    fraction: Annotated[float, described("How much is done, from 0 to 1.")]
    done: bool
    problem: Annotated[str | None, described("Why it failed.")]


class DatasetWork(Document):
    """Current work on a dataset; null if there is none."""

    check: BackgroundWork | None
    variant: BackgroundWork | None
    trial: BackgroundWork | None = None


class VariantsDocument(Document):
    """The variants of a dataset in the cache, the last used first."""

    variants: tuple[CachedVariant, ...]


class ConfigurationPageDocument(Document):
    """A page of configurations."""

    configurations: tuple[catalogue.ConfigurationDocument, ...]
    total: Total
    next: Next


class StoredConfiguration(catalogue.ConfigurationDocument):
    """A configuration that a request stored or found."""

    created: Annotated[bool, described("False if an identical one existed.")]
    notes: Annotated[tuple[str, ...], described("What was not taken over, a line each.")]


class Removal(Document):
    """Things that were removed."""

    removed: Annotated[str, described("Its number, name or address.")]


class ExperimentsDocument(Document):
    """All experiments, the newest first."""

    experiments: tuple[ExperimentStatusDocument, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentWithFile(ExperimentStatusDocument):
    """An experiment with its file, its axes and its answer."""

    yaml: Annotated[str, described("The experiment file.")]
    axes: Annotated[dict[str, tuple[Any, ...]], described("The values of each axis.")]
    answer: ExperimentAnswerDocument


class CellPageDocument(Document):
    """A page of the configurations of an experiment."""

    cells: tuple[CellDocument, ...]
    total: Total
    next: Next


class GridAnswer(Document):
    """Progress over two axes; null for an experiment without axes."""

    grid: GridDocument | None


class AnalysisDocument(StoredAnalysis):
    """A stored analysis."""

    token: Annotated[str, described("Its permanent address ends with it.")]


class AnalysesDocument(Document):
    """The listed analyses, the newest first."""

    analyses: tuple[AnalysisDocument, ...]


class AnalysisWithFile(AnalysisDocument):
    """A stored analysis with its text, its progress and its files."""

    yaml: Annotated[str, described("The analysis file.")]
    fraction: Annotated[float, described("How much is computed, from 0 to 1.")]
    doing: Annotated[str, described("What is computed now; empty if nothing.")]
    files: Annotated[tuple[str, ...], described("Names of files that can be downloaded.")]


class CheckedFileDocument(Document):
    """A file without mistakes."""

    name: Annotated[str, described("The name in the file.")]


class MetricDocument(Document):
    """A metric of the catalogue."""

    key: Annotated[str, described("Its name in files, filters and commands.")]
    label: str
    unit: Annotated[str, described("Of the stored value; empty for a pure number.")]
    direction: Annotated[Direction, described("Which values are better.")]
    definition: str
    needs_protocol: Annotated[bool, described("It comes from an evaluation; others are measured during the run.")]
    group: Group
    source: Annotated[str, described("The paper, program or device that defines it.")]


class Metrics(Document):
    """The metric catalogue, in the order of pages."""

    metrics: tuple[MetricDocument, ...]


class ProtocolMetrics(Document):
    """The metrics of a run under each protocol that it was evaluated under."""

    protocols: Annotated[dict[str, dict[str, float]], described("By fingerprint of the protocol and key.")]
