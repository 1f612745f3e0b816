"""Reads a folder of somebody else: bounded, without following links, and without running anything."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import remedy_of
from slamhive.base.tree import FolderEntry, walk

SCRIPTS = "slamhive"
MAPPING = "mapping.py"
DOCKERFILE = "Dockerfile"
IMAGE_ARCHIVE = "image.tar"

MOST_TEXT_BYTES = 1_000_000
"""A larger file is copied, but not read for the draft."""
MOST_FILES = 5000
MOST_BYTES = 1_000_000_000
_TEXTS = (".py", ".yaml", ".yml", ".launch", ".xml", ".sh", ".bash", ".txt", ".md")
_SHOWN = 5
_OPEN = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


@dataclass(frozen=True, slots=True)
class ForeignFolder:
    """Text that was read from an algorithm folder.

    Attributes:
        path: The folder.
        scripts: The text files in ``slamhive/``, by their path in it.
        dockerfile: The text of the ``Dockerfile``; None if there is none.
        licence: The text of the licence file; None if there is none.
        notes: What was left out, in words.
    """

    path: Path
    scripts: Mapping[str, str]
    dockerfile: str | None = None
    licence: str | None = None
    notes: tuple[str, ...] = ()

    @property
    def archive(self) -> Path | None:
        """The saved image that published clusters keep in the folder; None if there is none."""
        path = self.path / IMAGE_ARCHIVE
        return path if path.is_file() and not path.is_symlink() else None


def read_folder(path: Path) -> ForeignFolder:
    """Read the algorithm folder at ``path``. Raises InvalidInput if it is none, or holds too much."""
    scripts: dict[str, str] = {}
    left_out: list[str] = []
    for entry in _bounded(path / SCRIPTS):
        if entry.is_file:
            text = _text(entry) if entry.name.lower().endswith(_TEXTS) else None
            scripts.update({} if text is None else {entry.place: text})
        elif not entry.is_folder:
            left_out.append(entry.place)
    if MAPPING not in scripts:
        raise InvalidInput(
            f"{path} holds no {SCRIPTS}/{MAPPING} that can be read",
            "name the folder that holds the Dockerfile and slamhive/",
        )
    names = ("LICENSE", "LICENCE", "LICENSE.txt", "LICENSE.md", "COPYING")
    licence = next((text for name in names if (text := _plain_text(path / name)) is not None), None)
    notes = (f"not copied, since they are no plain files: {_few(left_out)}",) if left_out else ()
    return ForeignFolder(path, scripts, _plain_text(path / DOCKERFILE), licence, notes)


def looks_foreign(path: Path) -> bool:
    """Tell if ``path`` is an algorithm folder by its layout: ``slamhive/mapping.py``, read by nobody."""
    return (path / SCRIPTS / MAPPING).is_file()


def copy_scripts(source: Path, target: Path) -> None:
    """Copy the plain files of ``source``/slamhive to a new folder ``target``. Raises InvalidInput, Unavailable."""
    copy_plain_files(source / SCRIPTS, target)


def copy_plain_files(source: Path, target: Path) -> tuple[str, ...]:
    """Copy what is in ``source`` to a new folder ``target``; in words what is left out, since it is no plain file.

    Neither compiled Python nor the history of Git is copied. Raises InvalidInput, Unavailable.
    """
    left_out: list[str] = []
    try:
        target.mkdir(parents=True)
        for entry in _bounded(source):
            place = target / entry.place
            if entry.is_folder and entry.entered:
                place.mkdir(exist_ok=True)
            elif entry.is_file:
                _copy(entry, place)
            else:
                left_out.append(entry.place)
    except OSError as error:
        raise Unavailable(f"{target} cannot be written: {error.strerror}", remedy_of(error)) from None
    return (f"not copied, since they are no plain files: {_few(left_out)}",) if left_out else ()


def _bounded(folder: Path) -> Iterator[FolderEntry]:
    files = size_bytes = 0
    for entry in walk(folder):
        if not {"__pycache__", ".git"}.isdisjoint(entry.place.split("/")):
            continue
        files += 1
        size_bytes += entry.status.st_size if entry.is_file else 0
        if files > MOST_FILES or size_bytes > MOST_BYTES:
            raise InvalidInput(
                f"{folder} holds more than {MOST_FILES} files or {MOST_BYTES // 1_000_000} MB",
                "each run gets a copy of its scripts; move data into the image",
            )
        yield entry


def _open(entry: FolderEntry) -> int | None:
    """A descriptor of a file that is being walked; None if it cannot be read, or is another file by now."""
    try:
        descriptor = os.open(entry.name, _OPEN, dir_fd=entry.folder)
    except OSError:
        return None
    if stat.S_ISREG(os.fstat(descriptor).st_mode):
        return descriptor
    os.close(descriptor)
    return None


def _text(entry: FolderEntry) -> str | None:
    descriptor = _open(entry)
    if descriptor is None:
        return None
    with os.fdopen(descriptor, "rb") as stream:
        return _decoded(stream.read(MOST_TEXT_BYTES + 1))


def _copy(entry: FolderEntry, target: Path) -> None:
    descriptor = _open(entry)
    if descriptor is None:
        raise InvalidInput(f"{entry.place} cannot be read", "correct its rights")
    with os.fdopen(descriptor, "rb") as reader, target.open("xb") as writer:
        while block := reader.read(1_000_000):
            writer.write(block)
    target.chmod(0o755 if entry.status.st_mode & stat.S_IXUSR else 0o644)


def _plain_text(path: Path) -> str | None:
    try:
        descriptor = os.open(path, _OPEN)
    except OSError:
        return None
    with os.fdopen(descriptor, "rb") as stream:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            return None
        return _decoded(stream.read(MOST_TEXT_BYTES + 1))


def _decoded(data: bytes) -> str | None:
    """Comments may be in any encoding. What is too long, or no text, is left out."""
    if len(data) > MOST_TEXT_BYTES or b"\0" in data:
        return None
    return data.decode("utf-8-sig", errors="replace")


def _few(places: list[str]) -> str:
    more = f" and {len(places) - _SHOWN} more" if len(places) > _SHOWN else ""
    return ", ".join(sorted(places)[:_SHOWN]) + more
