"""Offers of the controller to nodes: files as they are, and folders as archives, each named by its SHA-256.

An archive of a folder lies in ``<data>/node-archives/``. It is made once for what the folder holds.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import tarfile
from collections.abc import Iterator
from pathlib import Path

from slamhive.clock import utc_now
from slamhive.errors import Unavailable
from slamhive.executors.node_store.on_node.cache import FILE, FOLDER, Item, sha256_of
from slamhive.executors.node_store.registrations import Offered
from slamhive.executors.spec import RunInput
from slamhive.files import hash_files, remedy_of, size_bytes, write_aside

_PREFIX = "sha256:"
_HEX_DIGITS = 64
_UNUSED_S = 86_400.0
"""An archive that no run has needed for so long is removed, and made again when one needs it."""


class Offers:
    """Makes what nodes can fetch. Safe to share between threads and processes."""

    def __init__(self, data: Path) -> None:
        self._folder = data / "node-archives"
        self._hashes: dict[tuple[Path, int, int], str] = {}

    def input(self, entry: RunInput) -> Offered:
        """An input of a run. Raises Unavailable if it cannot be read, or the disk is full."""
        source = entry.source.resolve()
        words = f"the {entry.name} ({source.name})"
        with _readable(source):
            if source.is_dir():
                return self.folder(source, entry.content or hash_files(source), words)
            sha256 = _digits(entry.content) or self._sha256(source)
            return Offered(source, Item(sha256, source.stat().st_size, FILE, 0, words))

    def folder(self, folder: Path, content: str, words: str) -> Offered:
        """A folder. Raises Unavailable.

        Args:
            folder: It must not change while it is being packed.
            content: Names what it holds: equal means equal.
            words: What it is, for messages.
        """
        name = hashlib.sha256(content.encode()).hexdigest()
        archive = self._folder / f"{name}.tar"
        with _readable(folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            with _locked(self._folder / f".{name}.lock"):
                item = _known(archive) or self._pack(folder, archive)
                os.utime(archive)
        return Offered(archive, item._replace(words=words))

    def sweep(self, in_use: set[Path]) -> None:
        """Remove archives that no run has needed for a day, and what killed processes have left."""
        for path in (*self._folder.glob("*.tar"), *self._folder.glob(".*.packing")):
            with contextlib.suppress(OSError):
                if path not in in_use and utc_now().timestamp() - path.stat().st_mtime > _UNUSED_S:
                    path.with_suffix(".json").unlink(missing_ok=True)
                    path.unlink(missing_ok=True)

    @staticmethod
    def _pack(folder: Path, archive: Path) -> Item:
        """The same folder makes the same archive, so that a node fetches nothing again after a sweep."""
        aside = archive.with_name(f".{archive.name}.packing")
        with tarfile.open(aside, "w") as opened:
            opened.add(folder, "", filter=_anonymous)
        item = Item(sha256_of(aside), aside.stat().st_size, FOLDER, size_bytes(folder))
        write_aside(archive.with_suffix(".json"), json.dumps(item._asdict()))
        aside.replace(archive)
        return item

    def _sha256(self, path: Path) -> str:
        """The hash of a file whose content nobody has hashed; read once unless it changes."""
        status = path.stat()
        key = path, status.st_size, status.st_mtime_ns
        if key not in self._hashes:
            self._hashes[key] = sha256_of(path)
        return self._hashes[key]


def _anonymous(info: tarfile.TarInfo) -> tarfile.TarInfo:
    info.uid = info.gid = 0
    info.uname = info.gname = ""
    return info


def _known(archive: Path) -> Item | None:
    try:
        item = Item.of(json.loads(archive.with_suffix(".json").read_text(encoding="utf-8")))
        return item if archive.stat().st_size == item.size_bytes else None
    except FileNotFoundError:
        return None


def _digits(content: str | None) -> str | None:
    digits = (content or "").removeprefix(_PREFIX)
    return digits if len(digits) == _HEX_DIGITS else None


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise Unavailable(f"{path} cannot be offered to nodes: {error.strerror}", remedy_of(error)) from None


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """One process at a time packs a folder; the kernel frees the lock of a killed one."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
