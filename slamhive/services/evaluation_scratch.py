"""Folders in which batches of evaluations keep what they need while they run; killed ones leave nothing for long."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.services.identity import owner_is_dead

_PREFIX = ".evaluation-"
_OWNER = "owner"


@contextmanager
def scratch_folder(data: Path, owner: str) -> Iterator[Path]:
    """A folder of ``owner`` below ``data``, removed at the end. Those that dead owners have left go first."""
    for left in data.glob(f"{_PREFIX}*"):
        if _is_left_over(left):
            shutil.rmtree(left, ignore_errors=True)
    with tempfile.TemporaryDirectory(prefix=_PREFIX, dir=data) as name:
        folder = Path(name)
        (folder / _OWNER).write_text(owner, encoding="utf-8")
        yield folder


def _is_left_over(folder: Path) -> bool:
    try:
        return owner_is_dead((folder / _OWNER).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError):
        return False
