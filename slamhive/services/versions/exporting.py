"""One file that moves a version to another machine: what ``docker save`` writes, and a folder ``slamhive`` in it.

The engine ignores the folder, so ``docker load`` takes the file too. ``slamhive/version.json`` describes the version,
``slamhive/package/`` is the folder of the package, and ``slamhive/manifest-sha256.txt``, the last member, holds the
checksum of every other one. The file is written and read as a stream: no image is held in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import tarfile
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

from slamhive.errors import Conflict, Unavailable
from slamhive.files import remedy_of
from slamhive.store import VersionRecord

FOLDER = "slamhive/"
DESCRIPTION = FOLDER + "version.json"
PACKAGE = FOLDER + "package/"
MANIFEST = FOLDER + "manifest-sha256.txt"
KIND = "slamhive-algorithm"
FORMAT = 1
BLOCK_BYTES = 1 << 20


class ChunkStream(io.RawIOBase):
    """Chunks of bytes as a file to read from."""

    def __init__(self, chunks: Iterable[bytes]) -> None:
        self._chunks = iter(chunks)
        self._rest = b""

    def readable(self) -> bool:
        """It is for reading only."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Fill the buffer as far as one chunk goes; 0 at the end."""
        while not self._rest:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._rest = chunk
        count = min(len(buffer), len(self._rest))
        buffer[:count], self._rest = self._rest[:count], self._rest[count:]
        return count


class HashedReader:
    """Reads a member of an archive, and takes its checksum on the way."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._digest = hashlib.sha256()

    def read(self, size: int = -1) -> bytes:
        """The next bytes."""
        data = self._stream.read(size)
        self._digest.update(data)
        return data

    @property
    def checksum(self) -> str:
        """SHA-256 of what was read, in hex."""
        return self._digest.hexdigest()


def export_version(record: VersionRecord, package: Path, image: Iterable[bytes] | None, path: Path) -> None:
    """Write the archive of a version to ``path``, which gets its name when the archive is complete.

    Args:
        record: The version.
        package: The folder of the package as it was.
        image: What the engine saves of the image; None for an archive that holds the package alone.
        path: A file that does not exist; raises Conflict if it does.

    Raises Unavailable if the disk refuses.
    """
    if path.exists():
        raise Conflict(f"{path} exists", "choose another name, or remove it")
    aside = None
    try:
        descriptor, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "wb") as stream:
            with tarfile.open(fileobj=stream, mode="w|", format=tarfile.PAX_FORMAT) as archive:
                checksums = dict(_members(archive, record, package, image))
                lines = "".join(f"{checksum}  {name}\n" for name, checksum in checksums.items())
                _add(archive, MANIFEST, lines.encode())
            stream.flush()
            os.fsync(stream.fileno())
            os.fchmod(stream.fileno(), 0o644)
        Path(aside).rename(path)
        aside = None
    except OSError as error:
        raise Unavailable(f"{path} cannot be written: {error.strerror or error}", remedy_of(error)) from None
    finally:
        if aside is not None:
            with contextlib.suppress(OSError):
                Path(aside).unlink()


def _members(
    archive: tarfile.TarFile, record: VersionRecord, package: Path, image: Iterable[bytes] | None
) -> Iterator[tuple[str, str]]:
    """Add all members but the manifest; name and checksum of each file."""
    description = {
        "kind": KIND,
        "format": FORMAT,
        "package": record.package,
        "number": record.number,
        "version": record.version,
        "identity": record.identity,
        "package_hash": record.package_hash,
        "created_at": record.created_at.isoformat(),
        "image": image is not None,
    }
    yield DESCRIPTION, _add(archive, DESCRIPTION, json.dumps(description, indent=1).encode())
    for path in sorted(package.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            name = PACKAGE + path.relative_to(package).as_posix()
            yield name, _add(archive, name, path.read_bytes())
    if image is None:
        return
    with tarfile.open(fileobj=io.BufferedReader(ChunkStream(image), BLOCK_BYTES), mode="r|") as saved:
        for member in saved:
            content = saved.extractfile(member) if member.isreg() else None
            if content is None:
                archive.addfile(member)
                continue
            hashed = HashedReader(content)
            archive.addfile(member, hashed)
            yield member.name, hashed.checksum


def _add(archive: tarfile.TarFile, name: str, content: bytes) -> str:
    member = tarfile.TarInfo(name)
    member.size, member.mode = len(content), 0o644
    archive.addfile(member, io.BytesIO(content))
    return hashlib.sha256(content).hexdigest()
