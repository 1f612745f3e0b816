"""New dataset folders: everything is written aside and renamed at the end, so a folder is complete or absent."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import os
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2

from slamhive.base.errors import Conflict, Unavailable
from slamhive.base.files import size_bytes, sweep_folder
from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml
from slamhive.recordings.geometry import Array
from slamhive.recordings.writers import BagWriter
from slamhive.trajectory.layout import write_tum

Progress = Callable[[float, str], None]
"""Called with the fraction done (0..1) and what is being done."""


def _silent(_fraction: float, _text: str) -> None:
    """Show nothing."""


GROUND_TRUTH_FILE = "groundtruth.txt"
UNCERTAINTIES_FILE = "uncertainties.txt"
IMAGE_TIMES_FILE = "image_times.txt"
PLAY_SCRIPT = "rosbag_play.py"
_LONGEST_TITLE = 200
_SPARE_BYTES = 50_000_000
_BLOCK_BYTES = 4_000_000
_SHOW_EVERY_S = 0.2


class NewDataset:
    """A new dataset: writes its recording, ground truth and description.

    Args:
        aside: The folder to write to, see :func:`new_dataset_folder`.
        folder: Where the dataset will be; its name is that of the dataset.
    """

    def __init__(self, aside: Path, folder: Path) -> None:
        self.aside = aside
        self._folder = folder
        self._bag = f"{folder.name}.bag"
        self._checksum: str | None = None

    def keep(self, recording: Path, progress: Progress) -> Path:
        """Copy a finished recording, a file or the folder of a ROS 2 bag, in place of writing one; the copy."""
        self._bag = f"{self._folder.name}{recording.suffix if recording.is_file() else ''}"
        copy_recording(recording, self.aside / self._bag, progress)
        return self.aside / self._bag

    def check(self, check: Callable[[Path, Progress], None], progress: Progress) -> None:
        """Let ``check`` read the recording, while another thread computes the checksum that :meth:`seal` stores."""
        hashing = _Checksum(self.aside / self._bag)
        with ThreadPoolExecutor(1, "checksum") as pool:
            future = pool.submit(hashing.compute)
            try:
                check(self.aside / self._bag, lambda fraction, text: progress((fraction + hashing.fraction) / 2, text))
                while wait([future], _SHOW_EVERY_S).not_done:
                    progress((1 + hashing.fraction) / 2, "computing the checksum")
            finally:
                hashing.stop.set()
            self._checksum = future.result()

    def recording(self) -> BagWriter:
        """The writer of the dataset's bag; use as a context manager."""
        return BagWriter(self.aside / self._bag)

    def write_ground_truth(self, times_s: Array, positions_m: Array, quats_xyzw: Array) -> None:
        """Write the poses of the body: times (n,), positions (n, 3), quaternions (n, 4)."""
        write_tum(self.aside / GROUND_TRUTH_FILE, times_s, positions_m, quats_xyzw)

    def seal(self, progress: Progress = _silent, **description: Any) -> Dataset:
        """Write ``dataset.yaml``, with the checksum, and the play script.

        ``description`` holds the fields of :class:`~slamhive.domain.dataset.Dataset` except name, folder, bag and
        checksum, which follow from the folder.
        """
        dataset = Dataset(
            name=self._folder.name,
            folder=self._folder,
            bag=self._bag,
            checksum=self._checksum or checksum(self.aside / self._bag, progress),
            **description,
        )
        seal(self.aside, dataset)
        return dataset


class _Checksum:
    """The checksum of a recording, computed in another thread: how far it is, and whether it should end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.fraction = 0.0
        self.stop = threading.Event()

    def compute(self) -> str:
        return checksum(self._path, self._report)

    def _report(self, fraction: float, _text: str) -> None:
        if self.stop.is_set():
            raise CancelledError
        self.fraction = fraction


@contextmanager
def new_dataset(folder: Path, needed_bytes: int) -> Iterator[NewDataset]:
    """Make the dataset ``folder``, complete or not at all; raises as :func:`new_dataset_folder`."""
    with new_dataset_folder(folder, needed_bytes) as aside:
        yield NewDataset(aside, folder)


@contextmanager
def new_dataset_folder(folder: Path, needed_bytes: int) -> Iterator[Path]:
    """Yield an empty folder beside ``folder``, which is renamed to ``folder`` when the block succeeds.

    If the block fails, the folder is removed. After a kill it remains, and the next call for the same name empties it.

    Raises:
        Conflict: ``folder`` exists, or another process is making it.
        Unavailable: the disk is full or refuses.
    """
    if folder.exists():
        raise _taken(folder)
    aside = folder.with_name(f".{folder.name}.partial")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        descriptor = _lock(aside, folder)
        try:
            _empty(aside)
            free = shutil.disk_usage(folder.parent).free
            if free < needed_bytes + _SPARE_BYTES:
                raise Unavailable(  # noqa: TRY301 - what is aside is removed whatever ends the block
                    f"{folder.parent} has {free / 1e6:.0f} MB free, dataset {folder.name!r} needs about "
                    f"{(needed_bytes + _SPARE_BYTES) / 1e6:.0f} MB",
                    "free some space, or move the data root (SLAMHIVE_DATA)",
                )
            yield aside
            # A dataset of this name that was put there by hand in the meantime is not to be replaced.
            if folder.exists():
                raise _taken(folder)  # noqa: TRY301 - what is aside is removed whatever ends the block
            aside.rename(folder)
        except BaseException:
            shutil.rmtree(aside, ignore_errors=True)
            raise
        finally:
            os.close(descriptor)
    except OSError as error:
        raise Unavailable(f"{folder} cannot be written: {error.strerror}", "check space and rights") from error


def sweep_partial_folders(root: Path) -> None:
    """Remove what killed imports left below ``root``."""
    for aside in root.glob(".*.partial"):
        sweep_folder(aside)


def seal(aside: Path, dataset: Dataset) -> None:
    """Add ``dataset.yaml`` and the play script to a folder that holds the bag already."""
    (aside / PLAY_SCRIPT).write_text(shipped_script().read_text(encoding="utf-8"), encoding="utf-8")
    (aside / DATASET_FILE).write_text(dataset_to_yaml(dataset), encoding="utf-8")


def shipped_script() -> Path:
    """The play script of this version, which variants get."""
    return Path(__file__).with_name(PLAY_SCRIPT)


def current_script(path: Path) -> Path:
    """The play script that ships with this version in place of its copy at ``path``, or of none; else ``path``.

    Copies of earlier versions do not run in the Python of old images. A script that somebody else wrote is theirs.
    """
    shipped = shipped_script()
    if not path.is_file():
        return shipped
    with path.open("rb") as copy, shipped.open("rb") as own:
        return shipped if copy.readline(_LONGEST_TITLE) == own.readline() else path


def checksum(path: Path, progress: Progress = _silent) -> str:
    """``sha256:<hex>`` of a file, or of the names and contents of all files in a folder."""
    total = max(size_bytes(path), 1)
    done = 0
    digests = hashlib.sha256()
    for file in recording_files(path):
        digest = hashlib.sha256()
        with file.open("rb", buffering=0) as stream:
            while block := stream.read(_BLOCK_BYTES):
                digest.update(block)
                done += len(block)
                progress(done / total, "computing the checksum")
        if file == path:
            return f"sha256:{digest.hexdigest()}"
        digests.update(f"{file.relative_to(path)}\0".encode() + digest.digest())
    return f"sha256:{digests.hexdigest()}"


def recording_files(path: Path) -> list[Path]:
    """The files that make up a recording: the file itself, or all in the folder of a ROS 2 bag."""
    return [path] if path.is_file() else sorted(entry for entry in path.iterdir() if entry.is_file())


def copy_recording(source: Path, target: Path, progress: Progress) -> None:
    """Copy the files of a recording; file systems that can share the blocks (Btrfs, XFS) do so."""
    files = recording_files(source)
    total = max(sum(file.stat().st_size for file in files), 1)
    done = 0
    if source.is_dir():
        target.mkdir()
    for file in files:
        copy = target / file.name if source.is_dir() else target
        with file.open("rb") as reader, copy.open("wb") as writer:
            while count := _copy_block(reader.fileno(), writer.fileno()):
                done += count
                progress(done / total, f"copying {done / 1e6:.0f} of {total / 1e6:.0f} MB")


def _copy_block(source: int, target: int) -> int:
    """Copy the next block between two descriptors; the number of bytes, 0 at the end."""
    try:
        return os.copy_file_range(source, target, _BLOCK_BYTES)
    except OSError as error:
        if error.errno not in {errno.EXDEV, errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP}:
            raise
    block = memoryview(os.read(source, _BLOCK_BYTES))
    count = len(block)
    while block:
        block = block[os.write(target, block) :]
    return count


def _lock(aside: Path, folder: Path) -> int:
    """Make ``aside`` and hold it: a lock on the folder itself, which the kernel drops with the process."""
    aside.mkdir(exist_ok=True)
    descriptor = os.open(aside, os.O_RDONLY)
    if not _holds(descriptor, aside):
        os.close(descriptor)
        raise Conflict(f"dataset {folder.name!r} is being made by another process", "wait for it to end")
    return descriptor


def _holds(descriptor: int, aside: Path) -> bool:
    """Take the lock, and see that the folder was not renamed or removed by its last holder meanwhile."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(descriptor), aside.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _empty(aside: Path) -> None:
    for entry in aside.iterdir():
        if entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()


def _taken(folder: Path) -> Conflict:
    return Conflict(f"dataset {folder.name!r} exists already", "choose another name, or remove it first")


# Results of many pieces of work in their order, made by threads, with a bounded amount under way.


T = TypeVar("T")

_IN_FLIGHT_BYTES = 12 << 20
"""Of source data being worked on; what is made of it takes about as much again."""


@dataclass(frozen=True, slots=True, eq=False)
class Ready(Generic[T]):
    """A result that needs no work; ``held_bytes`` is what it keeps in memory."""

    result: T
    held_bytes: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Pending(Generic[T]):
    """Work for a thread; ``held_bytes`` is what it keeps in memory until its result is taken."""

    make: Callable[[], T]
    held_bytes: int


def in_order(tasks: Iterable[Ready[T] | Pending[T]]) -> Iterator[T]:
    """The results of ``tasks`` in their order; what a task raises is raised here."""
    waiting: deque[tuple[Ready[T] | Future[T], int]] = deque()
    held_bytes = 0
    with ThreadPoolExecutor(max(2, len(os.sched_getaffinity(0))), "in-order") as pool:
        try:
            for task in tasks:
                waiting.append((task if isinstance(task, Ready) else pool.submit(task.make), task.held_bytes))
                held_bytes += task.held_bytes
                while waiting:
                    oldest, oldest_bytes = waiting[0]
                    ready = isinstance(oldest, Ready) or oldest.done()
                    if not ready and held_bytes <= _IN_FLIGHT_BYTES:
                        break
                    waiting.popleft()
                    yield _take(oldest)
                    held_bytes -= oldest_bytes
            while waiting:
                yield _take(waiting.popleft()[0])
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def one_thread_in_opencv() -> Iterator[None]:
    """The threads here share out whole messages; OpenCV's own would only get in their way."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _take(result: Ready[T] | Future[T]) -> T:
    return result.result if isinstance(result, Ready) else result.result()
