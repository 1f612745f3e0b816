"""Unpacks archives from outside into a folder: nothing leaves the folder, nothing but files, no more than allowed."""

from __future__ import annotations

import errno
import lzma
import os
import struct
import tarfile
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path, PurePosixPath
from typing import IO

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.base.files import remedy_of
from slamhive.domain.collection import FileKind

# Reads archives from outside, member by member: zip, and tar with any compression of Python's tarfile.


_DAMAGE = {None, errno.EINVAL}
"""bzip2 raises OSError without a number; a place outside the file makes zipfile seek to a negative one."""
_LONGEST_HEADER = 1_000_000
_UNIX = 3
_TYPE_BITS = 0o170000
_ZIP_KINDS = {0: "file", 0o100000: "file", 0o040000: "folder", 0o120000: "link"}
_END = struct.Struct("<4s4H2LH")
_END64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR = struct.Struct("<4sLQL")
_LONGEST_COMMENT = 1 << 16
_LONG_HEADERS = {tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK}


class MemberKind(StrEnum):
    """Kind of an archive's member. Only files and folders are unpacked."""

    FILE = "file"
    FOLDER = "folder"
    LINK = "link"
    DEVICE = "device"


@dataclass(frozen=True, slots=True)
class Member:
    """A member of an archive. ``content`` is None unless it is a file; it can be read until the next member."""

    name: str
    kind: MemberKind
    content: IO[bytes] | None


def members(path: Path, kind: FileKind) -> Iterator[Member]:
    """The members of an archive in its order; raises InvalidInput if it is damaged, encrypted or of another kind."""
    if kind is FileKind.ZIP:
        with zipfile.ZipFile(path) as archive:
            for info in archive.infolist():
                # Only archives that were made on Unix hold the kind of a file.
                mode = (info.external_attr >> 16) & _TYPE_BITS if info.create_system == _UNIX else 0
                found = MemberKind.FOLDER if info.is_dir() else MemberKind(_ZIP_KINDS.get(mode, "device"))
                if info.flag_bits & 1:
                    raise InvalidInput(f"{path.name} is encrypted", "unpack it by hand")
                if found is not MemberKind.FILE:
                    yield Member(info.filename, found, None)
                    continue
                with archive.open(info) as content:
                    yield Member(info.filename, found, content)
    elif kind is FileKind.TAR:
        yield from _tar_members(path)
    else:
        raise InvalidInput(f"{path.name} is a {kind} file, which SLAM Hive does not unpack", "unpack it by hand")


def zip_directory_bytes(stream: IO[bytes]) -> int | None:
    """The size of the list of members of a zip file, as its end states it; None if it has no end.

    :mod:`zipfile` holds all of the list in memory, some ten times as large.
    """
    length = stream.seek(0, os.SEEK_END)
    start = max(0, length - _LONGEST_COMMENT - _END.size - _LOCATOR.size)
    stream.seek(start)
    tail = stream.read()
    stream.seek(0)
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or len(tail) - place < _END.size:
        return None
    size: int = _END.unpack_from(tail, place)[5]
    if size == 0xFFFFFFFF and place >= _LOCATOR.size:
        signature, _, offset, _ = _LOCATOR.unpack_from(tail, place - _LOCATOR.size)
        stream.seek(min(offset, length) if signature == b"PK\x06\x07" else length)
        record = stream.read(_END64.size)
        stream.seek(0)
        size = _END64.unpack(record)[8] if len(record) == _END64.size else length
    return size


@contextmanager
def damage_explained(path: Path) -> Iterator[None]:
    """Turn what the libraries raise for a damaged archive during the block into InvalidInput."""
    try:
        yield
    except (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, struct.error) as error:
        raise InvalidInput(f"{path.name} is damaged: {error}", "download it again") from None
    except NotImplementedError as error:
        raise InvalidInput(f"{path.name} cannot be unpacked: {error}", "unpack it by hand") from None
    except OSError as error:
        if error.errno not in _DAMAGE:
            raise
        raise InvalidInput(f"{path.name} is damaged: {error.strerror or error}", "download it again") from None


def _tar_members(path: Path) -> Iterator[Member]:
    ended = False

    class Header(tarfile.TarInfo):
        """A header of bounded size; tarfile itself takes a tar file that was cut off for a complete one."""

        @classmethod
        def frombuf(cls, buf: bytes | bytearray, encoding: str, errors: str) -> Header:
            nonlocal ended
            ended = len(buf) == tarfile.BLOCKSIZE and not any(buf)
            found = super().frombuf(buf, encoding, errors)
            if found.type in _LONG_HEADERS and found.size > _LONGEST_HEADER:
                raise InvalidInput(f"{path.name} has a header of {found.size:,} bytes", "it is no archive of a dataset")
            return found

    with tarfile.open(path, "r|*", tarinfo=Header) as archive:
        for info in archive:
            if info.isreg():
                kind = MemberKind.FILE
            elif info.isdir():
                kind = MemberKind.FOLDER
            else:
                kind = MemberKind.LINK if info.issym() or info.islnk() else MemberKind.DEVICE
            yield Member(info.name, kind, archive.extractfile(info) if info.isreg() else None)
            archive.members = []  # type: ignore[attr-defined] # tarfile keeps all of them, which may be millions
    if not ended:
        raise InvalidInput(f"{path.name} is damaged: it ends early", "download it again")


_PIECE_BYTES = 1024 * 1024
_LONGEST_NAME_BYTES = 255
_DEEPEST = 30
_DIRECTORY_BYTES = 100_000
_ENTRY_BYTES = 400
"""Most of an entry in the list of members, which has name, extra field and comment: a few long names do not count."""


@dataclass(frozen=True, slots=True)
class UnpackLimits:
    """Limits of an unpacked archive: recordings shrink to a third at best, bombs to a thousandth."""

    ratio: float = 100.0
    always_bytes: int = 200_000_000
    total_bytes: int = 2_000_000_000_000
    files: int = 1_000_000

    def bytes_of(self, packed_bytes: int) -> int:
        """Bytes that may come out of an archive of ``packed_bytes``."""
        return min(self.total_bytes, max(int(self.ratio * packed_bytes), self.always_bytes))


@dataclass(frozen=True, slots=True)
class MemberChoice:
    """Part to take out of an archive: file or folder ``take`` (empty: all) becomes ``to`` (empty: the folder)."""

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
    choice: MemberChoice = MemberChoice(),
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
        """Number of files that were written."""
        return len(self._own)

    def check_directory(self) -> None:
        """Refuse a zip file that lists more members than are allowed, before the list is in memory."""
        with self._archive.open("rb") as stream:
            size = zip_directory_bytes(stream) or 0
        if size > _ENTRY_BYTES * self._most_files + _DIRECTORY_BYTES:
            raise self._refusal(f"more than {self._most_files:,} files")

    def add(self, member: Member, choice: MemberChoice) -> None:
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
