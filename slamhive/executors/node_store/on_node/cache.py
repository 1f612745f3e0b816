"""Content-addressed files and folders of a node, shared by all runs on it.

``<cache>/sha256/ab/<hash>`` is an item: a file with this SHA-256, or the folder of the archive with it. It appears in
one step, so it is always complete. What the node itself makes is an item too: a folder, named by the hash of its
recipe. Beside it lies ``<hash>.lock``. Who transfers or removes the item has it locked alone; who uses it shares the
lock. The kernel frees the locks of killed processes. The content of the lock file is the room that the item takes
(bytes), and its time is that of the latest use. ``<hash>.part`` is what has arrived so far.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import random
import shutil
import tarfile
import time
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Optional

from slamhive.base.tree import folder_bytes

FILE, FOLDER, MADE = "file", "folder", "made"
_LOCK, _PART, _UNPACKING = ".lock", ".part", ".unpacking"
_PAUSE_S = 0.1
_FULL = (errno.ENOSPC, errno.EDQUOT)


class CacheFull(Exception):
    """There is no room for an item, even without everything that no run uses."""


class Item(NamedTuple):
    """Something that a run needs.

    Attributes:
        sha256: Of the file, of the archive of the folder, or of the recipe, in hexadecimal digits.
        size_bytes: Of the file or archive; what is made takes no more.
        kind: ``file``, ``folder``, or ``made`` for a folder that the node makes.
        unpacked_bytes: What the files of the folder take; 0 for a file.
        words: What it is, for messages.
    """

    sha256: str
    size_bytes: int
    kind: str = FILE
    unpacked_bytes: int = 0
    words: str = "an input"

    @property
    def room_bytes(self) -> int:
        """The most room that it takes: a folder exists beside its archive while it is unpacked."""
        return self.size_bytes + self.unpacked_bytes

    @property
    def kept_bytes(self) -> int:
        """The room that it takes once it is there; for what is made, at most."""
        return self.unpacked_bytes if self.kind == FOLDER else self.size_bytes

    @classmethod
    def of(cls, content: Dict[str, Any]) -> Item:
        """From JSON. Raises ValueError, KeyError, TypeError for what is no item."""
        item = cls(
            str(content["sha256"]),
            int(content["size_bytes"]),
            str(content["kind"]),
            int(content["unpacked_bytes"]),
            str(content["words"]),
        )
        if len(item.sha256) != 64 or not set(item.sha256) <= set("0123456789abcdef"):
            raise ValueError("{!r} is no SHA-256".format(item.sha256[:80]))
        return item


Fetch = Callable[[Item, Path], None]
"""Completes the part of an item, a file that may hold some of it already. It checks size and hash.

For what is made on the node it gets an empty folder, and fills it."""


class Held:
    """An item in use, which nobody removes before :meth:`release` or the end of the process."""

    def __init__(self, path: Path, lock: int) -> None:
        self.path = path
        self._lock = lock

    def release(self) -> None:
        """It may be removed from now on."""
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1


class Cache:
    """The cache of this node.

    Args:
        folder: Made if it is not there. Only one user's runs share it.
        limit_bytes: What all items may take together.
    """

    def __init__(self, folder: Path, limit_bytes: int) -> None:
        self.folder = folder
        self._items = folder / "sha256"
        self._limit_bytes = limit_bytes

    def hold(self, item: Item, fetch: Fetch) -> Held:
        """The item, fetched unless it is there. Others who need it meanwhile wait, and use it.

        Raises CacheFull, OSError, and what ``fetch`` raises.
        """
        path = self._path(item.sha256)
        path.parent.mkdir(parents=True, mode=0o700, exist_ok=True)
        lock = os.open(str(path) + _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            while True:
                if _try_lock(lock, fcntl.LOCK_SH):
                    if _is_there(item, path, lock):
                        os.utime(str(path) + _LOCK)  # by this time, what was not used for longest goes first
                        return Held(path, lock)
                    fcntl.flock(lock, fcntl.LOCK_UN)
                if _try_lock(lock, fcntl.LOCK_EX):
                    if not _is_there(item, path, lock):
                        self._transfer(item, path, lock, fetch)
                    # Between the two locks the item may be removed: so look again.
                    fcntl.flock(lock, fcntl.LOCK_UN)
                    continue
                time.sleep(_PAUSE_S * random.uniform(0.5, 1.5))  # noqa: S311 - no secret
        except BaseException:
            os.close(lock)
            raise

    def used_bytes(self) -> int:
        """Return the room of all items, those that are arriving included."""
        return sum(entry.room_bytes for entry in self._entries())

    def _transfer(self, item: Item, path: Path, lock: int, fetch: Fetch) -> None:
        """Bring the item into its place. Its lock is held alone."""
        part, unpacking = Path(str(path) + _PART), Path(str(path) + _UNPACKING)
        for folder in (unpacking, path):  # a killed process, or a loss of power, may have left a part
            if folder.is_dir():
                _remove_folder(folder)
        self._make_room(item, lock)
        kept_bytes = item.kept_bytes
        try:
            if item.kind == MADE:
                kept_bytes = _make(item, unpacking, fetch)
                os.replace(str(unpacking), str(path))
                return
            fetch(item, part)
            if item.kind == FOLDER:
                unpack_folder(part, unpacking)
                os.replace(str(unpacking), str(path))
                part.unlink()
            else:
                part.chmod(0o444)
                os.replace(str(part), str(path))
        except OSError as error:
            if error.errno not in _FULL:
                raise
            shutil.rmtree(str(unpacking), ignore_errors=True)
            with contextlib.suppress(OSError):
                part.unlink()
            raise CacheFull(self._words(item, "the disk is full")) from None
        finally:
            _write_room(lock, kept_bytes if path.exists() else item.room_bytes if part.exists() else 0)

    def _make_room(self, item: Item, lock: int) -> None:
        """Remove what was not used for longest until there is room, and reserve it. Raises CacheFull.

        One process at a time does so. What it reserves stands in the lock file of the item before the next one counts.
        """
        self.folder.mkdir(parents=True, mode=0o700, exist_ok=True)
        room = os.open(str(self.folder / "room.lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(room, fcntl.LOCK_EX)
            others = sorted(entry for entry in self._entries() if entry.sha256 != item.sha256)
            used_bytes = sum(entry.room_bytes for entry in others)
            try:
                arrived_bytes = Path(str(self._path(item.sha256)) + _PART).stat().st_size
            except OSError:
                arrived_bytes = 0
            for entry in others:
                if self._fits(item, used_bytes, arrived_bytes):
                    break
                if self._evict(entry.sha256):
                    used_bytes -= entry.room_bytes
            if not self._fits(item, used_bytes, arrived_bytes):
                raise CacheFull(self._words(item, "runs use {:.3f} GB".format(used_bytes / 1e9)))
            _write_room(lock, item.room_bytes)
        finally:
            os.close(room)

    def _fits(self, item: Item, used_bytes: int, arrived_bytes: int) -> bool:
        within_limit = used_bytes + item.room_bytes <= self._limit_bytes
        return within_limit and item.room_bytes - arrived_bytes <= self._free_bytes()

    def _free_bytes(self) -> int:
        found = os.statvfs(str(self.folder))
        return found.f_bavail * found.f_frsize

    def _words(self, item: Item, why: str) -> str:
        return (
            "the cache {} of node {} has no room for {}: it needs {:.3f} GB, {}, {:.3f} GB are allowed and the disk "
            "has {:.3f} GB free; raise NODE_CACHE_BYTES or make room on the node"
        ).format(
            self.folder, os.uname().nodename, item.words, item.room_bytes / 1e9, why, self._limit_bytes / 1e9,
            self._free_bytes() / 1e9,
        )  # fmt: skip

    def _evict(self, sha256: str) -> bool:
        """Remove an item, or what has arrived of it; False if it is in use."""
        path = self._path(sha256)
        try:
            lock = os.open(str(path) + _LOCK, os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            return False
        try:
            if not _try_lock(lock, fcntl.LOCK_EX):
                return False
            for left in (path, Path(str(path) + _UNPACKING)):
                if left.is_dir():
                    _remove_folder(left)
            for left in (path, Path(str(path) + _PART)):
                with contextlib.suppress(FileNotFoundError):
                    left.unlink()
            # Its lock file stays: somebody may be waiting for it, and it takes nothing.
            _write_room(lock, 0)
        finally:
            os.close(lock)
        return True

    def _entries(self) -> Iterator[_Entry]:
        for path in self._items.glob("*/*" + _LOCK):
            try:
                room_bytes = int(path.read_text(encoding="ascii") or 0)
                used_at_ns = path.stat().st_mtime_ns
            except (OSError, ValueError):
                continue
            if room_bytes:
                yield _Entry(used_at_ns, path.name[: -len(_LOCK)], room_bytes)

    def _path(self, sha256: str) -> Path:
        return self._items / sha256[:2] / sha256


class _Entry(NamedTuple):
    used_at_ns: int
    sha256: str
    room_bytes: int


def sha256_of(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal digits. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        for piece in iter(lambda: stream.read(1 << 20), b""):
            digest.update(piece)
    return digest.hexdigest()


def unpack_folder(archive: Path, folder: Path) -> None:
    """Unpack an archive of the controller. All files belong to whoever unpacks them. Raises OSError, TarError."""
    folder.mkdir()
    with tarfile.open(str(archive)) as opened:
        members = opened.getmembers()
        for member in members:
            if member.name.startswith("/") or ".." in member.name.split("/"):
                raise tarfile.TarError("the archive names {!r}, which is outside of its folder".format(member.name))
            member.uid, member.gid, member.uname, member.gname = os.getuid(), os.getgid(), "", ""
        # Images hold links to absolute paths, which newer versions of Python refuse by default.
        trust = {"filter": "fully_trusted"} if hasattr(tarfile, "fully_trusted_filter") else {}  # type: Dict[str, Any]
        opened.extractall(str(folder), members=members, **trust)  # noqa: S202 - the hash was checked


def _make(item: Item, folder: Path, make: Fetch) -> int:
    """Make the item in ``folder``; what it takes (bytes). Nothing stays of what could not be made."""
    folder.mkdir(mode=0o700)
    try:
        make(item, folder)
        return folder_bytes(folder)
    except BaseException:
        shutil.rmtree(str(folder), ignore_errors=True)
        raise


def _remove_folder(folder: Path) -> None:
    """Remove a folder of an item, whatever rights its folders have."""
    for root, _, _ in os.walk(str(folder)):
        with contextlib.suppress(OSError):
            os.chmod(root, 0o700)
    shutil.rmtree(str(folder), ignore_errors=True)


def _is_there(item: Item, path: Path, lock: int) -> bool:
    """Return whether the item is there, and not a folder that a kubelet made because a pod was to see the item."""
    if item.kind == FILE:
        return path.is_file()
    return path.is_dir() and (os.pread(lock, 32, 0) not in (b"", b"0") or not item.kept_bytes)


def _write_room(lock: int, room_bytes: int) -> None:
    os.ftruncate(lock, 0)
    os.pwrite(lock, str(room_bytes).encode(), 0)


def _try_lock(descriptor: int, kind: int) -> bool:
    try:
        fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in (errno.EWOULDBLOCK, errno.EAGAIN):
            raise
        return False
    return True


def hold_all(cache: Cache, items: Dict[str, Item], fetch: Fetch, held: Optional[List[Held]] = None) -> Dict[str, Path]:
    """The paths of all ``items``, by name. What is in ``held`` in the end has to be released, also after an error."""
    found = {}
    kept = [] if held is None else held
    for name, item in items.items():
        kept.append(cache.hold(item, fetch))
        found[name] = kept[-1].path
    return found
