"""The ways in which a supervisor can contain a run that has no container."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from slamhive.base.clock import monotonic_s
from slamhive.executors.process.priority import urgent
from slamhive.executors.process.table import ProcessEntry, descendants, living, read_process, tasks_on_machine
from slamhive.executors.status import UsageSource

_RESCAN_S = 0.5
WHOLE_CORES = "bound to whole cores"
"""Where the kernel does not limit CPU time: a part of a core cannot be held."""


class DoesNotHold(Exception):
    """This machine does not allow this way of containing a run; the text says why."""


@dataclass(frozen=True, slots=True)
class ContainmentRequest:
    """The run that a containment is made for, and its limits.

    Attributes:
        installation: Distinguishes the groups of this data root from those of another on the same machine.
        key: The run.
        tasks: Most processes and threads.
        memory_bytes: Most memory, None for no limit.
        cpu_cores: Most cores in use, None for no limit.
        readable: Paths that the run must be able to read as any user.
        writable: Folders that the run writes to.
        own_scope: Whether systemd made the unit of this process for it.
        no_scope: Why systemd made none, though one was asked for; empty if none was.
    """

    installation: str
    key: str
    tasks: int
    memory_bytes: int | None = None
    cpu_cores: float | None = None
    readable: tuple[Path, ...] = ()
    writable: tuple[Path, ...] = ()
    own_scope: bool = False
    no_scope: str = ""


@dataclass(frozen=True, slots=True)
class ContainmentLook:
    """The state of a run: whether it is refused processes or has too many, and whether a memory limit killed any."""

    refused: bool = False
    out_of_memory: bool = False


@dataclass
class ProcessTree:
    """The processes below the supervisor, listed twice a second, and at once if the machine has many new ones."""

    root: int
    sudden_tasks: int = 100
    members: list[ProcessEntry] = field(default_factory=list)
    _listed_at_s: float = float("-inf")
    _tasks_then: int = 0

    def living(self) -> list[ProcessEntry]:
        """The processes that live now."""
        return living(descendants(self.root))

    def refresh(self) -> None:
        """List the processes if it is time to."""
        now_s, tasks = monotonic_s(), tasks_on_machine()
        sudden = tasks - self._tasks_then >= self.sudden_tasks
        if sudden or now_s - self._listed_at_s >= _RESCAN_S:
            with urgent() if sudden else nullcontext():
                self.members, self._listed_at_s, self._tasks_then = descendants(self.root), now_s, tasks

    def tasks(self) -> int:
        """The number of processes and threads in the last list. Zombies count, as they do for the kernel."""
        self.refresh()
        return sum(entry.threads for entry in self.members)

    def resident_bytes(self) -> int:
        """Memory of those that were last listed, as it is now; shared pages count for each process."""
        self.refresh()
        return sum(entry.resident_bytes for known in self.members if (entry := read_process(known.pid)) is not None)


class Containment(Protocol):
    """One way to hold a run. Made by the supervisor before the run starts; found again by who cleans up after it."""

    @property
    def patience_s(self) -> float:
        """For how long the run may be refused processes before it is ended."""

    @property
    def holds_memory(self) -> bool:
        """Return whether the kernel holds the run to its memory limit."""

    @property
    def holds_cpu(self) -> bool:
        """Return whether the kernel holds the run to its share of the processors."""

    def enter(self) -> None:
        """In the run's first process, before it becomes the algorithm. Raises OSError."""

    def look(self, tree: ProcessTree) -> ContainmentLook:
        """Compare the run with its limits; ``tree`` are the processes below the supervisor."""

    def members(self) -> list[ProcessEntry]:
        """The living processes that belong to the run as far as this containment knows them."""

    def end(self, patience_s: float) -> bool:
        """Kill all that belong to the run; whether none was left in time."""

    def remove(self) -> None:
        """Give back what was taken for the run. Nothing there is fine."""

    def usage(self) -> UsageSource | None:
        """The kernel's own counters of the run; None if there are none."""

    def describe(self) -> dict[str, Any]:
        """Return the JSON that :func:`~slamhive.executors.process.containment.found_again` needs."""

    def words(self) -> dict[str, str]:
        """By what each limit is held, for the user: ``processes``, ``memory``, ``cpu``, ``end``."""
