"""Unpacks archives from outside into a folder: nothing leaves the folder, nothing but files, no more than allowed."""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from slamhive.domain.collection import FileKind
from slamhive.errors import InvalidInput, Unavailable
from slamhive.fetch.archive import Member, MemberKind, damage_explained, members, zip_directory_bytes
from slamhive.files import remedy_of

_PIECE_BYTES = 1024 * 1024
_LONGEST_NAME_BYTES = 255
_DEEPEST = 30
_DIRECTORY_BYTES = 100_000
_ENTRY_BYTES = 400
"""Most of an entry in the list of members, which has name, extra field and comment: a few long names do not count."""


@dataclass(frozen=True, slots=True)
class UnpackLimits:
    """What an archive may become: recordings shrink to a third at best, bombs to a thousandth."""

    ratio: float = 100.0
    always_bytes: int = 200_000_000
    total_bytes: int = 2_000_000_000_000
    files: int = 1_000_000

    def bytes_of(self, packed_bytes: int) -> int:
        """How much may come out of an archive of ``packed_bytes``."""
        return min(self.total_bytes, max(int(self.ratio * packed_bytes), self.always_bytes))


@dataclass(frozen=True, slots=True)
class Choice:
    """What to take out of an archive: the file or folder ``take`` (empty: all) becomes ``to`` (empty: the folder)."""

    take: str = ""
    to: str = ""

    def place_of(self, name: PurePosixPath) -> PurePosixPath | None:
        """Where a member goes, None if it is not wanted."""
        wanted = PurePosixPath(self.take)
        if not name.is_relative_to(wanted):
            return None
        inside = name.relative_to(wanted)
        if self.take and not inside.parts and not self.to:
            return PurePosixPath(name.name)
        return PurePosixPath(self.to) / inside


Room = Callable[[int], None]
"""Called before a piece is written, with its bytes; whoever has no room for them raises."""


def unpack(
    archive: Path,
    kind: FileKind,
    folder: Path,
    choice: Choice = Choice(),
    limits: UnpackLimits = UnpackLimits(),
    room: Room = lambda _bytes: None,
) -> int:
    """Unpack the chosen members of ``archive`` into ``folder``; they replace files of other archives.

    Returns:
        The number of files.

    Raises:
        InvalidInput: the archive is damaged or hostile; the message names the member.
        Unavailable: the disk refuses.
    """
    writer = _Writer(archive, folder, limits, room)
    try:
        with damage_explained(archive):
            if kind is FileKind.ZIP:
                writer.check_directory()
            for member in members(archive, kind):
                writer.add(member, choice)
    except OSError as error:
        raise Unavailable(f"{folder} cannot be written: {error.strerror}", remedy_of(error)) from None
    return writer.files


class _Writer:
    def __init__(self, archive: Path, folder: Path, limits: UnpackLimits, room: Room) -> None:
        self._archive = archive
        self._folder = folder
        self._room = room
        self._most_files = limits.files
        self._left_bytes = limits.bytes_of(archive.stat().st_size)
        self._written_bytes = 0
        self._own: set[Path] = set()

    @property
    def files(self) -> int:
        """How many files were written."""
        return len(self._own)

    def check_directory(self) -> None:
        """Refuse a zip file that lists more members than are allowed, before the list is in memory."""
        with self._archive.open("rb") as stream:
            size = zip_directory_bytes(stream) or 0
        if size > _ENTRY_BYTES * self._most_files + _DIRECTORY_BYTES:
            raise self._refusal(f"more than {self._most_files:,} files")

    def add(self, member: Member, choice: Choice) -> None:
        """Write a member, if it is wanted."""
        name = safe_path(member.name, self._archive.name)
        place = choice.place_of(name)
        if place is None or (member.kind is MemberKind.FOLDER and name == PurePosixPath(choice.take)):
            return
        if member.kind in {MemberKind.LINK, MemberKind.DEVICE}:
            raise self._refusal(f"{member.name!r}, which is a {member.kind}")
        try:
            if member.kind is MemberKind.FOLDER:
                (self._folder / place).mkdir(parents=True, exist_ok=True)
            else:
                self._write(member, self._folder / place)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise self._refusal(f"{member.name!r} twice") from None

    def _write(self, member: Member, path: Path) -> None:
        if path in self._own:
            raise FileExistsError
        if self.files >= self._most_files:
            raise self._refusal(f"more than {self._most_files:,} files")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)  # of another archive: collections repeat small files in each
        self._own.add(path)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644)
        assert member.content is not None
        with os.fdopen(descriptor, "wb") as stream:
            while piece := member.content.read(_PIECE_BYTES):
                self._written_bytes += len(piece)
                if self._written_bytes > self._left_bytes:
                    raise self._refusal(f"more than {self._left_bytes / 1e6:,.0f} MB: it looks like a bomb")
                self._room(len(piece))
                stream.write(piece)

    def _refusal(self, what: str) -> InvalidInput:
        return InvalidInput(f"{self._archive.name} is not unpacked: it holds {what}", "it is no archive of a dataset")


def safe_path(name: str, archive: str) -> PurePosixPath:
    """``name`` as a path below any folder; raises InvalidInput for one that could leave it or cannot be shown."""
    path = PurePosixPath(name)
    strange = "\\" in name or any(unicodedata.category(character) in {"Cc", "Cs"} for character in name)
    outside = path.is_absolute() or ".." in path.parts or (len(name) > 1 and name[1] == ":")
    long = len(path.parts) > _DEEPEST or any(len(os.fsencode(part)) > _LONGEST_NAME_BYTES for part in path.parts)
    if strange or outside or long or not name:
        why = "leads out of the folder" if outside else "is too long" if long else "is no name of a file"
        raise InvalidInput(
            f"{archive} is not unpacked: the path {name[:200]!r} in it {why}", "it is no archive of a dataset"
        )
    return path
