"""Packs what a run has written. Nodes import this module, so it needs Python 3.7 and its standard library alone."""

from __future__ import annotations

import io
import os
import tarfile
from pathlib import Path
from typing import IO, Collection, Optional

from slamhive.base.tree import walk

MOST_LIVE_BYTES = 100_000_000
PLAIN_FILE, PLAIN_FOLDER = 0o644, 0o755


class Bounds:
    """The most that is taken over of an output; None for no bound. What would exceed it is left out."""

    def __init__(self, max_bytes: Optional[int] = None, max_files: Optional[int] = None) -> None:
        self._bytes_left, self._files_left = max_bytes, max_files

    def take(self, size_bytes: int) -> bool:
        """Return whether one more file or folder of this size is taken."""
        if self._files_left is not None and self._files_left < 1:
            return False
        if self._bytes_left is not None:
            if size_bytes > self._bytes_left:
                return False
            self._bytes_left -= size_bytes
        if self._files_left is not None:
            self._files_left -= 1
        return True


def pack_folder(folder: Path, stream: IO[bytes], only: Optional[Collection[str]] = None) -> None:
    """Write an archive of the plain files and folders below ``folder``; no link is followed.

    Files that cannot be read are left out. Wanted files may change meanwhile, so each is read as a whole.

    Args:
        folder: An output of a run on this machine.
        stream: The archive.
        only: The names of the files in ``folder`` that are wanted; None for all of it.
    """
    with tarfile.open(fileobj=stream, mode="w|") as archive:
        add_folder(archive, folder, "", Bounds(), only)


def add_folder(
    archive: tarfile.TarFile, folder: Path, below: str, bounds: Bounds, only: Optional[Collection[str]] = None
) -> None:
    """Add to an archive what :func:`pack_folder` packs, with names that begin with ``below``."""
    for entry in walk(folder):
        info = tarfile.TarInfo(below + entry.place)
        info.mtime = int(entry.status.st_mtime)
        if entry.is_folder and only is None:
            info.type, info.mode = tarfile.DIRTYPE, PLAIN_FOLDER
            if bounds.take(0):
                archive.addfile(info)
        elif entry.is_file and (only is None or entry.place in only):
            try:
                flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
                descriptor = os.open(entry.name, flags, dir_fd=entry.folder)
            except OSError:
                continue
            with os.fdopen(descriptor, "rb") as content:
                # What was asked for by name is small, and may be replaced while it is read.
                source = content if only is None else io.BytesIO(content.read(MOST_LIVE_BYTES))  # type: IO[bytes]
                info.size = source.seek(0, os.SEEK_END)
                source.seek(0)
                if bounds.take(info.size):
                    archive.addfile(info, source)
