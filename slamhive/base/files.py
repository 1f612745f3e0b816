"""Writing a file so that nobody ever sees a part of it, and telling whether files changed.

A file that is being written has its own name, and its writer holds a lock. The kernel releases the lock when the
process dies. So a cleanup can distinguish what a killed process left from what is still being written.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.base.errors import SlamHiveError, Unavailable

_ASIDE = re.compile(r"\.(.+)\.[a-z0-9_]{8}")

_CLUTTER = ("thumbs.db", "desktop.ini", "__macosx")

TEMPORARY = ".slamhive-"
"""How the names of temporary folders begin."""


def write_aside(path: Path, content: str | bytes, mode: int = 0o644) -> None:
    """Write next to ``path``, flush to disk, rename onto it: a reader sees the old or the new, never a part.

    Raises Unavailable, with nothing left behind, if the disk is full or read-only.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary: str | None = None
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as stream:
            fcntl.flock(stream, fcntl.LOCK_EX)
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
            os.fchmod(stream.fileno(), mode)
            Path(temporary).replace(path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise Unavailable(f"{path} cannot be written: {error.strerror}", remedy_of(error)) from None


def visible_files(folder: Path, pattern: str = "*") -> list[Path]:
    """Entries of ``folder`` that match, sorted, without clutter; nothing if there is no such folder."""
    return sorted(path for path in folder.glob(pattern) if not is_clutter(path))


def is_clutter(path: Path) -> bool:
    """Return whether a file or folder is hidden, or was written by a file manager: ``.DS_Store``, ``Thumbs.db``.

    macOS copies ``._NAME`` beside each NAME to file systems and archives of others. It holds attributes, no content.
    """
    return path.name.startswith(".") or path.name.lower() in _CLUTTER


def sweep_asides(folder: Path) -> None:
    """Remove what killed writers of files in ``folder`` have left."""
    try:
        left = [entry.path for entry in os.scandir(folder) if _ASIDE.fullmatch(entry.name) and entry.is_file()]
    except (FileNotFoundError, NotADirectoryError):
        return
    for path in map(Path, left):
        with _unheld(path) as free:
            if free:
                path.unlink(missing_ok=True)


@contextmanager
def held_folder(path: Path) -> Iterator[Path]:
    """An empty folder at ``path``, held by this process during the block; it stays after. Raises OSError."""
    while True:
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True, exist_ok=True)
        with _held(path) as held:
            if held:
                yield path
                return


def sweep_folder(path: Path) -> None:
    """Remove a folder unless a process holds it."""
    with _unheld(path) as free:
        if free:
            shutil.rmtree(path, ignore_errors=True)


@contextmanager
def temporary_folder(prefix: str = TEMPORARY, root: Path | None = None) -> Iterator[Path]:
    """A folder of this process, gone after the block; a killed process leaves it to whoever sweeps.

    It lies below ``root``, or, with None, where the system keeps temporary files.
    """
    while True:
        with (
            tempfile.TemporaryDirectory(prefix=prefix, dir=root, ignore_cleanup_errors=True) as name,
            _held(Path(name)) as held,
        ):
            if held:
                yield Path(name)
                return


def sweep_temporary() -> None:
    """Remove temporary folders that killed processes of this user have left."""
    for path in Path(tempfile.gettempdir()).glob(f"{TEMPORARY}*"):
        with contextlib.suppress(OSError):
            found = path.lstat()
            if stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid():
                sweep_folder(path)


@contextmanager
def _held(folder: Path) -> Iterator[bool]:
    """Hold ``folder`` during the block; False if another process swept it before it was held."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        yield False
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield folder.is_dir() and os.path.samestat(os.fstat(descriptor), folder.stat())
    finally:
        os.close(descriptor)


@contextmanager
def exclusive_lock(descriptor: int, refused: SlamHiveError) -> Iterator[None]:
    """Lock an open file for the block, and close it; raises ``refused`` if another process holds the lock.

    The kernel releases the lock of a process that dies.
    """
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise refused from None
        yield
    finally:
        os.close(descriptor)


@contextmanager
def _unheld(path: Path) -> Iterator[bool]:
    """Tell if no process holds the file or folder; nobody can take it during the block."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
    except OSError:
        yield False
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        yield False
    else:
        yield True
    finally:
        os.close(descriptor)


def make_shared_folder(path: Path) -> None:
    """Make ``path``, open to the same group as the folder around it; fine if it is there. Raises OSError.

    A web server and a worker that run as different users share a folder through its group.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.mkdir()
    except FileExistsError:
        return
    share_with_group(path)


def share_with_group(path: Path) -> None:
    """Open the folder at ``path`` to the same group as the folder around it. Raises OSError."""
    around = path.parent.stat().st_mode
    if around & stat.S_IWGRP:
        path.chmod(stat.S_IMODE(path.stat().st_mode) | stat.S_IWGRP | (around & stat.S_ISGID))


def is_full(error: BaseException) -> bool:
    """Tell if ``error``, or what caused it, says that a disk or a quota is full."""
    cause = error if isinstance(error, OSError) else error.__context__
    return isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT)


def remedy_of(error: OSError) -> str:
    """Remedy for a file or folder that could not be written."""
    if error.errno == errno.EROFS:
        return "the data root is read-only here; use the command line where the worker runs"
    return "check space and rights"


def size_bytes(path: Path) -> int:
    """The size of a file, or of all files in a folder; 0 for what does not exist."""
    if path.is_dir():
        return sum(entry.stat().st_size for entry in path.rglob("*") if entry.is_file())
    return path.stat().st_size if path.exists() else 0


def hash_files(root: Path, parts: Iterable[str] = (".",)) -> str:
    """SHA-256 (``sha256:<hex>``) over the names and contents of the files and folders ``parts`` below ``root``.

    What Python compiles on the way is left out.
    """
    digest = hashlib.sha256()
    for part in parts:
        path = root / part
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and "__pycache__" not in file.parts:
                digest.update(f"{file.relative_to(root)}\0".encode())
                with file.open("rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())
    return f"sha256:{digest.hexdigest()}"


# Paths in messages that leave the machine: relative to the data root, or to the archive that somebody has sent.
#
# Commands name files by their whole path. Who asks a server must not learn where it keeps them.


_UNPACKED = re.compile(rf"(?<![\w./-])\S*?{re.escape(TEMPORARY)}[A-Za-z0-9_]+(?:/unpacked/[^/\s]+)?(/|\b)")
"""A temporary folder, in which a request unpacks what it has brought."""


def relative_paths(data: Path, project: Path | None = None) -> Callable[[str], str]:
    """A function that makes paths in a text relative: below the data root, the project, or the temporary folder.

    The data root itself becomes ``the data root``.
    """
    places = {"the data root": data, "the project": project, "temporary files": Path(tempfile.gettempdir())}
    roots = {
        str(place): name
        for name, path in places.items()
        if path is not None
        for place in (path.absolute(), path.resolve())
        if len(place.parts) > 1
    }
    longest_first = sorted(roots, key=len, reverse=True)
    pattern = re.compile(rf"(?<![\w./-])({'|'.join(map(re.escape, longest_first))})(?:(/)(?=[\w.<{{])|(?![\w.-]))")

    def change(text: str) -> str:
        inside = _UNPACKED.sub("", text)
        return pattern.sub(lambda found: "" if found[2] else roots[found[1]], inside)

    return change
