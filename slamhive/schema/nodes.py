"""The machines that execute runs, as JSON."""

from __future__ import annotations

from typing import Annotated

from slamhive.schema.fields import described
from slamhive.schema.model import Document

CpuModel = Annotated[str | None, described("Processor; null if unknown.")]


class NodeRun(Document):
    """A run that a worker has claimed."""

    id: int
    algorithm: str
    dataset: str
    state: str
    node: Annotated[str | None, described("Null while it is not known where it runs.")]
    left_s: Annotated[float | None, described("By earlier runs of its configuration; null without.", unit="s")] = None


class CacheUse(Document):
    """What data of runs takes on a node, as of the last run there."""

    used_bytes: Annotated[int, described("What it takes.", unit="bytes")]
    limit_bytes: Annotated[int, described("The most that it may take.", unit="bytes")]


class Node(Document):
    """One machine."""

    name: str
    state: Annotated[str, described("In the words of the engine.")]
    takes_runs: Annotated[bool, described("A run could start there now or soon.")]
    drained: Annotated[bool, described("Somebody keeps further runs away.")]
    cpu_count: Annotated[int | None, described("Logical cores that runs can have; null if unknown.")]
    memory_bytes: Annotated[int | None, described("Memory that runs can have; null if unknown.", unit="bytes")]
    cpu_model: CpuModel
    runs: Annotated[tuple[NodeRun, ...], described("The runs of this installation there.")]
    runs_per_hour: Annotated[float, described("Runs that ended there in the last 24 hours, by time.", unit="1/h")] = 0.0
    left_s: Annotated[
        float | None, described("Until its runs in progress should be over; null if not known.", unit="s")
    ] = None
    cache: Annotated[CacheUse | None, described("Null if it keeps no data of runs, or no run was there.")] = None


class Engine(Document):
    """The nodes of one executor."""

    executor: str
    problem: Annotated[str | None, described("Why the nodes are not known.")]
    drains: Annotated[bool, described("Nodes can be drained.")]
    nodes: tuple[Node, ...]
    elsewhere: Annotated[tuple[NodeRun, ...], described("Active runs on none of the nodes.")]


class Machine(Document):
    """What machines with the same processor measured lately."""

    cpu_model: str
    cpu_count: int
    hours: Annotated[float, described("How far back runs are counted.", unit="h")]
    runs: Annotated[int, described("Runs that succeeded or failed.")]
    runs_per_hour: Annotated[float, described("The same by time.", unit="1/h")]
    disturbed_fraction: Annotated[float | None, described("Of the runs that were judged; null if none was.")]


class Overview(Document):
    """The machines that execute runs, and what they do."""

    engines: tuple[Engine, ...]
    machines: tuple[Machine, ...]
    queued: Annotated[int, described("Runs that wait.")]
    left_s: Annotated[float, described("Time left of all active experiments, one after the other.", unit="s")]
    low_s: Annotated[float | None, described("The sum of the lower ends; null if nothing was measured.", unit="s")]
    high_s: Annotated[float | None, described("The sum of the upper ends; null if nothing was measured.", unit="s")]
    asks_engines: Annotated[bool, described("False on a view-only server, which asks no engine.")]
