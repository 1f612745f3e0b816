"""The machines that an executor runs on, as its engine knows them."""

from __future__ import annotations

import platform
from dataclasses import dataclass

from slamhive.executors.host import describe_host


@dataclass(frozen=True, slots=True)
class CacheUse:
    """The room that data of runs takes on a node, as of the last run there, and the most that it may take."""

    used_bytes: int
    limit_bytes: int


@dataclass(frozen=True, slots=True)
class Node:
    """One machine.

    Attributes:
        name: What the engine calls it; unique in its cluster.
        state: In the engine's words.
        takes_runs: Whether a run could start there now or soon.
        drained: Somebody has asked that no further run starts there.
        cpu_count: Logical cores that runs can have together; None if unknown.
        memory_bytes: The same for memory.
        cpu_model: None if the engine does not know it.
        cache: None if it keeps no data of runs, or no run was there.
    """

    name: str
    state: str
    takes_runs: bool
    drained: bool
    cpu_count: int | None
    memory_bytes: int | None
    cpu_model: str | None = None
    cache: CacheUse | None = None


def this_machine() -> Node:
    """The machine of this process."""
    host = describe_host()
    return Node(platform.node(), "up", True, False, host.cpu_count, host.memory_bytes, host.cpu_model)
