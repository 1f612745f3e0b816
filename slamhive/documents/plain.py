"""Documents that plain commands print, as dataclasses: loading pydantic takes longer than such a command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, Self

from slamhive.documents.limits import Asked
from slamhive.domain.accounts import Visibility
from slamhive.domain.names import plural
from slamhive.domain.placement import Remaining
from slamhive.domain.question import ExperimentQuestion
from slamhive.domain.run import FailureReason
from slamhive.domain.verdict import DEFAULT_RULE, Failure, Outcome

if TYPE_CHECKING:
    from pydantic import GetCoreSchemaHandler


class PlainDocument:
    """A JSON document that is a dataclass. Only writing and reading its JSON loads pydantic."""

    __slots__ = ()

    @classmethod
    def read(cls, content: Any) -> Self:
        """The document that :attr:`content` wrote; raises InvalidInput naming the key that does not fit."""
        from slamhive.documents.model import load  # noqa: PLC0415 - loads pydantic

        return load(cls, content)

    @property
    def content(self) -> dict[str, Any]:
        """The document as JSON."""
        from slamhive.documents.model import dump  # noqa: PLC0415 - loads pydantic

        found: dict[str, Any] = dump(type(self), self)
        return found


@dataclass(frozen=True, slots=True)
class ShownAs:
    """The type that the JSON Schema gives to a field, for ``Annotated``: it names no choices, which may become more."""

    kind: Any
    title: str

    def __get_pydantic_json_schema__(self, schema: Any, handler: Any) -> dict[str, Any]:
        """The schema of that type, with the description of the field."""
        from slamhive.documents.model import adapter  # noqa: PLC0415 - loads pydantic

        said = {key: text for key, text in handler(schema).items() if key == "description"}
        return {**adapter(self.kind).json_schema(), **said, "title": self.title}


class ToTheMillisecond:
    """A time as it is shown, for ``Annotated``."""

    def __get_pydantic_core_schema__(self, kind: Any, handler: GetCoreSchemaHandler) -> Any:
        """The schema of ``Timestamp``."""
        from slamhive.documents.model import Timestamp  # noqa: PLC0415 - loads pydantic

        return handler.generate_schema(Timestamp)


# The machines that execute runs, and what they do.


CpuModel = Annotated[str | None, Asked("Processor; null if unknown.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeRunDocument:
    """A run that a worker has claimed."""

    id: int
    algorithm: str
    dataset: str
    state: str
    node: Annotated[str | None, Asked("Null while it is not known where it runs.")]
    left_s: Annotated[float | None, Asked("By earlier runs of its configuration; null without.", unit="s")] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class CacheUseDocument:
    """Space that data of runs takes on a node, as of the last run there."""

    used_bytes: Annotated[int, Asked("What it takes.", unit="bytes")]
    limit_bytes: Annotated[int, Asked("The most that it may take.", unit="bytes")]


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeDocument:
    """One machine."""

    name: str
    state: Annotated[str, Asked("In the words of the engine.")]
    takes_runs: Annotated[bool, Asked("A run could start there now or soon.")]
    drained: Annotated[bool, Asked("Somebody keeps further runs away.")]
    cpu_count: Annotated[int | None, Asked("Logical cores that runs can have; null if unknown.")]
    memory_bytes: Annotated[int | None, Asked("Memory that runs can have; null if unknown.", unit="bytes")]
    cpu_model: CpuModel
    runs: Annotated[tuple[NodeRunDocument, ...], Asked("The runs of this installation there.")]
    runs_per_hour: Annotated[float, Asked("Runs that ended there in the last 24 hours, by time.", unit="1/h")] = 0.0
    left_s: Annotated[
        float | None, Asked("Until its runs in progress should be over; null if not known.", unit="s")
    ] = None
    cache: Annotated[CacheUseDocument | None, Asked("Null if it keeps no data of runs, or no run was there.")] = None


@dataclass(frozen=True, slots=True, kw_only=True)
class EngineDocument:
    """The nodes of one executor."""

    executor: str
    problem: Annotated[str | None, Asked("Why the nodes are not known.")]
    drains: Annotated[bool, Asked("Nodes can be drained.")]
    nodes: tuple[NodeDocument, ...]
    elsewhere: Annotated[tuple[NodeRunDocument, ...], Asked("Active runs on none of the nodes.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineDocument:
    """Recent measurements of machines with the same processor."""

    cpu_model: str
    cpu_count: int
    hours: Annotated[float, Asked("How far back runs are counted.", unit="h")]
    runs: Annotated[int, Asked("Runs that succeeded or failed.")]
    runs_per_hour: Annotated[float, Asked("The same by time.", unit="1/h")]
    disturbed_fraction: Annotated[float | None, Asked("Of the runs that were judged; null if none was.")]


@dataclass(frozen=True, slots=True, kw_only=True)
class OverviewDocument(PlainDocument):
    """The machines that execute runs, and what they do."""

    engines: tuple[EngineDocument, ...]
    machines: tuple[MachineDocument, ...]
    queued: Annotated[int, Asked("Runs that wait.")]
    left_s: Annotated[float, Asked("Time left of all active experiments, one after the other.", unit="s")]
    low_s: Annotated[float | None, Asked("The sum of the lower ends; null if nothing was measured.", unit="s")]
    high_s: Annotated[float | None, Asked("The sum of the upper ends; null if nothing was measured.", unit="s")]
    asks_engines: Annotated[bool, Asked("False on a view-only server, which asks no engine.")]

    @property
    def left(self) -> Remaining:
        """The time left with its interval."""
        return Remaining(self.left_s, self.low_s, self.high_s)


# What an experiment needs and how far it is; lists and starts of experiments load no pydantic either.


@dataclass(frozen=True, slots=True, kw_only=True)
class ToFetchDocument:
    """Sequences of the catalogue that an experiment needs and that are not here."""

    datasets: tuple[str, ...]
    sequences: Annotated[tuple[str, ...], Asked("What to fetch: COLLECTION/SEQUENCE.")]
    download_bytes: Annotated[int | None, Asked("Of all files with a known size, each once.", unit="bytes")]
    unknown: Annotated[int, Asked("Files of unknown size.")]
    command: Annotated[str, Asked("Fetches them.")]

    @property
    def words(self) -> str:
        """The amount in a sentence: ``5 datasets are not here yet, about 12.7 GB to download``."""
        verb = "is" if len(self.datasets) == 1 else "are"
        text = f"{plural(len(self.datasets), 'dataset')} {verb} not here yet"
        if self.download_bytes is not None:
            text += f", about {self.download_bytes / 1e9:,.1f} GB to download"
        if self.unknown:
            text += (
                f", {'and ' if self.download_bytes is not None else ''}{plural(self.unknown, 'file')} of unknown size"
            )
        return text


class ConfigurationStanding(StrEnum):
    """The state of an experiment. ``storing``: its start is under way or was interrupted."""

    STORING = "storing"
    ACTIVE = "active"
    PAUSED = "paused"
    CANCELLED = "cancelled"
    FINISHED = "finished"


@dataclass(frozen=True, slots=True, kw_only=True)
class ExperimentStatusDocument(PlainDocument):
    """The progress of an experiment."""

    number: Annotated[int, Asked("Its number in this installation.")]
    name: str
    description: str
    state: Annotated[ConfigurationStanding, ShownAs(str, "State")]
    executor: str
    priority: int
    repeats: int
    created_at: Annotated[datetime, ToTheMillisecond()]
    cells: int
    runs: int
    missing: Annotated[int, Asked("Runs that are not stored because the start was interrupted.")]
    counts: Annotated[Mapping[Outcome, int], Asked("Runs by state."), ShownAs(dict[str, int], "Counts")]
    retried: Annotated[int, Asked("Failed or disturbed runs that another run replaces; not in counts.")]
    failures: Annotated[Mapping[Failure, int], Asked("Failed runs by reason."), ShownAs(dict[str, int], "Failures")]
    disturbed: Annotated[int, Asked("Runs that were measured on a disturbed machine.")]
    failed_if: Annotated[str, Asked("When a run counts as failed.")] = DEFAULT_RULE.words
    left_s: Annotated[float | None, Asked("Expected time left; null if it was not asked for.", unit="s")]
    low_s: Annotated[float | None, Asked("It is longer in 19 of 20 cases; null if nothing was measured.", unit="s")]
    high_s: Annotated[float | None, Asked("It is shorter in 19 of 20 cases; null as low_s.", unit="s")]
    phase: Annotated[str, Asked("What happens now, such as a build; empty if nothing is left.")] = ""
    same_cpu: Annotated[bool, Asked("All runs are measured on one CPU model.")] = False
    cpu_model: Annotated[str | None, Asked("That CPU model; null while it is not known.")] = None
    owner: Annotated[str | None, Asked("The account that it belongs to; null for nobody.")] = None
    visibility: Annotated[Visibility, Asked("Who may see it and its runs, besides admins.")] = Visibility.TEAM
    question: Annotated[
        ExperimentQuestion | None, Asked("What it is asked, if it chooses its runs itself; null otherwise.")
    ] = None
    conclusion: Annotated[str | None, Asked("Its answer in one sentence; null while it chooses runs.")] = None

    @property
    def left(self) -> Remaining | None:
        """The time left with its interval; None if it was not asked for."""
        return None if self.left_s is None else Remaining(self.left_s, self.low_s, self.high_s)

    @property
    def ended(self) -> int:
        """The number of runs that have ended."""
        return sum(self.counts[outcome] for outcome in Outcome if outcome.ended)

    @property
    def ended_badly(self) -> int:
        """Failed runs that can be retried; a run that failed by its verdict would fail again."""
        return sum(count for failure, count in self.failures.items() if isinstance(failure, FailureReason))
