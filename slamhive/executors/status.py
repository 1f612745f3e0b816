"""Reports of executors about started runs. Supervisors import this module, so it stays small."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from slamhive.domain.algorithm import GivenGpu
    from slamhive.domain.run import Host

BY_SIGNAL = (137, 143)
"""Exit codes of what SIGKILL or SIGTERM ended, as the shutdown of a machine does."""


@dataclass(frozen=True, slots=True)
class Protections:
    """Words for the user on how the limits of a run are enforced.

    Attributes:
        held_by: What contains the run: a container, a control group, a user of its own, or its supervisor.
        processes: What happens when it starts too many processes and threads.
        memory: What enforces its memory limit.
        cpu: What enforces its share of the processors.
        end: How all of its processes are ended.
        priority: How the supervisor gets CPU time beside the run.
        does_not_hold: Stronger ways that this machine does not allow: {way: reason}.
    """

    held_by: str
    processes: str
    memory: str
    cpu: str
    end: str
    priority: str
    does_not_hold: dict[str, str] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """Everything except ``does_not_hold``, on one line."""
        parts = (f"processes {self.processes}", f"memory {self.memory}", f"CPU {self.cpu}", f"end: {self.end}")
        return f"{self.held_by}: {'; '.join((*parts, self.priority))}"


@dataclass(frozen=True, slots=True)
class RunHandle:
    """The key by which a restarted worker finds a run again: plain strings, stored with the run.

    ``data["started_at"]`` is the time at which the engine started the run (ISO 8601, UTC). It is the same for each
    worker that adopts the run, and absent if the engine does not know it. ``protections`` go into the record, and
    so does ``host``: the machine of the run, None if it is that of the worker. ``gpu`` is what the engine gave it.
    ``variant_checksum`` is that of the recording that its node made; None if the node made none.
    """

    executor: str
    data: dict[str, str] = field(default_factory=dict)
    protections: Protections | None = None
    host: Host | None = None
    gpu: GivenGpu | None = None
    variant_checksum: str | None = None


@dataclass(frozen=True, slots=True)
class Running:
    """The run goes on.

    Attributes:
        process_limit: It was refused processes for so long that the worker must end it.
        as_of: When that was known; None for now. A node that cannot be asked may have ended the run since.
        delivering: The algorithm has ended, and its results are on their way to the controller. Limits count no more.
    """

    process_limit: bool = False
    as_of: datetime | None = None
    delivering: bool = False


@dataclass(frozen=True, slots=True)
class Exited:
    """The run has ended.

    Attributes:
        exit_code: Of the algorithm; 128 + signal for a signal.
        out_of_memory: The memory limit killed the run or one of its processes.
        process_limit: The executor ended it because it kept asking for more processes than it may have.
        refused_processes: It was refused processes, as far as anybody saw.
        timed_out: The executor ended it at its time limit.
        started_at: When the algorithm started.
        ended_at: When it ended.
    """

    exit_code: int
    out_of_memory: bool = False
    process_limit: bool = False
    refused_processes: bool = False
    timed_out: bool = False
    started_at: datetime | None = None
    ended_at: datetime | None = None


@dataclass(frozen=True, slots=True)
class Gone:
    """The run cannot be found any more, and nobody knows how it ended."""

    why: str


RunStatus = Running | Exited | Gone


class UsageSource(Protocol):
    """Measures CPU and memory of a started run."""

    @property
    def on_this_machine(self) -> bool:
        """Return whether the run is on this machine, so that the counters here show what disturbed it."""

    def read(self) -> tuple[float, int] | None:
        """CPU time used so far (s, summed over cores) and memory in use (bytes); None once the run is gone."""

    def totals(self) -> dict[str, float]:
        """Return the kernel's counters of the whole run, as of the last reading: {metric: value}, none of which falls.

        The metrics are those of :mod:`slamhive.domain.metrics` that no sample could give, such as ``ram.charged_max``.
        What the kernel does not record is absent.
        """

    def close(self) -> None:
        """Close files and connections."""
