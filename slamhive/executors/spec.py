"""The needs of a run and its outputs, in words that every executor understands.

A specification names inputs and outputs. It does not say how they reach the algorithm: containers mount them, processes
get paths, and an executor on another machine packs them into an archive (:mod:`slamhive.executors.transfer`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from slamhive.domain.algorithm import RunUser

_FILE_SLACK_BYTES = 1_000_000

ROS_ENVIRONMENT = {"ROS_HOSTNAME": "localhost", "ROS_MASTER_URI": "http://localhost:11311"}
"""What each container gets: a ROS master inside is found without a network."""


DATASET_TARGET = "/slamhive/dataset"
"""Where the container contract promises the files of the dataset."""
RECORDING = "recording"
"""The name of the input with the recorded data."""


class Limit(StrEnum):
    """Kinds of limits of a run."""

    CORES = "cores"
    MEMORY = "memory"
    PROCESSES = "processes"
    DISK = "disk"
    TIME = "time"


@dataclass(frozen=True, slots=True)
class RunInput:
    """A file or folder that the algorithm reads.

    Attributes:
        name: Names it in messages; no two inputs of a run share a name.
        source: Where it lies on the controller. It is never written to.
        target: Where the container contract promises it to the algorithm, an absolute path.
        size_bytes: The size of the file, or of all files of the folder.
        content: ``sha256:<hex>`` of what it holds; None if nobody has read it yet. Equal means equal bytes, so that a
            copy can be kept and used again.
        own_copy: The run gets a copy of its own, which it may change.
    """

    name: str
    source: Path
    target: str
    size_bytes: int = 0
    content: str | None = None
    own_copy: bool = False


@dataclass(frozen=True, slots=True)
class VariantOrder:
    """A variant of a dataset that is made where the run takes place, from the input :data:`RECORDING`.

    Attributes:
        key: Equal keys mean equal bytes.
        dataset: The name of the dataset.
        description: Its ``dataset.yaml``.
        steps: What is done to the recording.
        room_bytes: The variant takes no more.
    """

    key: str
    dataset: str
    description: str
    steps: tuple[dict[str, Any], ...]
    room_bytes: int


@dataclass(frozen=True, slots=True)
class RunOutput:
    """A folder that the algorithm writes to and the controller keeps.

    Attributes:
        name: Names it in messages.
        destination: The folder on the controller where it has to be once the run is collected.
        target: Where the container contract promises it to the algorithm, an absolute path.
        live: Names of the files in it that the controller reads while the run goes on.
        max_bytes: More than this is not taken over; None for no bound.
        max_files: The same for the number of files and folders.
    """

    name: str
    destination: Path
    target: str
    live: tuple[str, ...] = ()
    max_bytes: int | None = None
    max_files: int | None = None


@dataclass(frozen=True, slots=True)
class ResourceLimits:
    """The most that a run may use; None means that it is not limited. ``cpuset`` holds core numbers.

    ``disk_bytes`` and ``files`` count everything that the run writes. The worker watches them while the run goes on.
    """

    cpu_cores: float | None = None
    memory_bytes: int | None = None
    pids: int | None = 512
    cpuset: tuple[int, ...] | None = None
    disk_bytes: int | None = None
    files: int | None = None

    @property
    def file_bytes(self) -> int | None:
        """The size at which the kernel refuses one file: above the limit of all files, so that the watch sees it."""
        return None if self.disk_bytes is None else self.disk_bytes + _FILE_SLACK_BYTES

    @property
    def cores(self) -> float | None:
        """The number of cores that the run may use; None if that is not limited."""
        if self.cpu_cores is None:
            return None if self.cpuset is None else len(self.cpuset)
        return self.cpu_cores if self.cpuset is None else min(self.cpu_cores, len(self.cpuset))

    def only(self, enforced: frozenset[Limit]) -> ResourceLimits:
        """The limits among these that an executor with the limits ``enforced`` can hold a run to."""
        cores, disk = Limit.CORES in enforced, Limit.DISK in enforced
        return ResourceLimits(
            cpu_cores=self.cpu_cores if cores else None,
            memory_bytes=self.memory_bytes if Limit.MEMORY in enforced else None,
            pids=self.pids if Limit.PROCESSES in enforced else None,
            cpuset=self.cpuset if cores else None,
            disk_bytes=self.disk_bytes if disk else None,
            files=self.files if disk else None,
        )

    def kinds(self) -> frozenset[Limit]:
        """The kinds that are limited."""
        values = {
            Limit.CORES: (self.cpu_cores, self.cpuset),
            Limit.MEMORY: (self.memory_bytes,),
            Limit.PROCESSES: (self.pids,),
            Limit.DISK: (self.disk_bytes, self.files),
        }
        return frozenset(kind for kind, given in values.items() if any(value is not None for value in given))


@dataclass(frozen=True, slots=True)
class Placing:
    """Hints about the place of a run for an engine with several nodes. It decides; one machine ignores all of it.

    Attributes:
        cpu_model: The node must have this processor; None if any will do.
        other_nodes: Nodes that are known to have another one, in order. The run must not start there.
        near_nodes: Nodes that had a run on the same data lately, in order; they may hold it still.
        expected_s: How long the run is expected to take. Of runs that wait, the longest should start first.
    """

    cpu_model: str | None = None
    other_nodes: tuple[str, ...] = ()
    near_nodes: tuple[str, ...] = ()
    expected_s: float | None = None

    @property
    def nobody(self) -> str:
        """Why a run cannot start if all nodes are ``other_nodes``, in words."""
        return f"no node has {self.cpu_model}, the CPU model of its experiment"


ANYWHERE = Placing()


@dataclass(frozen=True, slots=True)
class RunSpec:
    """Everything an executor needs to start one run. It is stored in the run folder before the start.

    Attributes:
        key: Identifies the run across restarts and installations. Starting one key twice starts one run.
        run_id: Its number, for messages and labels.
        package: The name of the algorithm package.
        package_folder: The folder of the package on the controller.
        image: The name of the package's image, for messages.
        identity: What :meth:`Executor.build` returned: an image digest, or the hash of an environment.
        command: Program and arguments, with paths of the container contract.
        inputs: What the algorithm reads.
        outputs: What it writes.
        environment: Variables for the algorithm; values may be paths of the container contract.
        limits: What it may use.
        timeout_s: The wall-clock limit. The worker enforces it; executors with ``Limit.TIME`` do so on their own too.
        gpu: The UUID of the GPU that the worker has leased for the run; None for none.
        asks_gpu: The engine is to give the run a GPU.
        shm_bytes: The size of ``/dev/shm``; None for the default of the executor.
        placing: Where an engine with several nodes should start it. It is found out at the start, and not stored.
        work: A folder on the controller for the executor's own use, removed when the run is over.
        user: Who the run is in its container. Executors without containers take ``worker`` only.
        variant: What its node makes of the recording before it starts; None if the inputs are as the run sees them.
    """

    key: str
    run_id: int
    package: str
    package_folder: Path
    image: str
    identity: str
    command: tuple[str, ...]
    inputs: tuple[RunInput, ...]
    outputs: tuple[RunOutput, ...]
    environment: dict[str, str]
    limits: ResourceLimits
    timeout_s: float
    work: Path
    user: RunUser = RunUser.WORKER
    gpu: str | None = None
    asks_gpu: bool = False
    shm_bytes: int | None = None
    placing: Placing = ANYWHERE
    variant: VariantOrder | None = None

    def output(self, name: str) -> RunOutput:
        """The output called ``name``."""
        return next(output for output in self.outputs if output.name == name)
