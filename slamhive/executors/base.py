"""The executor seam: what every way of running an algorithm offers. See ``docs/executors.md``."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from slamhive.errors import SlamHiveError, Unavailable

if TYPE_CHECKING:
    from slamhive.domain.algorithm import AlgorithmPackage

_FILE_SLACK_BYTES = 1_000_000

ProgressCallback = Callable[[str], None]
"""Called with one line of what is going on (a build step, a layer pulled)."""


class ImageMissing(SlamHiveError):
    """The image or environment of a package does not exist and could not be made."""


class StartFailed(SlamHiveError):
    """The engine refused to start the run."""


class EngineUnavailable(Unavailable):
    """The engine does not answer now; the caller may try again, nothing is known to be lost."""


@dataclass(frozen=True, slots=True)
class Mount:
    """A host path and where the container sees it."""

    source: Path
    target: str
    read_only: bool = True


@dataclass(frozen=True, slots=True)
class Limits:
    """What a run may use. None means no limit of ours. ``cpuset`` holds core numbers.

    ``disk_bytes`` and ``files`` count what the run writes wherever it can, and are watched while it runs.
    """

    cpu_cores: float | None = None
    memory_bytes: int | None = None
    pids: int = 512
    cpuset: tuple[int, ...] | None = None
    disk_bytes: int | None = None
    files: int | None = None

    @property
    def file_bytes(self) -> int | None:
        """The size at which the kernel refuses one file: somewhat more than all may have, so that the watch sees it."""
        return None if self.disk_bytes is None else self.disk_bytes + _FILE_SLACK_BYTES


@dataclass(frozen=True, slots=True)
class RunSpec:
    """Everything an executor needs to start one run; frozen into the run folder before the start.

    ``key`` identifies the run across restarts and installations; starting the same key twice yields the same
    container. ``identity`` is the image digest, or the environment's hash for the process executor.
    """

    key: str
    run_id: int
    package: str
    package_folder: Path
    image: str
    identity: str
    command: tuple[str, ...]
    mounts: tuple[Mount, ...]
    environment: dict[str, str]
    limits: Limits
    timeout_s: float
    log_path: Path


@dataclass(frozen=True, slots=True)
class Protections:
    """By what a run is held within its limits, in words for the user.

    Attributes:
        held_by: What holds the run as a whole: a container, a control group, a user of its own, the supervisor.
        processes: What happens when it starts more processes and threads than it may.
        memory: What holds it to its memory limit.
        cpu: What holds it to its share of the processors.
        end: How all of its processes are ended.
        priority: How the supervisor gets its turn beside the run.
        does_not_hold: Stronger ways that this machine does not allow, and why: {way: reason}.
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
        """All of it in one line, except for what does not hold."""
        parts = (f"processes {self.processes}", f"memory {self.memory}", f"CPU {self.cpu}", f"end: {self.end}")
        return f"{self.held_by}: {'; '.join((*parts, self.priority))}"


@dataclass(frozen=True, slots=True)
class RunHandle:
    """What must be remembered to find a started run again after a restart: plain strings, stored with the run.

    ``data["started_at"]`` is when the engine started the run, ISO 8601 in UTC, the same for whoever adopts it; it is
    not there if the engine does not say. ``protections`` are told by who starts the run, for its record.
    """

    executor: str
    data: dict[str, str] = field(default_factory=dict)
    protections: Protections | None = None


@dataclass(frozen=True, slots=True)
class Running:
    """The run is going on. ``process_limit``: it has been refused processes for so long that it is to be ended."""

    process_limit: bool = False


@dataclass(frozen=True, slots=True)
class Exited:
    """The run has ended. ``exit_code`` is 128 + signal for a signal.

    ``process_limit`` says that its supervisor ended it for asking for more processes than it may have,
    ``refused_processes`` that it was refused some, as far as anybody saw.
    """

    exit_code: int
    out_of_memory: bool = False
    process_limit: bool = False
    refused_processes: bool = False
    started_at: datetime | None = None
    ended_at: datetime | None = None


@dataclass(frozen=True, slots=True)
class Gone:
    """Nothing answers to the handle any more and nobody knows how it ended."""

    why: str


RunStatus = Running | Exited | Gone


class UsageSource(Protocol):
    """Where CPU and memory figures of a started run come from.

    ``on_this_machine``: the run is on the machine of this process, whose own counters then tell what else went on.
    """

    @property
    def on_this_machine(self) -> bool:
        """See above."""

    def read(self) -> tuple[float, int] | None:
        """CPU time used so far (s, summed over cores) and memory in use (bytes); None once the run is gone."""

    def peak_memory_bytes(self) -> int | None:
        """The kernel's own high-water mark, None where it keeps none."""

    def close(self) -> None:
        """Let go of files and connections."""


class Executor(Protocol):
    """One way of running algorithms. All methods may raise EngineUnavailable."""

    name: str

    def unavailable_because(self) -> str | None:
        """Why this executor cannot be used on this machine, with the remedy; None if it can."""

    def protections(self) -> Protections:
        """By what runs are held within their limits on this machine. Raises Unavailable, with the remedy."""

    def identity(self, package: AlgorithmPackage) -> str | None:
        """The image digest (or environment hash) that a start would use now; None if it has to be built."""

    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Make the image or environment unless it is there already; returns its identity. Raises ImageMissing."""

    def start(self, spec: RunSpec) -> RunHandle:
        """Start the run, or find the one that was started under ``spec.key``. Raises ImageMissing, StartFailed."""

    def poll(self, handle: RunHandle) -> RunStatus:
        """How the run stands."""

    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """End the run: politely, and by force after ``grace_s``. A run that has ended already is fine."""

    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Write what the run has printed so far to ``path``."""

    def remove(self, handle: RunHandle) -> None:
        """Remove what is left of the run in the engine. Nothing left is fine."""

    def discard(self, spec: RunSpec) -> None:
        """End and remove whatever was started under ``spec.key``, by whomever. Nothing there is fine."""

    def usage_source(self, handle: RunHandle) -> UsageSource | None:
        """Where to sample the run's CPU and memory; None if it has ended."""

    def hidden_bytes(self, handle: RunHandle) -> int:
        """What the run has written where only the engine sees it; 0 if that is nowhere, or the run is gone."""

    def sweep(self, live_keys: Collection[str]) -> list[str]:
        """Remove what is left in the engine of runs other than ``live_keys``; names of the removed."""

    def close(self) -> None:
        """Close connections; runs go on. Not to be used any more."""
