"""Documents that plain commands print, as dataclasses: loading pydantic takes longer than such a command."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Self

from slamhive.documents.limits import Asked
from slamhive.domain.names import plural
from slamhive.domain.placement import Remaining


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
