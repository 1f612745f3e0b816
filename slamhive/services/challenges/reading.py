"""Finds the files of a submission: trajectories, folders of them, and archives. They stay on the disk."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

from slamhive.budget import Lent, Share, unbounded
from slamhive.catalogue.collection_file import kind_of
from slamhive.domain.collection import FileKind
from slamhive.errors import InvalidInput
from slamhive.fetch.unpack import UnpackLimits, unpack
from slamhive.files import temporary_folder
from slamhive.services.challenges.checking import MOST_BYTES

MOST_FILES = 1000
_LIMITS = UnpackLimits(ratio=50.0, always_bytes=20_000_000, total_bytes=MOST_BYTES, files=MOST_FILES)
"""Text of digits shrinks to a third, and to a twentieth where nothing moves."""


@contextmanager
def opened_files(paths: Iterable[Path], share: Share | None = None) -> Iterator[dict[str, Path]]:
    """The files of a submission by name, for the block. A folder, or a zip or tar archive, stands for the files in it.

    Args:
        paths: What was sent.
        share: What is unpacked is taken out of it; None for no limit but those of a submission.

    Raises InvalidInput for what cannot be read or is too large, and for two files of one name; and as Share.take.
    """
    share = share or unbounded("a submission")
    found: dict[str, Path] = {}
    total = 0
    with ExitStack() as unpacked:
        for path in paths:
            for file in _files(path, share, unpacked):
                if file.name in found:
                    raise InvalidInput(f"two files are called {file.name}", "send one of them")
                found[file.name] = file
                total += _size_bytes(file)
                if total > MOST_BYTES or len(found) > MOST_FILES:
                    raise InvalidInput(f"{path.name} holds too much", "send trajectories only")
        yield found


def _files(path: Path, share: Share, unpacked: ExitStack) -> Iterator[Path]:
    kind = kind_of(path.name)
    if path.is_dir():
        yield from (file for file in sorted(path.rglob("*")) if file.is_file() and not file.name.startswith("."))
    elif kind in (FileKind.ZIP, FileKind.TAR):
        folder = unpacked.enter_context(temporary_folder())
        unpack(path, kind, folder, limits=_LIMITS, room=partial(share.take, Lent.DISK))
        yield from _files(folder, share, unpacked)
    else:
        yield path


def _size_bytes(path: Path) -> int:
    try:
        size = path.stat().st_size
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}") from None
    if size > MOST_BYTES:
        raise InvalidInput(f"{path.name} has more than {MOST_BYTES:,} bytes", "send trajectories only")
    return size
