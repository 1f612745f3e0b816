"""Reads archives from outside, member by member: zip, and tar with any compression of Python's tarfile."""

from __future__ import annotations

import errno
import lzma
import os
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import IO

from slamhive.domain.collection import FileKind
from slamhive.errors import InvalidInput

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
    """What a member of an archive is. Only files and folders are unpacked."""

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
        yield from _zip_members(path)
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


def _zip_members(path: Path) -> Iterator[Member]:
    with zipfile.ZipFile(path) as archive:
        for info in archive.infolist():
            kind = _zip_kind(info)
            if info.flag_bits & 1:
                raise InvalidInput(f"{path.name} is encrypted", "unpack it by hand")
            if kind is not MemberKind.FILE:
                yield Member(info.filename, kind, None)
                continue
            with archive.open(info) as content:
                yield Member(info.filename, kind, content)


def _zip_kind(info: zipfile.ZipInfo) -> MemberKind:
    if info.is_dir():
        return MemberKind.FOLDER
    mode = (info.external_attr >> 16) & _TYPE_BITS if info.create_system == _UNIX else 0
    return MemberKind(_ZIP_KINDS.get(mode, "device"))


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
            yield Member(info.name, _tar_kind(info), archive.extractfile(info) if info.isreg() else None)
            archive.members = []  # type: ignore[attr-defined] # tarfile keeps all of them, which may be millions
    if not ended:
        raise InvalidInput(f"{path.name} is damaged: it ends early", "download it again")


def _tar_kind(info: tarfile.TarInfo) -> MemberKind:
    if info.isreg():
        return MemberKind.FILE
    if info.isdir():
        return MemberKind.FOLDER
    return MemberKind.LINK if info.issym() or info.islnk() else MemberKind.DEVICE
