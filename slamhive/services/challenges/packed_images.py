"""Archives of images that teams send: what they hold, and how much room they take. Nothing in them is executed."""

from __future__ import annotations

import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from slamhive.catalogue.algorithm_file import load_algorithms
from slamhive.domain.algorithm import Algorithm
from slamhive.errors import InvalidInput
from slamhive.schema.challenge import StoredImage
from slamhive.services.algorithms import ImageArchive
from slamhive.services.versions import is_export, opened_version

MB = 1_000_000
_ENTRY_BYTES = 4096
"""What an entry of an archive takes on a disk, however small it is."""
_ZSTD = b"\x28\xb5\x2f\xfd"
_REMEDY = "export it again with slamhive algorithm export, or docker save"


def check_image(path: Path, algorithm: str | None, largest_mb: int) -> StoredImage:
    """What the archive at ``path`` holds: a version that was exported, or an image that ``docker save`` wrote.

    Args:
        path: The archive.
        algorithm: The algorithm of its package that a team has chosen.
        largest_mb: Most that it may have, packed and unpacked (MB).

    Raises InvalidInput if it is damaged or too large, or holds no such algorithm.
    """
    _check_room(path, largest_mb)
    if not is_export(path):
        ImageArchive(path).check()
        return StoredImage(package=None, algorithm=algorithm)
    with opened_version(path) as packed:
        if not packed.has_image:
            raise InvalidInput(f"{path.name} holds a package without an image", _REMEDY)
        chosen = choose_algorithm(load_algorithms(packed.package.folder), algorithm)
        return StoredImage(package=packed.package.name, algorithm=chosen.name)


def choose_algorithm(algorithms: tuple[Algorithm, ...], asked: str | None) -> Algorithm:
    """The algorithm that is called ``asked``, or the only one; raises InvalidInput."""
    names = ", ".join(entry.name for entry in algorithms)
    if asked is None and len(algorithms) > 1:
        raise InvalidInput(f"the package has several algorithms: {names}", "choose one of them")
    for entry in algorithms:
        if asked in (None, entry.name):
            return entry
    raise InvalidInput(f"the package has no algorithm {str(asked)[:80]!r}", f"it has {names}")


def _check_room(path: Path, largest_mb: int) -> None:
    """Raise InvalidInput if the archive, or what its layers unpack to, is too large: small files can unpack to much."""
    left = largest_mb * MB
    with _reading(path):
        if path.stat().st_size > left:
            raise _too_large(path, largest_mb)
        with tarfile.open(path, mode="r|*") as archive:
            for member in archive:
                left -= _ENTRY_BYTES
                content = archive.extractfile(member) if member.isreg() else None
                if content is not None:
                    left -= max(member.size, _unpacked(path, content, max(left, 0)))
                if left < 0:
                    raise _too_large(path, largest_mb)


def _unpacked(path: Path, content: IO[bytes], most: int) -> int:
    """How much a layer unpacks to (bytes), counted until it is more than ``most``; 0 for what is no layer."""
    if content.peek(4)[:4] == _ZSTD:  # type: ignore[attr-defined]
        raise InvalidInput(f"{path.name} has layers that were packed with zstd", "save it with docker save")
    found = 0
    try:
        with tarfile.open(fileobj=content, mode="r|*") as layer:
            for member in layer:
                found += _ENTRY_BYTES + max(member.size, 0)
                if found > most:
                    break
    except (tarfile.ReadError, EOFError, zlib.error):
        return found
    return found


def _too_large(path: Path, largest_mb: int) -> InvalidInput:
    return InvalidInput(f"{path.name} has more than {largest_mb:,} MB when it is unpacked", "send a smaller image")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (tarfile.TarError, OSError, EOFError, zlib.error, OverflowError, ValueError) as error:
        raise InvalidInput(f"{path.name} cannot be read as an archive: {error}", _REMEDY) from None
