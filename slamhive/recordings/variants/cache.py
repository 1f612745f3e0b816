"""The cache of variants. Each is made once, is complete or absent, and the least recently used goes first.

``<root>/<key>/`` is a dataset folder with ``variant.json`` beside the recording. ``<key>.lock`` beside it carries the
locks (``flock``: the kernel releases them when the process ends). A user of a variant shares its lock. To make
or remove one it holds the lock exclusively. ``.<key>.partial`` is work in progress and never used as a variant.
"""

from __future__ import annotations

import fcntl
import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from slamhive.base.bounds import read_record
from slamhive.base.clock import monotonic_s, utc_now
from slamhive.base.errors import Conflict, InvalidInput, SlamHiveError, Unavailable, unknown
from slamhive.base.files import write_aside
from slamhive.base.tree import folder_bytes
from slamhive.domain.dataset import Dataset
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.staging import Progress, checksum

# Locks files between processes, shared or exclusive; the kernel releases them when the process ends.


POLL_S = 0.05
_PROBES = 3
_PROBE_PAUSE_S = 0.002


class Busy(Exception):
    """Another process holds the lock."""


@contextmanager
def shared(path: Path, waiting: Progress) -> Iterator[None]:
    """Hold the lock together with others; ``waiting`` is called while another process holds it exclusively."""
    with _held(path, fcntl.LOCK_SH, waiting):
        yield


@contextmanager
def exclusive(path: Path, waiting: Progress | None = None) -> Iterator[None]:
    """Hold the lock exclusively; ``waiting`` is called while others hold it. Without it, raise Busy at once."""
    with _held(path, fcntl.LOCK_EX, waiting):
        yield


def is_held(path: Path) -> bool:
    """Tell if any process holds the lock now; creates no file."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return False
    try:
        # Only an exclusive lock meets those who share it. Another process that asks the same has it for a moment, so
        # one refusal is no answer yet.
        for _ in range(_PROBES):
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                time.sleep(_PROBE_PAUSE_S)
            else:
                return False
        return True
    finally:
        os.close(descriptor)


@contextmanager
def _held(path: Path, kind: int, waiting: Progress | None) -> Iterator[None]:
    descriptor = _take(path, kind)
    while descriptor is None:
        if waiting is None:
            raise Busy(str(path))
        waiting(0.0, "waiting for another process")
        time.sleep(POLL_S)
        descriptor = _take(path, kind)
    try:
        yield
    finally:
        os.close(descriptor)


def _take(path: Path, kind: int) -> int | None:
    """Try to take the lock; returns its descriptor or None."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_CREAT | os.O_CLOEXEC, 0o644)
    except OSError as error:
        raise Unavailable(f"{path} cannot be opened: {error.strerror}", "check space and rights") from None
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        # The last holder may have removed the file meanwhile; a lock on what nobody else can open is worth nothing.
        if os.path.samestat(os.fstat(descriptor), path.stat()):
            return descriptor
    except (BlockingIOError, FileNotFoundError):
        pass
    os.close(descriptor)
    return None


# ``variant.json`` beside a variant's recording: its origin, and the checksums of its files.


MANIFEST = "variant.json"

UNREADABLE = (InvalidInput, OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError)
"""What reading a manifest that is damaged, or removed meanwhile, may raise."""


@dataclass(frozen=True, slots=True)
class VariantPlan:
    """Order for a variant: its key, its source, its steps as JSON, a bound of its size.

    ``source_bytes`` is the size of the recording that has to be read for it.
    """

    key: str
    dataset: str
    steps: tuple[Mapping[str, Any], ...]
    needed_bytes: int
    source_bytes: int


@dataclass(frozen=True, slots=True)
class VariantManifest:
    """The content of ``variant.json``. ``files``: {path in the folder: (bytes, checksum)}.

    ``bytes_per_s`` is how fast it was made, by the size of the recording that was read; None if that is not known.
    """

    dataset: str
    steps: tuple[Mapping[str, Any], ...]
    made_at: datetime
    bytes_per_s: float | None
    files: Mapping[str, tuple[int, str]]

    @property
    def size_bytes(self) -> int:
        """Of all files together."""
        return sum(size for size, _ in self.files.values())


def write_manifest(folder: Path, plan: VariantPlan, dataset: Dataset, took_s: float) -> None:
    """Describe ``folder``, in which ``dataset`` was written in ``took_s``; nothing is added to it afterwards."""
    known = {dataset.bag: dataset.checksum}
    files: dict[str, tuple[int, str]] = {}
    for path in sorted(entry for entry in folder.rglob("*") if entry.is_file()):
        name = path.relative_to(folder).as_posix()
        files[name] = (path.stat().st_size, known.get(name) or checksum(path))
    content = {
        "dataset": plan.dataset,
        "steps": list(plan.steps),
        "made_at": utc_now().isoformat(timespec="seconds"),
        "bytes_per_s": plan.source_bytes / took_s if took_s > 0 else None,
        "files": files,
    }
    write_aside(folder / MANIFEST, json.dumps(content, indent=1, allow_nan=False) + "\n")


def read_manifest(folder: Path) -> VariantManifest:
    """The manifest of ``folder``; raises one of :data:`UNREADABLE`."""
    content = read_record(folder / MANIFEST)
    bytes_per_s = content.get("bytes_per_s")
    return VariantManifest(
        dataset=str(content["dataset"]),
        steps=tuple(dict(step) for step in content["steps"]),
        made_at=datetime.fromisoformat(content["made_at"]),
        # Variants that were made before it was written down lack it.
        bytes_per_s=float(bytes_per_s) if isinstance(bytes_per_s, int | float) and bytes_per_s > 0 else None,
        files={str(name): (int(size), str(digest)) for name, (size, digest) in content["files"].items()},
    )


def problem(folder: Path) -> str | None:
    """Name the reason against using a variant, by names and sizes; None if there is none."""
    if not folder.is_dir():
        return "it is not there"
    try:
        for name, (size_bytes, _) in read_manifest(folder).files.items():
            found_bytes = (folder / name).stat().st_size
            if found_bytes != size_bytes:
                return f"{name} has {found_bytes} bytes, {size_bytes} were written"
        load_dataset(folder)
    except (*UNREADABLE, SlamHiveError) as error:
        return f"{type(error).__name__}: {error}"
    return None


def changed_file(folder: Path) -> str | None:
    """Read every byte; which file is not what was written, None if all are."""
    for name, (_, expected) in read_manifest(folder).files.items():
        if checksum(folder / name) != expected:
            return f"{name} has changed since it was written"
    return None


def flush(folder: Path) -> None:
    """Everything to disk: what gets its name afterwards is whole, also after a power cut."""
    for path in [*folder.rglob("*"), folder]:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


logger = logging.getLogger(__name__)

_ROOM_LOCK = ".room.lock"
_PARTIAL = ".partial"

Builder = Callable[[Path, Progress], Dataset]
"""Writes the dataset into an empty folder and returns its description."""


@dataclass(frozen=True, slots=True)
class VariantEntry:
    """One variant that lies in the cache; ``used_at`` is when it was last held. ``bytes_per_s``: see ``Manifest``."""

    key: str
    dataset: str
    steps: tuple[Mapping[str, Any], ...]
    size_bytes: int
    made_at: datetime
    bytes_per_s: float | None
    used_at: datetime
    in_use: bool


@dataclass(frozen=True, slots=True)
class CacheLimits:
    """The size of the cache, and the space to keep free on its disk."""

    cache_bytes: int
    free_bytes: int = 0


class VariantCache:
    """The variants of one data root, shared by all processes.

    Args:
        root: Their folder; made when the first variant is.
        limits: Kept to when a variant is made.
        kept: Returns keys that are in use although no process holds them (by a container whose worker was killed).
    """

    def __init__(self, root: Path, limits: CacheLimits, kept: Callable[[], Collection[str]] = frozenset) -> None:
        self._root = root
        self._limits = limits
        self._kept = kept

    @contextmanager
    def hold(self, plan: VariantPlan, build: Builder, progress: Progress) -> Iterator[Dataset]:
        """Hold a variant, which is made if necessary; nobody removes it before the block ends.

        ``progress`` is also called while another process makes it; an exception from there ends the wait.

        Raises:
            InvalidInput: the recording cannot be read, or the variant can never fit.
            Unavailable: the disk is full now, or refuses.
        """
        self._make_root()
        while True:
            with shared(self._lock(plan.key), progress):
                if problem(self._folder(plan.key)) is None:
                    self._touch(plan.key)
                    yield load_dataset(self._folder(plan.key))
                    self._touch(plan.key)
                    return
            with exclusive(self._lock(plan.key), progress):
                if problem(self._folder(plan.key)) is not None:
                    self._make(plan, build, progress)

    @contextmanager
    def hold_made(self, key: str) -> Iterator[None]:
        """Keep an existing variant for a run that continues; it may be gone."""
        self._make_root()
        with shared(self._lock(key), _silent):
            yield

    def check_room(self, plan: VariantPlan) -> None:
        """Raise what :meth:`hold` would for lack of room, even with every unused variant removed; changes nothing."""
        self._check_limit(plan)
        if problem(self._folder(plan.key)) is not None:
            unused_bytes = sum(entry.size_bytes for entry in self.entries() if not entry.in_use)
            self._check_disk(plan, self._free_bytes() + unused_bytes)

    def entries(self) -> tuple[VariantEntry, ...]:
        """All variants, the most recently used first."""
        kept = self._kept()
        found = [entry for key in self._keys() if (entry := self._entry(key, kept)) is not None]
        return tuple(sorted(found, key=lambda entry: entry.used_at, reverse=True))

    def find(self, key: str) -> VariantEntry:
        """The variant whose key begins with ``key``; raises NotFound, or InvalidInput if several do."""
        keys = [found for found in self._keys() if key and found.startswith(key)]
        if len(keys) > 1:
            raise InvalidInput(f"variant {key!r} is not clear: {', '.join(keys)}", "give more of its key")
        entry = self._entry(keys[0], self._kept()) if keys else None
        if entry is None:
            raise unknown("variant", key, self._keys(), "slamhive variants list shows all")
        return entry

    def drop(self, key: str) -> None:
        """Remove a variant; raises Conflict while it is in use."""
        in_use = Conflict(f"variant {key} is in use", "wait for its runs to end, or cancel them")
        if key in self._kept():
            raise in_use
        try:
            with exclusive(self._lock(key)):
                self._remove(key)
                self._lock(key).unlink(missing_ok=True)
        except Busy:
            raise in_use from None

    def verify(self, key: str) -> str | None:
        """Read every byte of a variant; returns the problem, or None."""
        folder = self._folder(key)
        with shared(self._lock(key), _silent):
            return problem(folder) or changed_file(folder)

    def _make(self, plan: VariantPlan, build: Builder, progress: Progress) -> None:
        """With the variant's lock held alone: write aside, flush to disk, rename."""
        aside = self._aside(plan.key)
        try:
            self._remove(plan.key)
            # Once the folder aside is made, others count the space that it will take.
            self._check_limit(plan)
            with exclusive(self._root / _ROOM_LOCK, _silent):
                self.sweep()
                self._evict(plan.needed_bytes)
                self._check_disk(plan, self._free_bytes())
                self._lock(plan.key).write_text(str(plan.needed_bytes), encoding="ascii")
                self._aside(plan.key).mkdir()
            began_s = monotonic_s()
            dataset = build(aside, progress)
            write_manifest(aside, plan, dataset, monotonic_s() - began_s)
            flush(aside)
            aside.rename(self._folder(plan.key))
        except BaseException as error:
            shutil.rmtree(aside, ignore_errors=True)
            if isinstance(error, OSError):
                message = f"variant {plan.key} of {plan.dataset} cannot be written: {error.strerror}"
                raise Unavailable(message, "check space and rights") from error
            raise
        with exclusive(self._root / _ROOM_LOCK, _silent):
            self._evict(wanted_bytes=0)

    def _check_limit(self, plan: VariantPlan) -> None:
        if plan.needed_bytes > self._limits.cache_bytes:
            raise InvalidInput(
                f"a variant of {plan.dataset} may need {_megabytes(plan.needed_bytes)}, the cache is to hold "
                f"{_megabytes(self._limits.cache_bytes)}",
                "raise VARIANT_CACHE_BYTES",
            )

    def _check_disk(self, plan: VariantPlan, free_bytes: int) -> None:
        if free_bytes < plan.needed_bytes:
            raise Unavailable(
                f"{self._root} has {_megabytes(max(0, free_bytes))} to spare, a variant of {plan.dataset} needs "
                f"about {_megabytes(plan.needed_bytes)}",
                "free some space, or move the data root (SLAMHIVE_DATA)",
            )

    def _evict(self, wanted_bytes: int) -> None:
        """Remove the least recently used variants until cache and disk have space for ``wanted_bytes``."""
        entries = self.entries()
        held_bytes = sum(entry.size_bytes for entry in entries) + sum(self._reserved().values())
        for entry in reversed(entries):
            if held_bytes + wanted_bytes <= self._limits.cache_bytes and self._free_bytes() >= wanted_bytes:
                return
            try:
                self.drop(entry.key)
            except Conflict:
                continue
            held_bytes -= entry.size_bytes
            logger.info("variant %s of %s made room (%s)", entry.key, entry.dataset, _megabytes(entry.size_bytes))

    def _free_bytes(self) -> int:
        """Free space of the disk, minus the reserve and what others are about to write."""
        unwritten = sum(max(0, wanted - folder_bytes(self._aside(key))) for key, wanted in self._reserved().items())
        place = self._root if self._root.exists() else self._root.parent
        return shutil.disk_usage(place).free - self._limits.free_bytes - unwritten

    def _reserved(self) -> dict[str, int]:
        """Bytes reserved by each variant in the making."""
        found: dict[str, int] = {}
        for aside in self._root.glob(f".*{_PARTIAL}"):
            key = aside.name[1 : -len(_PARTIAL)]
            try:
                found[key] = int(self._lock(key).read_text(encoding="ascii") or 0)
            except (OSError, ValueError):
                found[key] = 0
        return found

    def sweep(self) -> None:
        """Remove leftovers of killed builds."""
        for key in self._reserved():
            try:
                with exclusive(self._lock(key)):
                    shutil.rmtree(self._aside(key), ignore_errors=True)
            except Busy:
                continue

    def _remove(self, key: str) -> None:
        """With the lock held alone: out of the way in one step, then file by file."""
        aside, folder = self._aside(key), self._folder(key)
        try:
            if aside.exists():
                shutil.rmtree(aside)
            if folder.exists():
                folder.rename(aside)
                shutil.rmtree(aside)
        except OSError as error:
            raise Unavailable(f"{folder} cannot be removed: {error.strerror}", "check rights") from error

    def _keys(self) -> list[str]:
        return sorted(path.parent.name for path in self._root.glob(f"[!.]*/{MANIFEST}"))

    def _entry(self, key: str, kept: Collection[str]) -> VariantEntry | None:
        """None if it was removed meanwhile, or cannot be read: the next request makes it again."""
        try:
            manifest = read_manifest(self._folder(key))
            used_s = (self._folder(key) / MANIFEST).stat().st_mtime
        except UNREADABLE:
            return None
        return VariantEntry(
            key=key,
            dataset=manifest.dataset,
            steps=manifest.steps,
            size_bytes=manifest.size_bytes,
            made_at=manifest.made_at,
            bytes_per_s=manifest.bytes_per_s,
            used_at=datetime.fromtimestamp(used_s, UTC),
            in_use=key in kept or is_held(self._lock(key)),
        )

    def _touch(self, key: str) -> None:
        """Note the use now, as the modification time of the manifest."""
        try:
            os.utime(self._folder(key) / MANIFEST)
        except OSError as error:
            logger.info("variant %s: %s", key, error)

    def _make_root(self) -> None:
        try:
            self._root.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise Unavailable(f"{self._root} cannot be made: {error.strerror}", "check space and rights") from None

    def _folder(self, key: str) -> Path:
        return self._root / key

    def _aside(self, key: str) -> Path:
        return self._root / f".{key}{_PARTIAL}"

    def _lock(self, key: str) -> Path:
        return self._root / f"{key}.lock"


def _megabytes(size_bytes: int) -> str:
    return f"{size_bytes / 1e6:.0f} MB"


def _silent(_fraction: float, _text: str) -> None:
    """Discard the progress."""
