"""The executor seam: what each way of running algorithms offers. ``docs/executors.md`` explains it."""

from __future__ import annotations

import platform
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import ClassVar, Protocol

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.settings import ExecutorOption
from slamhive.documents.plain import CacheUseDocument
from slamhive.domain.algorithm import AlgorithmPackage, Gpu
from slamhive.evaluation.process import BatchStarter, ProcessStarter
from slamhive.executors.gpu import GpuUse
from slamhive.executors.host import describe_host
from slamhive.executors.host_counters import HostReading
from slamhive.executors.spec import Limit, ResourceLimits, RunSpec
from slamhive.executors.status import RunHandle, RunStatus, UsageSource

ProgressCallback = Callable[[str], None]
"""Takes one line about what is going on, such as a build step."""

LiveKeys = Callable[[], Collection[str]]
"""Returns the keys of the runs that workers hold now."""


_WITH_IMAGES = "use an executor with images; slamhive doctor --all lists them"


class ImageMissing(SlamHiveError):
    """The image or environment of a package does not exist and cannot be made."""


class StartFailed(SlamHiveError):
    """The engine refused to start the run."""


class EngineUnavailable(Unavailable):
    """The engine does not answer now. The caller may try again; nothing is known to be lost."""


class PackageNeed(StrEnum):
    """Parts of an algorithm package that an executor may need."""

    IMAGE = "container image"
    ENVIRONMENT = "package environment"


class GpuGiver(StrEnum):
    """The giver of GPUs to runs."""

    NOBODY = "nobody"
    WORKER = "worker"
    """It leases one of its machine, and names it in the specification."""
    ENGINE = "engine"
    """A run asks for one; the engine decides which, and keeps others away from it."""


class EvaluationPlace(StrEnum):
    """Where the evaluations of runs take place."""

    CONTAINER = "evaluation image"
    PROCESS = "process of the worker"


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Promises of an executor. Callers ask for these; they never ask which executor it is.

    Attributes:
        isolates: A run sees nothing of the machine but its inputs and outputs.
        limits: The limits that the executor enforces. It refuses a run with any other limit.
        needs: What it needs from a package.
        shares_files: Runs read and write the files of the controller. Otherwise the executor transfers inputs, outputs
            and the files that are watched meanwhile.
        elsewhere: Runs take cores of other machines, though they share files with the controller.
        gpu: Who gives GPUs to its runs.
        drains: It can keep further runs away from one of its nodes.
        several_at_once: One worker may start several runs at the same time.
        evaluates_in: Where evaluations take place.
        takes_runs_along: Its engine ends runs when it ends itself, and does not tell which.
        makes_variants: It makes a variant of a dataset on the node that needs it, if the specification has an order.
        preference: ``auto`` takes the usable executor with the lowest number; None if it must be asked for by name.
    """

    isolates: bool = False
    limits: frozenset[Limit] = frozenset()
    needs: PackageNeed = PackageNeed.ENVIRONMENT
    shares_files: bool = True
    elsewhere: bool = False
    gpu: GpuGiver = GpuGiver.NOBODY
    drains: bool = False
    several_at_once: bool = True
    evaluates_in: EvaluationPlace = EvaluationPlace.PROCESS
    takes_runs_along: bool = False
    makes_variants: bool = False
    preference: int | None = None

    @property
    def takes_cores_here(self) -> bool:
        """Return whether runs take cores of the controller's machine, so that slots share them."""
        return self.shares_files and not self.elsewhere

    def refusal(self, name: str, limits: ResourceLimits) -> str | None:
        """In words, which of ``limits`` the executor ``name`` does not enforce; None if it enforces all."""
        missing = sorted(limits.kinds() - self.limits)
        return f"the executor {name} does not limit {' and '.join(missing)}" if missing else None


@dataclass(frozen=True, slots=True)
class NodeAccess:
    """The way of data to nodes that share no file system with the controller.

    Attributes:
        url: Where they reach the controller; empty if it does not serve nodes.
        cache: The folder on each node.
        cache_bytes: Its limit.
    """

    url: str
    cache: str
    cache_bytes: int


@dataclass(frozen=True, slots=True)
class ExecutorContext:
    """The arguments that every executor is made from.

    Attributes:
        data: The data root; environments and locks live below it.
        project_root: The folder with ``algorithms/`` and ``docker/``.
        installation: Distinguishes the runs of this data root from those of another on the same engine.
        log_max_bytes: How much of a run's output is kept.
        source_archives: Folder with archives of sources, for images that are built without the internet.
        nodes: How data gets to nodes; None if they see the data root.
        options: Values of the options that the executor declares, by name; those left out have their defaults.
    """

    data: Path
    project_root: Path
    installation: str
    log_max_bytes: int = 10_000_000
    source_archives: Path | None = None
    nodes: NodeAccess | None = None
    options: Mapping[str, str] = field(default_factory=dict)

    def value(self, option: ExecutorOption) -> str:
        """The value of an option of the executor."""
        return self.options.get(option.name, option.default)


@dataclass(frozen=True, slots=True)
class ProtectionFinding:
    """One result of :meth:`Executor.examine`. A ``remedy`` means that something could be better."""

    name: str
    found: str
    remedy: str | None = None


class Executor(ABC):
    """One way of running algorithms. All methods may raise EngineUnavailable.

    A new executor implements the abstract methods. The others have defaults that fit an executor which shares the file
    system of the controller and keeps nothing between runs.
    """

    name: ClassVar[str]
    capabilities: ClassVar[Capabilities]
    options: ClassVar[tuple[ExecutorOption, ...]] = ()
    """What users may set for this executor."""

    def __init__(self, context: ExecutorContext) -> None:
        self._context = context

    # -- can it be used? ---------------------------------------------------------------------------------------------

    @abstractmethod
    def unavailable_because(self) -> str | None:
        """Why this executor cannot be used on this machine, with the remedy; None if it can."""

    def examine(self) -> list[ProtectionFinding]:
        """Return the findings of ``slamhive doctor``, besides whether the executor can be used. Raises Unavailable."""
        return []

    def examine_nodes(self) -> list[ProtectionFinding]:
        """Return the offer of each node, for ``slamhive doctor cluster``. Takes a while. Raises Unavailable."""
        raise Unavailable(f"the executor {self.name} uses no other machines", "set EXECUTOR to one that does")

    def nodes(self) -> list[Node]:
        """The machines that runs can be on, by name. Quick. An executor of this machine alone need not say it."""
        return [this_machine()]

    def drain(self, node: str, drained: bool) -> None:  # noqa: ARG002 - the signature of the seam
        """Let no further run start on ``node``, or end that. Raises InvalidInput without ``capabilities.drains``."""
        raise InvalidInput(f"the executor {self.name} cannot drain {node}", "stop the worker instead")

    def check_package(self, package: AlgorithmPackage) -> None:  # noqa: B027 - most take every package
        """Raise ImageMissing if the package can never run here. Quick: it is called before a run is queued."""

    def no_part_of_a_core(self) -> str | None:
        """Why a run here cannot be held to a part of the time of a core; None if it can."""
        return None if Limit.CORES in self.capabilities.limits else f"the executor {self.name} does not limit cores"

    # -- images and environments ---------------------------------------------------------------------------------------

    @abstractmethod
    def identity(self, package: AlgorithmPackage) -> str | None:
        """The image digest or environment hash that a start would use now; None if it has to be built."""

    @abstractmethod
    def build(self, package: AlgorithmPackage, progress: ProgressCallback) -> str:
        """Make the image or environment unless it exists; returns its identity. Raises ImageMissing."""

    def has(self, package: AlgorithmPackage, identity: str) -> bool:
        """Return whether a run of ``package`` could start with this image or environment, which may be an older one."""
        return self.identity(package) == identity

    def named_image(self, package: AlgorithmPackage) -> str | None:  # noqa: ARG002 - the signature of the seam
        """The image with the name of the package, up to date or not; None if there is none, or names play no role."""
        return None

    def keep(self, package: AlgorithmPackage, identity: str, number: int) -> None:  # noqa: B027 - nothing is cleaned up
        """Keep the image or environment of version ``number``, so that no clean-up of the engine takes it."""

    def forget(self, package: str, identity: str, number: int) -> None:  # noqa: ARG002 - the signature of the seam
        """Remove the image or environment of version ``number``. Does nothing if it is gone. Raises InvalidInput."""
        raise InvalidInput(f"the executor {self.name} removes no versions", "remove them in its engine")

    def save_image(self, identity: str) -> Iterator[bytes]:  # noqa: ARG002 - as above
        """The image as ``docker save`` writes it. Raises InvalidInput if this executor has no images."""
        raise InvalidInput(f"the executor {self.name} has no images to export", _WITH_IMAGES)

    def load_image(self, chunks: Iterable[bytes]) -> str:  # noqa: ARG002 - as above
        """Take the image that :meth:`save_image` gave; its identity. Raises InvalidInput."""
        raise InvalidInput(f"the executor {self.name} takes no images", _WITH_IMAGES)

    def image_tools(self) -> ImageTools:
        """Return the tools for imports of foreign packages. Raises InvalidInput if this executor has no images."""
        raise InvalidInput(f"the executor {self.name} has no images", _WITH_IMAGES)

    # -- the life of a run ---------------------------------------------------------------------------------------------

    @abstractmethod
    def start(self, spec: RunSpec) -> RunHandle:
        """Start the run, or find the one that was started under ``spec.key``. Raises ImageMissing, StartFailed."""

    @abstractmethod
    def poll(self, handle: RunHandle) -> RunStatus:
        """The status of the run."""

    @abstractmethod
    def stop(self, handle: RunHandle, grace_s: float) -> None:
        """End the run: SIGTERM, then SIGKILL after ``grace_s``. Does nothing if the run has ended."""

    @abstractmethod
    def save_log(self, handle: RunHandle, path: Path) -> None:
        """Write what the run has printed so far to ``path``."""

    @abstractmethod
    def remove(self, handle: RunHandle) -> None:
        """End the run and remove what is left of it in the engine. Does nothing if nothing is left."""

    @abstractmethod
    def discard(self, spec: RunSpec) -> None:
        """Like :meth:`remove`, for a start whose handle was lost. Does nothing if nothing was started."""

    def refresh(self, spec: RunSpec, handle: RunHandle) -> None:  # noqa: B027 - nothing to do with shared files
        """Bring the ``live`` files of the outputs up to date on the controller. Called at each look at a run."""

    def collect(self, spec: RunSpec, handle: RunHandle) -> None:  # noqa: B027 - as above
        """Bring the outputs of a run that has ended to their destinations. May be called again after a crash."""

    # -- measuring -----------------------------------------------------------------------------------------------------

    def usage_source(self, handle: RunHandle) -> UsageSource | None:  # noqa: ARG002 - the signature of the seam
        """Measures the CPU and memory of the run; None if it has ended, or cannot be measured."""
        return None

    def host_reading(self, handle: RunHandle) -> HostReading | None:  # noqa: ARG002 - as above
        """Return the last counters of the run's machine, if that is another one; None if nothing has come yet.

        Raises Unavailable, with the reason, if nothing will come.
        """
        raise Unavailable("the run was on another machine than the worker")

    def gpus(self) -> tuple[Gpu, ...]:
        """The GPUs that a run can get, at least one. Raises Unavailable with the reason if there is none."""
        remedy = "choose one that does; slamhive doctor --all lists them"
        raise Unavailable(f"the executor {self.name} gives runs no GPU", remedy)

    def check_gpu(self) -> None:
        """Raise Unavailable, with the reason, if a run that asks for a GPU can never get one. Quick."""
        self.gpus()

    def gpus_in_use(self, key: str) -> frozenset[str]:  # noqa: ARG002 - as above
        """The UUIDs of the GPUs of all runs that run now, of any installation, except the run of ``key``."""
        return frozenset()

    def gpu_use(self, handle: RunHandle, uuid: str | None) -> GpuUse:  # noqa: ARG002 - as above
        """Measure the use of the run's GPU; ``uuid`` is None where nobody could find it out. Raises Unavailable."""
        raise Unavailable(f"the executor {self.name} does not measure GPUs")

    def hidden_bytes(self, handle: RunHandle) -> int:  # noqa: ARG002 - as above
        """Return the size of files that only the executor can see."""
        return 0

    # -- the executor as a whole ---------------------------------------------------------------------------------------

    def evaluation_starter(self) -> BatchStarter:
        """Starts evaluations in the place that ``capabilities.evaluates_in`` names."""
        return ProcessStarter(self._context.project_root)

    def sweep(self, live_keys: LiveKeys) -> list[str]:  # noqa: ARG002 - as above
        """Remove what is left of runs of this installation that are over; returns names for the log.

        Workers start runs meanwhile: first list what is there, then call ``live_keys`` for the keys that are in use.
        """
        return []

    def close(self) -> None:  # noqa: B027 - many keep no connection
        """Close connections; runs go on. The executor is not used afterwards."""


# The machines that an executor runs on, as its engine knows them.


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
    cache: CacheUseDocument | None = None


def this_machine() -> Node:
    """The machine of this process."""
    host = describe_host()
    return Node(platform.node(), "up", True, False, host.cpu_count, host.memory_bytes, host.cpu_model)


# Tools of an executor with images for imports of packages that somebody else made.


@dataclass(frozen=True, slots=True)
class CompletedImage:
    """An image that keeps the container contract.

    Attributes:
        digest: Its digest.
        user: The user that it names; empty for root.
        added: What had to be put on top, in words.
        missing: Modules that the scripts import and the image lacks.
    """

    digest: str
    user: str
    added: tuple[str, ...]
    missing: tuple[str, ...]


class ImageTools(Protocol):
    """Finds, loads, builds and completes images. All methods may raise EngineUnavailable and ImageMissing."""

    def find(self, name: str) -> str | None:
        """The digest of the image called ``name``; None if the engine does not have it."""

    def pull(self, name: str, progress: ProgressCallback) -> str:
        """Get an image from its registry; its digest."""

    def load(self, chunks: Iterable[bytes]) -> str:
        """Take the image of an archive; its digest. Names in the archive must have been removed."""

    def build(self, folder: Path, name: str, progress: ProgressCallback) -> str:
        """Build the Dockerfile of ``folder`` with that folder as its context; the digest."""

    def complete(
        self, digest: str, modules: Collection[str], progress: ProgressCallback, *, builds: bool = True
    ) -> CompletedImage:
        """Ensure that the image has python3 and PyYAML, or put them on top; look for ``modules`` too.

        Without ``builds``, nothing is put on top: raises ImageMissing that says what the image lacks.
        """

    def copy_scripts(self, digest: str, target: Path) -> bool:
        """Copy the plain files of ``/slamhive`` in the image to ``target``; False if it has none."""

    def give_name(self, digest: str, name: str) -> None:
        """Call the image ``name``."""

    def remove(self, name: str) -> None:
        """Take the name from an image, and remove the image unless something else uses it."""
