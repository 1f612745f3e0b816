"""Reading an archive that nobody vouches for: checked as a whole before anything of it is used."""

from __future__ import annotations

import hashlib
import os
import re
import stat
import struct
import zipfile
import zlib
from calendar import timegm
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO, Any

from slamhive.errors import InvalidInput, NotFound, Unavailable
from slamhive.input_bounds import parse_json_object
from slamhive.services.archive.layout import (
    CHECKSUMS,
    LARGEST_DIRECTORY_BYTES,
    LARGEST_RATIO,
    LARGEST_TEXT_BYTES,
    MANIFEST,
    ROWS,
    Manifest,
    check_member,
    manifest_from_json,
    shown,
)

_BLOCK_BYTES = 1 << 20
_END = struct.Struct("<4s4H2LH")
_END64 = struct.Struct("<4sQ2H2L4Q")
_LOCATOR = struct.Struct("<4sLQL")
_LONGEST_COMMENT = 1 << 16
_SUM = re.compile(r"([0-9a-f]{64})  (.+)")
_ENCRYPTED = 0x1
_REFUSED = "nothing of it is imported"
_DAMAGED = "fetch or export it again"
_BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, struct.error)
"""What :mod:`zipfile` raises for a file that is damaged or made to harm."""

Progress = Callable[[int, int], None]
"""Called with how much is done, and how much there is."""
Place = Callable[[str], Path | None]
"""The new file that a member of this name is unpacked to, None for none."""


def not_unpacked(_name: str) -> None:
    """A :data:`Place` of nothing."""


class ArchiveReader:
    """An archive whose list of members is one of ours; its content is only known to be whole after :meth:`verify`.

    Args:
        file: The open zip file.
        path: For messages.
    """

    def __init__(self, file: zipfile.ZipFile, path: Path) -> None:
        self._file = file
        self._path = path
        self._members = _checked_members(file, path)
        self.manifest: Manifest = manifest_from_json(self.read(MANIFEST))

    @property
    def names(self) -> list[str]:
        """All members, sorted."""
        return sorted(self._members)

    @property
    def size_bytes(self) -> int:
        """What all members take once they are unpacked."""
        return sum(info.file_size for info in self._members.values())

    def below(self, prefix: str) -> list[str]:
        """The members whose name begins with ``prefix``."""
        return [name for name in self._members if name.startswith(prefix)]

    def has(self, name: str) -> bool:
        """Whether there is a member of this name."""
        return name in self._members

    def read(self, name: str) -> bytes:
        """A member as a whole; raises InvalidInput if it is missing, damaged or too large for that."""
        info = self._members.get(name)
        if info is None:
            raise InvalidInput(f"{self._path} lacks {name}", _DAMAGED)
        if info.file_size > LARGEST_TEXT_BYTES:
            raise InvalidInput(f"{self._path}: {shown(name)} has {info.file_size} bytes, more than any of its kind")
        return b"".join(self._blocks(name))

    def json(self, name: str) -> dict[str, Any]:
        """A member that holds a JSON object."""
        return parse_json_object(self.read(name), f"{self._path}: {shown(name)}", recorded=True)

    def lines(self, name: str) -> Iterator[dict[str, Any]]:
        """The lines of a member of :data:`slamhive.services.archive.layout.ROWS`, each a JSON object."""
        number = 0
        with self._opened(name) as stream:
            while line := stream.readline(LARGEST_TEXT_BYTES):
                number += 1
                yield parse_json_object(line, f"{self._path}: line {number} of {name}", recorded=True)

    def unpack(self, name: str, target: Path) -> None:
        """Write a member to the new file ``target``, with the time that it was changed."""
        for _ in self._unpacked(name, target):
            pass

    def verify(self, progress: Progress, place: Place = not_unpacked) -> None:
        """Read every member and compare it with its checksum; raises InvalidInput for the first that differs.

        Args:
            progress: Told bytes.
            place: What is unpacked on the way, and where to.
        """
        sums = self._sums()
        total, done = self.size_bytes, 0
        for name in self._members:
            if name in (MANIFEST, CHECKSUMS):
                continue
            digest = hashlib.sha256()
            target = place(name)
            for block in self._blocks(name) if target is None else self._unpacked(name, target):
                digest.update(block)
                done += len(block)
            if digest.hexdigest() != sums[name]:
                raise InvalidInput(f"{self._path}: {shown(name)} is not what was exported", _DAMAGED)
            progress(done, total)

    def _unpacked(self, name: str, target: Path) -> Iterator[bytes]:
        """The blocks of a member, once each has been written."""
        try:
            stream = target.open("xb")
        except FileNotFoundError:
            target.parent.mkdir(parents=True)
            stream = target.open("xb")
        with stream:
            for block in self._blocks(name):
                stream.write(block)
                yield block
        at = timegm((*self._members[name].date_time, 0, 0, 0))
        os.utime(target, (at, at))

    def _sums(self) -> dict[str, str]:
        """The checksums, which must name every member and no other."""
        digest = hashlib.sha256()
        for block in self._blocks(CHECKSUMS):
            digest.update(block)
        if digest.hexdigest() != self.manifest.checksums:
            raise InvalidInput(f"{self._path}: {CHECKSUMS} is not what was exported", _DAMAGED)
        sums: dict[str, str] = {}
        with self._opened(CHECKSUMS) as stream:
            while line := stream.readline(LARGEST_TEXT_BYTES):
                found = _SUM.fullmatch(line.decode(errors="replace").rstrip("\n"))
                if found is None or found[2] in sums:
                    raise InvalidInput(f"{self._path}: {CHECKSUMS} is not what an export writes", _DAMAGED)
                sums[found[2]] = found[1]
        for name in sums.keys() ^ (self._members.keys() - {MANIFEST, CHECKSUMS}):
            where = "is missing" if name in sums else "was added"
            raise InvalidInput(f"{self._path}: {shown(name)} {where}", _DAMAGED)
        return sums

    def _blocks(self, name: str) -> Iterator[bytes]:
        with self._opened(name) as stream:
            while block := stream.read(_BLOCK_BYTES):
                yield block

    @contextmanager
    def _opened(self, name: str) -> Iterator[IO[bytes]]:
        if name not in self._members:
            raise InvalidInput(f"{self._path} lacks {name}", _DAMAGED)
        try:
            with self._file.open(self._members[name]) as stream:
                yield stream
        except (*_BROKEN, OSError) as error:  # a place before the beginning of the file is an OSError
            raise InvalidInput(f"{self._path}: {shown(name)} is damaged: {error}", _DAMAGED) from None


@contextmanager
def open_archive(path: Path) -> Iterator[ArchiveReader]:
    """The archive at ``path``; raises NotFound, InvalidInput for one that is none of ours, or Unavailable."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError:
        raise NotFound(f"{path} does not exist") from None
    except OSError as error:
        raise Unavailable(f"{path} cannot be read: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InvalidInput(f"{path} is not a file", "give the file that slamhive archive export has written")
    with os.fdopen(descriptor, "rb") as stream:
        _check_directory(stream, path)
        try:
            file = zipfile.ZipFile(stream)
        except _BROKEN as error:
            raise InvalidInput(f"{path} is damaged: {error}", _DAMAGED) from None
        with file:
            yield ArchiveReader(file, path)


def _check_directory(stream: IO[bytes], path: Path) -> None:
    """Refuse a file that is no zip file, was cut short, or has a list of members too long to be held in memory."""
    length = stream.seek(0, os.SEEK_END)
    start = max(0, length - _LONGEST_COMMENT - _END.size - _LOCATOR.size)
    stream.seek(start)
    tail = stream.read()
    place = tail.rfind(b"PK\x05\x06")
    if place < 0 or len(tail) - place < _END.size:
        raise InvalidInput(f"{path} is no archive, or was cut short", _DAMAGED)
    size = _END.unpack_from(tail, place)[5]
    if size == 0xFFFFFFFF and place >= _LOCATOR.size:
        signature, _, offset, _ = _LOCATOR.unpack_from(tail, place - _LOCATOR.size)
        stream.seek(min(offset, length) if signature == b"PK\x06\x07" else length)
        record = stream.read(_END64.size)
        size = _END64.unpack(record)[8] if len(record) == _END64.size else length
    if size > LARGEST_DIRECTORY_BYTES:
        raise InvalidInput(f"{path} lists its members in {size} bytes, more than any archive of ours")
    stream.seek(0)


def _checked_members(file: zipfile.ZipFile, path: Path) -> dict[str, zipfile.ZipInfo]:
    """The members by name; raises InvalidInput if they are not as we write them."""
    members: dict[str, zipfile.ZipInfo] = {}
    for info in file.infolist():
        name = info.orig_filename
        check_member(name)
        if name in members:
            raise InvalidInput(f"{path} has {shown(name)} twice", _REFUSED)
        _check_kind(info, path)
        members[name] = info
    for name in members:
        inside = next((str(folder) for folder in PurePosixPath(name).parents if str(folder) in members), None)
        if inside is not None:
            raise InvalidInput(f"{path}: {shown(inside)} is a file and a folder at once", _REFUSED)
    if sum(info.compress_size for info in members.values()) > path.stat().st_size:
        raise InvalidInput(f"{path}: its members overlap", _REFUSED)
    for name in (MANIFEST, CHECKSUMS, *ROWS):
        if name not in members:
            raise InvalidInput(f"{path} lacks {name}", "slamhive archive export makes archives")
    return members


def _check_kind(info: zipfile.ZipInfo, path: Path) -> None:
    """Refuse links, what is encrypted or packed otherwise, and sizes that cannot be."""
    name = shown(info.orig_filename)
    if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
        raise InvalidInput(f"{path}: {name} is a link or no file at all", _REFUSED)
    if info.flag_bits & _ENCRYPTED or info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise InvalidInput(f"{path}: {name} is encrypted or packed in a way that exports do not use", _REFUSED)
    if info.file_size > LARGEST_RATIO * max(info.compress_size, 1):
        raise InvalidInput(f"{path}: {name} says to be {info.file_size} bytes, more than it can hold", _REFUSED)
