"""Arrivals from nodes: copies of files that change while a run goes on, and the archive of its results.

Everything lies aside until it is complete. Nothing is taken that the run may not send.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import tarfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.base.files import hash_files, remedy_of, size_bytes, write_aside
from slamhive.executors.node_store.on_node.cache import FILE, FOLDER, Item, sha256_of
from slamhive.executors.node_store.on_node.results import RESULT_FILE
from slamhive.executors.node_store.registrations import Offered, Registration, copied_place, node_folder
from slamhive.executors.spec import RunInput

_ANNOUNCED_FILE = "result.json"
_PART_FILE = "result.part"
_CLAIM_FILE = "claim.json"
_WANTED_FILE = "wanted.json"
_REFUSED_FILE = "refused.txt"


class NotTaken(SlamHiveError):
    """Refusal of something that a node sent. ``status`` is that of HTTP; ``more`` goes into the answer."""

    def __init__(self, status: HTTPStatus, message: str, **more: Any) -> None:
        super().__init__(message)
        self.status = status
        self.more = more


class Arrivals:
    """Takes what nodes send. Safe to share between threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._busy: dict[Path, tuple[threading.Lock, int]] = {}

    def claim(self, registration: Registration, holder: str, said: dict[str, Any]) -> None:
        """Note who has the run. Asking again is fine; another holder is not. Raises NotTaken."""
        path = registration.folder / _CLAIM_FILE
        with self._alone(path):
            known = _read_json(path)
            if known is None:
                write_aside(path, json.dumps({**said, "holder": holder}))
            elif known.get("holder") != holder:
                raise NotTaken(HTTPStatus.CONFLICT, f"{known.get('node', 'another node')} has the run already")

    def put_copy(self, registration: Registration, place: str, begin: int, content: bytes) -> None:
        """Replace the copy of a file, or append at ``begin``, where it must end. Raises NotTaken."""
        path = _place(registration, place)
        if begin + len(content) > registration.most_copy_bytes:
            raise NotTaken(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"{place} has more than its limit")
        with self._alone(path), _written(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            if begin == 0:
                # What is sent after the results is the last word on the run.
                _replace(path, content, flush=(registration.folder / RESULT_FILE).exists())
                return
            size_bytes = path.stat().st_size if path.exists() else 0
            if size_bytes != begin:
                raise NotTaken(HTTPStatus.CONFLICT, f"{place} ends at {size_bytes}, not at {begin}", have=size_bytes)
            with path.open("ab") as stream:
                stream.write(content)

    def remove_copy(self, registration: Registration, place: str) -> None:
        """Remove the copy of a file that is gone. Raises NotTaken."""
        path = _place(registration, place)
        with self._alone(path), _written(path):
            path.unlink(missing_ok=True)

    def results(self, registration: Registration) -> dict[str, Any]:
        """The bytes of the archive that have arrived (``have``), and the SHA-256 that was announced."""
        with self._alone(registration.folder), _written(registration.folder):
            self._complete(registration)
            return _results(registration.folder)

    def put_results(
        self, registration: Registration, begin: int, announced: tuple[int, str], content: bytes
    ) -> dict[str, Any]:
        """Take a piece of the archive; what :meth:`results` returns then. Raises NotTaken.

        Args:
            registration: The run.
            begin: Where the piece begins; at 0, what has arrived of another archive is dropped.
            announced: Size (bytes) and SHA-256 of the whole archive.
            content: The piece.
        """
        folder, (total, sha256) = registration.folder, announced
        with self._alone(folder), _written(folder / _PART_FILE):
            if total > registration.most_result_bytes:
                raise self._refused(
                    registration,
                    HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                    f"the results have {total} bytes, more than the {registration.most_result_bytes} that are allowed",
                )
            known = _read_json(folder / _ANNOUNCED_FILE)
            same = known == {"total": total, "sha256": sha256}
            if same and (folder / RESULT_FILE).exists():
                return _results(folder)
            if begin == 0 and not same:
                _forget(folder)
                (folder / _PART_FILE).touch()
                write_aside(folder / _ANNOUNCED_FILE, json.dumps({"total": total, "sha256": sha256}))
            elif not same:
                raise NotTaken(HTTPStatus.CONFLICT, "the results have another size or checksum than was announced")
            self._append(registration, begin, announced, content)
            return _results(folder)

    def _append(self, registration: Registration, begin: int, announced: tuple[int, str], content: bytes) -> None:
        part, (total, _) = registration.folder / _PART_FILE, announced
        have = part.stat().st_size if part.exists() else 0
        if begin != have:
            raise NotTaken(HTTPStatus.CONFLICT, f"the results have arrived up to {have}, not {begin}", have=have)
        if have + len(content) > total:
            _forget(registration.folder)
            raise self._refused(
                registration, HTTPStatus.UNPROCESSABLE_ENTITY, f"the results are longer than announced ({total} bytes)"
            )
        with part.open("ab") as stream:
            try:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            except OSError:
                os.truncate(part, have)
                raise
        self._complete(registration)

    def _complete(self, registration: Registration) -> None:
        """Check the archive once all of it has arrived; also if the controller was killed before. Raises NotTaken."""
        folder = registration.folder
        part, known = folder / _PART_FILE, _read_json(folder / _ANNOUNCED_FILE)
        if known is None or not part.exists() or part.stat().st_size < known["total"]:
            return
        if sha256_of(part) != known["sha256"]:
            _forget(folder)
            words = f"the results have another checksum than announced ({known['sha256'][:12]}...)"
            raise self._refused(registration, HTTPStatus.UNPROCESSABLE_ENTITY, words)
        part.replace(folder / RESULT_FILE)

    @staticmethod
    def _refused(registration: Registration, status: HTTPStatus, message: str) -> NotTaken:
        """The error, which is also kept for who looks at the run."""
        write_aside(registration.folder / _REFUSED_FILE, message)
        return NotTaken(status, message)

    @contextmanager
    def _alone(self, path: Path) -> Iterator[None]:
        """One thread at a time works on ``path``: a node may ask again while its first question is being answered."""
        with self._lock:
            lock, waiting = self._busy.get(path, (threading.Lock(), 0))
            self._busy[path] = lock, waiting + 1
        try:
            with lock:
                yield
        finally:
            with self._lock:
                lock, waiting = self._busy[path]
                if waiting == 1:
                    del self._busy[path]
                else:
                    self._busy[path] = lock, waiting - 1


def results_archive(work: Path) -> Path | None:
    """The complete archive of the results of the run with this work folder; None if it has not arrived."""
    path = node_folder(work) / RESULT_FILE
    return path if path.exists() else None


def arrived_bytes(work: Path) -> tuple[int, int] | None:
    """Return the bytes of the results that have arrived, and all of them; None if none was announced."""
    known, found = _read_json(node_folder(work) / _ANNOUNCED_FILE), _results(node_folder(work))
    return None if known is None else (int(found["have"]), int(known["total"]))


def refused_results(work: Path) -> str | None:
    """Why results were not taken; None if all that came was."""
    try:
        return (node_folder(work) / _REFUSED_FILE).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None


def claimed_by(work: Path) -> dict[str, Any] | None:
    """Read the report of the node that has claimed the run with this work folder; None if none has."""
    return _read_json(node_folder(work) / _CLAIM_FILE)


def forget_claim(work: Path) -> None:
    """Let another node claim the run."""
    (node_folder(work) / _CLAIM_FILE).unlink(missing_ok=True)


def ask_to_stop(work: Path, grace_s: float) -> None:
    """Tell the node with its next answer to end the run. Raises Unavailable."""
    if node_folder(work).is_dir():
        write_aside(node_folder(work) / _WANTED_FILE, json.dumps({"stop_s": grace_s}))


def wanted(registration: Registration) -> dict[str, Any]:
    """Return the controller's orders for the run: nothing, or ``{"stop_s": grace}``."""
    return _read_json(registration.folder / _WANTED_FILE) or {}


def _results(folder: Path) -> dict[str, Any]:
    known = _read_json(folder / _ANNOUNCED_FILE)
    if known is None:
        return {"have": 0, "sha256": None, "complete": False}
    complete = (folder / RESULT_FILE).exists()
    part = folder / (RESULT_FILE if complete else _PART_FILE)
    return {"have": part.stat().st_size if part.exists() else 0, "sha256": known["sha256"], "complete": complete}


def _forget(folder: Path) -> None:
    for name in (RESULT_FILE, _PART_FILE, _ANNOUNCED_FILE):
        (folder / name).unlink(missing_ok=True)


def _place(registration: Registration, place: str) -> Path:
    try:
        return copied_place(registration, place)
    except InvalidInput as error:
        raise NotTaken(HTTPStatus.BAD_REQUEST, error.message) from None


def _replace(path: Path, content: bytes, *, flush: bool) -> None:
    """In one step. What changes all the time is not flushed to the disk."""
    if flush:
        write_aside(path, content)
        return
    aside = path.with_name(f".{path.name}.arriving")
    aside.write_bytes(content)
    aside.replace(path)


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Errors of the disk as Unavailable: the node tries again."""
    try:
        yield
    except OSError as error:
        raise Unavailable(f"{path} cannot be written: {error.strerror}", remedy_of(error)) from None


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError):
        return None
    return content


# Offers of the controller to nodes: files as they are, and folders as archives, each named by its SHA-256.
#
# An archive of a folder lies in ``<data>/node-archives/``. It is made once for what the folder holds.


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
            digits = (entry.content or "").removeprefix(_PREFIX)
            sha256 = digits if len(digits) == _HEX_DIGITS else self._sha256(source)
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

        def anonymous(info: tarfile.TarInfo) -> tarfile.TarInfo:
            info.uid = info.gid = 0
            info.uname = info.gname = ""
            return info

        with tarfile.open(aside, "w") as opened:
            opened.add(folder, "", filter=anonymous)
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


def _known(archive: Path) -> Item | None:
    try:
        item = Item.of(json.loads(archive.with_suffix(".json").read_text(encoding="utf-8")))
        return item if archive.stat().st_size == item.size_bytes else None
    except FileNotFoundError:
        return None


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
