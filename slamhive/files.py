"""Writing a file so that nobody ever sees a part of it, and telling whether files changed."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import tempfile
from collections.abc import Iterable
from pathlib import Path

from slamhive.errors import Unavailable


def write_aside(path: Path, content: str | bytes) -> None:
    """Write next to ``path``, flush to disk, rename onto it: a reader sees the old or the new, never a part.

    Raises Unavailable, with nothing left behind, if the disk is full or read-only.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary: str | None = None
    try:
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except OSError as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        raise Unavailable(f"{path} cannot be written: {error.strerror}", remedy_of(error)) from None


def make_shared_folder(path: Path) -> None:
    """Make ``path``, open to the same group as the folder around it; fine if it is there. Raises OSError.

    A web server and a worker that run as different users share a folder through its group.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        path.mkdir()
    except FileExistsError:
        return
    around = path.parent.stat().st_mode
    if around & stat.S_IWGRP:
        path.chmod(stat.S_IMODE(path.stat().st_mode) | stat.S_IWGRP | (around & stat.S_ISGID))


def remedy_of(error: OSError) -> str:
    """What to do about a file or folder that could not be written."""
    if error.errno == errno.EROFS:
        return "the data root is read-only here; use the command line where the worker runs"
    return "check space and rights"


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
                digest.update(hashlib.sha256(file.read_bytes()).digest())
    return f"sha256:{digest.hexdigest()}"
