"""The GPUs of this machine, and what a run uses of one, from NVIDIA's management library (NVML).

The Python package ``nvidia-ml-py`` (extra ``gpu``) loads ``libnvidia-ml.so.1``, which comes with the driver. NVML
reports process ids of the machine, so a process in a container is recognised by its control group. In a container
whose processes have numbers of their own, nobody can tell which process is meant. Unverified on real hardware.
"""

from __future__ import annotations

import fcntl
import logging
import os
import tempfile
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import psutil

from slamhive.base.errors import Unavailable
from slamhive.domain.algorithm import Gpu

logger = logging.getLogger(__name__)

HEADER = "time,memory_bytes,utilisation\n"
NOT_MEASURED = "# not measured: "
PROC = Path("/proc")
MACHINE_NAMESPACE = "pid:[4026531836]"
"""The namespace of process ids of the machine itself: Linux gives it this number (``PROC_PID_INIT_INO``)."""

BelongsToRun = Callable[[int], bool | None]
"""Whether the process with an id of this machine belongs to the run; None if that cannot be known."""


@dataclass(frozen=True, slots=True)
class GpuUse:
    """The use of a GPU by a run.

    Attributes:
        memory_bytes: Memory of the run's processes; None where the driver does not say, as under virtualisation, and
            where it cannot be known which processes are those of the run.
        utilisation: Share (0 to 1) of the last sampling period of the driver in which the GPU computed for anybody.
    """

    memory_bytes: int | None
    utilisation: float


@contextmanager
def _nvml(doing: str) -> Iterator[ModuleType]:
    """NVML, ready; raises Unavailable with the reason where there is none."""
    try:
        import pynvml  # noqa: PLC0415 - few machines have it
    except ImportError:
        raise Unavailable(f"{doing}: nvidia-ml-py is not installed", "pip install 'slamhive[gpu]'") from None
    try:
        pynvml.nvmlInit()
        try:
            yield pynvml
        finally:
            pynvml.nvmlShutdown()
    except pynvml.NVMLError as error:
        raise Unavailable(f"{doing}: {error}", "install NVIDIA's driver, or choose a machine with a GPU") from None


def list_gpus() -> tuple[Gpu, ...]:
    """All GPUs in the driver's order; raises Unavailable, with the reason, if there is none."""
    with _nvml("there is no GPU here") as nvml:
        driver = _text(nvml.nvmlSystemGetDriverVersion())
        handles = [nvml.nvmlDeviceGetHandleByIndex(number) for number in range(nvml.nvmlDeviceGetCount())]
        found = tuple(
            Gpu(
                _text(nvml.nvmlDeviceGetUUID(handle)),
                _text(nvml.nvmlDeviceGetName(handle)),
                driver,
                int(nvml.nvmlDeviceGetMemoryInfo(handle).total),
            )
            for handle in handles
        )
    if not found:
        raise Unavailable("there is no GPU here: the driver finds none", "choose a machine with a GPU")
    return found


def gpu_use(uuid: str, belongs: BelongsToRun) -> GpuUse:
    """Measure how much of the GPU the processes use that ``belongs`` names; raises Unavailable."""
    with _nvml(f"GPU {uuid} cannot be measured") as nvml:
        handle = nvml.nvmlDeviceGetHandleByUUID(uuid)
        computing = nvml.nvmlDeviceGetComputeRunningProcesses(handle)
        ours = [(process.usedGpuMemory, belongs(process.pid)) for process in computing]
        # None is in the list for a process of the run with unknown memory, and for one that may be of the run.
        used = [None if mine is None or memory is None else int(memory) for memory, mine in ours if mine is not False]
        utilisation = nvml.nvmlDeviceGetUtilizationRates(handle).gpu / 100
    known = [memory for memory in used if memory is not None]
    return GpuUse(sum(known) if len(known) == len(used) else None, utilisation)


def in_container(container_id: str, proc: Path = PROC) -> BelongsToRun:
    """Recognises the processes of a container: their control group is named after it."""
    of_machine = _namespace(proc) == MACHINE_NAMESPACE

    def belongs(pid: int) -> bool | None:
        if not of_machine:
            return None
        try:
            return container_id in (proc / str(pid) / "cgroup").read_text(encoding="ascii", errors="replace")
        except OSError:
            return False  # it has ended

    return belongs


def below(ancestor: psutil.Process, proc: Path = PROC) -> BelongsToRun:
    """Recognises the descendants of a process."""
    of_machine = _namespace(proc) == MACHINE_NAMESPACE

    def belongs(pid: int) -> bool | None:
        if not of_machine:
            return None
        try:
            return ancestor in psutil.Process(pid).parents()
        except psutil.NoSuchProcess:
            return False

    return belongs


def _namespace(proc: Path) -> str | None:
    """The namespace in which this process sees process ids; None if Linux does not say."""
    try:
        return str((proc / "self" / "ns" / "pid").readlink())
    except OSError:
        return None


class GpuLog:
    """Appends what a run uses of its GPU to ``gpu.csv``; where it cannot be measured, one line that says why.

    Args:
        path: ``gpu.csv``.
        read: One reading; raises Unavailable.
        interval_s: Samples closer together than this are left out.
    """

    def __init__(self, path: Path, read: Callable[[], GpuUse], interval_s: float = 0.5) -> None:
        self._path = path
        self._read = read
        self._interval_s = interval_s
        self._next_s: float | None = None
        self._given_up = False

    def sample(self, time_s: float) -> None:
        """Append a reading at ``time_s`` since the run's start, if it is time for it."""
        if self._given_up or (self._next_s is not None and time_s < self._next_s):
            return
        self._next_s = time_s + self._interval_s
        try:
            use = self._read()
        except Unavailable as error:
            self._given_up = True
            self._append(f"{NOT_MEASURED}{error}\n")
            return
        memory = "" if use.memory_bytes is None else use.memory_bytes
        self._append(f"{time_s:.4f},{memory},{use.utilisation:.4f}\n", HEADER)

    def _append(self, text: str, header: str = "") -> None:
        try:
            new = not self._path.exists()
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(header + text if new else text)
        except OSError as error:
            self._given_up = True
            logger.warning("%s: the GPU is not measured: %s", self._path, error.strerror)


def _text(value: str | bytes) -> str:
    """Older versions of the binding return bytes."""
    return value.decode() if isinstance(value, bytes) else value


# Leases of GPUs: on one machine, a GPU belongs to one run at a time, whichever worker and data root it is of.
#
# A lease is a file lock, which the kernel releases when the worker dies. A container outlives its worker. Therefore
# whoever takes a lease also asks the engine which GPUs running containers have.


InUse = Callable[[], Collection[str]]
"""Returns the UUIDs of GPUs that other running containers have."""


def lock_folder() -> Path:
    """A folder that all workers of this machine share and may write to."""
    shared = Path("/run/lock")
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())


@contextmanager
def lease_gpu(
    gpus: Sequence[Gpu], in_use: InUse, wait: Callable[[], None], folder: Path | None = None
) -> Iterator[Gpu]:
    """Hold one of ``gpus`` during the block.

    Args:
        gpus: Those to choose from, at least one.
        in_use: GPUs that containers of other runs have. Asked while the lock is held.
        wait: Called while all are taken, for example to pause; may raise to give up.
        folder: Where the locks are; by default that of the machine.

    Raises:
        Unavailable: the folder refuses.
    """
    while True:
        for gpu in gpus:
            descriptor = _try_lock((folder or lock_folder()) / f"slamhive-{gpu.uuid}.lock")
            if descriptor is None:
                continue
            try:
                # The container of a killed worker goes on without its lock.
                if gpu.uuid not in in_use():
                    yield gpu
                    return
            finally:
                os.close(descriptor)
        wait()


def _try_lock(path: Path) -> int | None:
    """The descriptor of the locked file; None if somebody else holds it."""
    try:
        descriptor = _open(path)
    except OSError as error:
        raise Unavailable(f"{path} cannot be opened: {error.strerror}", "check rights") from None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def _open(path: Path) -> int:
    """Open the file, also that of another user, which the kernel allows in shared folders only without O_CREAT."""
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        return os.open(path, flags)
    except FileNotFoundError:
        return os.open(path, flags | os.O_CREAT, 0o644)
