"""Reads the files of a submission: trajectories, folders of them, and archives."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from slamhive.catalogue.collection_file import kind_of
from slamhive.domain.collection import FileKind
from slamhive.errors import InvalidInput
from slamhive.fetch.unpack import UnpackLimits, unpack
from slamhive.files import temporary_folder
from slamhive.services.challenges.checking import MOST_BYTES

MOST_FILES = 1000
_LIMITS = UnpackLimits(total_bytes=MOST_BYTES, files=MOST_FILES)


def read_files(paths: Iterable[Path]) -> dict[str, bytes]:
    """The files of a submission by name. A folder or a zip or tar archive stands for the files in it.

    Raises InvalidInput for what cannot be read or is too large, and for two files of one name.
    """
    found: dict[str, bytes] = {}
    for path in paths:
        for name, data in _contents(path):
            if name in found:
                raise InvalidInput(f"two files are called {name}", "send one of them")
            found[name] = data
            if sum(map(len, found.values())) > MOST_BYTES or len(found) > MOST_FILES:
                raise InvalidInput(f"{path.name} holds too much", "send trajectories only")
    return found


def _contents(path: Path) -> Iterator[tuple[str, bytes]]:
    kind = kind_of(path.name)
    if path.is_dir():
        for file in sorted(path.rglob("*")):
            if file.is_file() and not file.name.startswith("."):
                yield file.name, _content(file)
    elif kind in (FileKind.ZIP, FileKind.TAR):
        with temporary_folder() as folder:
            unpack(path, kind, folder, limits=_LIMITS)
            yield from _contents(folder)
    else:
        yield path.name, _content(path)


def _content(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            data = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from None
    if len(data) > MOST_BYTES:
        raise InvalidInput(f"{path.name} has more than {MOST_BYTES:,} bytes", "send trajectories only")
    return data
