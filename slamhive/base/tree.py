"""Folders with whatever somebody has put into them: walked, measured and removed without trusting what is there.

Nodes import this module, so it needs Python 3.7 and its standard library alone.
"""

from __future__ import annotations

import os
import stat
import tarfile
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Iterator, Tuple

DEEPEST_FOLDERS = 64
"""How many folders inside each other are walked; nothing of ours, and no algorithm that means well, comes near."""

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_OWNER_ONLY = 0o700


def unpack_trusted(archive: tarfile.TarFile, folder: Path) -> None:
    """Unpack an archive of ours below ``folder``. Raises OSError, tarfile.TarError.

    Names that lead out of the folder are refused. Older versions of Python take all names, and 3.11.2 of Debian 12 is
    such a version.
    """
    options: Any = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
    archive.extractall(folder, **options)  # noqa: S202 - ours


@dataclass(frozen=True)
class FolderEntry:
    """Something in a folder that is being walked.

    Attributes:
        place: Its path below the root, names parted by ``/``; bytes that are no UTF-8 as Python escapes them.
        name: Its name.
        status: What ``lstat`` says of it.
        folder: Descriptor of the folder that it is in, open until the walk goes on.
        entered: It is a folder, and the walk goes on inside.
    """

    place: str
    name: str
    status: os.stat_result
    folder: int
    entered: bool

    @property
    def is_folder(self) -> bool:
        """A folder, and no link to one."""
        return stat.S_ISDIR(self.status.st_mode)

    @property
    def is_file(self) -> bool:
        """A regular file, and no link to one."""
        return stat.S_ISREG(self.status.st_mode)


def walk(root: Path) -> Iterator[FolderEntry]:
    """Everything below ``root``, a folder before what is in it; no link is followed, in whatever place it is put.

    Others may write or remove there meanwhile. Folders deeper than :data:`DEEPEST_FOLDERS`, or closed to us, are not
    entered. Nothing if ``root`` is no folder. ``os.walk`` calls itself for each level, and its paths have an end.
    """
    levels = _open_level(root, "")
    try:
        while levels:
            place, descriptor, entries = levels[-1]
            found = next(entries, None)
            if found is None:
                _close(levels.pop())
                continue
            try:
                status = found.stat(follow_symlinks=False)
            except OSError:
                continue
            inside: list[_Level] = []
            if stat.S_ISDIR(status.st_mode) and len(levels) < DEEPEST_FOLDERS:
                inside = _open_level(found.name, f"{place}{found.name}/", descriptor)
            levels += inside
            yield FolderEntry(place + found.name, found.name, status, descriptor, bool(inside))
    finally:
        for level in levels:
            _close(level)


_Level = Tuple[str, int, Any]
"""A folder that is being walked: what the places in it begin with, descriptor, entries that are left."""


def _open_level(path: Path | str, place: str, parent: int | None = None) -> list[_Level]:
    """The level, or nothing if there is no folder that can be opened."""
    try:
        descriptor = os.open(path, _FOLDER, dir_fd=parent)
    except OSError:
        return []
    return [(place, descriptor, os.scandir(descriptor))]


def _close(level: _Level) -> None:
    level[2].close()
    os.close(level[1])


def folder_bytes(folder: Path) -> int:
    """The size of all files below ``folder``, links not followed; others may write or remove there meanwhile."""
    return sum(entry.status.st_size for entry in walk(folder) if not entry.is_folder)


def remove_tree(path: Path) -> None:
    """Remove the folder at ``path`` with all that is in it; fine if there is none. Raises OSError.

    For folders of others: however deep they are, whatever their names are, and if their rights forbid it. Each folder
    inside is moved to the top before it is emptied, so that neither depth nor length of a path counts.
    """
    try:
        _unlock(path, None)
    except FileNotFoundError:
        return
    top = os.open(path, _FOLDER)
    try:
        _empty(top)
    finally:
        os.close(top)
    path.rmdir()


def _empty(top: int) -> None:
    """Remove all that is in the folder ``top``."""
    folders = _remove_files(top, None)
    while folders:
        for name in folders:
            _unlock(name, top)
            inside = os.open(name, _FOLDER, dir_fd=top)
            try:
                _remove_files(inside, top)
            finally:
                os.close(inside)
            os.rmdir(name, dir_fd=top)
        folders = _remove_files(top, None)


def _remove_files(folder: int, move_to: int | None) -> list[str]:
    """Remove the files in ``folder``; its folders are moved to ``move_to``, or returned."""
    folders = []
    with os.scandir(folder) as entries:
        names = [(entry.name, entry.is_dir(follow_symlinks=False)) for entry in entries]
    for name, is_folder in names:
        if not is_folder:
            os.unlink(name, dir_fd=folder)
        elif move_to is None:
            folders.append(name)
        else:
            _unlock(name, folder)
            os.rename(name, uuid.uuid4().hex, src_dir_fd=folder, dst_dir_fd=move_to)
    return folders


def _unlock(name: Path | str, folder: int | None) -> None:
    """Give ourselves all rights on a folder; a link in its place is not followed."""
    descriptor = os.open(name, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=folder)
    try:
        os.chmod(f"/proc/self/fd/{descriptor}", _OWNER_ONLY)  # noqa: PTH101 - chmod takes no such descriptor
    finally:
        os.close(descriptor)
