"""Requests to the web API, one model for each kind of body. Runs have :class:`Submission`."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict

from slamhive.documents.model import described
from slamhive.documents.run import Colours, Pinned, Sparks
from slamhive.documents.submission import MAX_REPEATS, Submission
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import PlaybackMode, Variant
from slamhive.domain.parameters import Value
from slamhive.domain.run import LONGEST_NOTE, LONGEST_TAG, MOST_TAGS

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
Group = Annotated[str | None, described("A group to add the configuration to.", max_length=200)]


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
    group: Group = None


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
    group: Group = None


class GroupRequest(ApiRequest):
    """A group to add a configuration to, or to remove it from."""

    group: Annotated[str, described("Its name.", max_length=200)]
    remove: bool = False
