"""What is known of nodes, for command line, page and JSON."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from slamhive.domain.remaining import Remaining
from slamhive.executors.nodes import CacheUse, Node
from slamhive.store.durations import MachineRuns


@dataclass(frozen=True, slots=True)
class NodeRun:
    """A run that a worker has claimed. ``node`` is None while it is not known where it runs.

    ``left_s``: how long it needs by earlier runs of its configuration; None if it has not started, or there are none.
    """

    id: int
    algorithm: str
    dataset: str
    state: str
    executor: str
    node: str | None
    cpu_model: str | None
    left_s: float | None = None


@dataclass(frozen=True, slots=True)
class NodeView:
    """A node with the runs of this installation on it; for the rest see :class:`slamhive.executors.nodes.Node`.

    ``runs_per_hour`` are runs that ended there lately. ``left_s``: until its runs in progress should be over, None if
    that is not known of any.
    """

    name: str
    state: str
    takes_runs: bool
    drained: bool
    cpu_count: int | None
    memory_bytes: int | None
    cpu_model: str | None
    runs: tuple[NodeRun, ...]
    runs_per_hour: float = 0.0
    left_s: float | None = None
    cache: CacheUse | None = None

    @classmethod
    def of(cls, node: Node, runs: Iterable[NodeRun], runs_per_hour: float) -> NodeView:
        """The CPU model is that of the engine, else what a run on the node has recorded."""
        runs = tuple(runs)
        return cls(
            name=node.name,
            state=node.state,
            takes_runs=node.takes_runs,
            drained=node.drained,
            cpu_count=node.cpu_count,
            memory_bytes=node.memory_bytes,
            cpu_model=node.cpu_model or next((run.cpu_model for run in runs if run.cpu_model), None),
            runs=runs,
            runs_per_hour=runs_per_hour,
            left_s=max((run.left_s for run in runs if run.left_s is not None), default=None),
            cache=node.cache,
        )


@dataclass(frozen=True, slots=True)
class Engine:
    """The nodes of one executor; ``problem`` says why they are not known. ``drains``: nodes can be taken out of use.

    ``elsewhere`` are active runs that are on none of the nodes, or of which the node is not known yet.
    """

    executor: str
    nodes: tuple[NodeView, ...]
    elsewhere: tuple[NodeRun, ...] = ()
    drains: bool = False
    problem: str | None = None


@dataclass(frozen=True, slots=True)
class Machine:
    """What machines with the same processor measured in the last ``hours``: runs that ended.

    ``disturbed_fraction`` is that of the runs that know whether they were disturbed, None if there is none.
    """

    cpu_model: str
    cpu_count: int
    hours: float
    runs: int
    runs_per_hour: float
    disturbed_fraction: float | None

    @classmethod
    def of(cls, found: MachineRuns, hours: float) -> Machine:
        """The rates of what the database counts."""
        return cls(
            cpu_model=found.cpu_model,
            cpu_count=found.cpu_count,
            hours=hours,
            runs=found.runs,
            runs_per_hour=found.runs / hours,
            disturbed_fraction=found.disturbed / found.judged if found.judged else None,
        )


@dataclass(frozen=True, slots=True)
class Overview:
    """All of it. ``left`` is the time left of all active experiments, one after the other; ``queued`` counts runs.

    Without ``asks_engines``, only the database was asked.
    """

    engines: tuple[Engine, ...]
    machines: tuple[Machine, ...]
    queued: int
    left: Remaining
    asks_engines: bool = True

    @property
    def left_s(self) -> float:
        """The expected time left."""
        return self.left.seconds

    @property
    def low_s(self) -> float | None:
        """The sum of the lower ends of their intervals; None if nothing was measured."""
        return self.left.low_s

    @property
    def high_s(self) -> float | None:
        """The sum of the upper ends of their intervals; None if nothing was measured."""
        return self.left.high_s
