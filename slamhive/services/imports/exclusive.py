"""One import at a time, of single runs or of archives."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slamhive.bags.variants.locks import Busy, exclusive
from slamhive.errors import Conflict

logger = logging.getLogger(__name__)

ASIDE = ".import-"
"""How the names of folders begin in which imported runs are put together."""
UNPACKED = ".archive"
"""The folder for what is unpacked from an archive."""
_LOCK = ".import.lock"


@contextmanager
def one_import(runs: Path) -> Iterator[None]:
    """Lock the runs folder against other imports and remove what killed ones have left; raises Conflict."""
    lock = runs / _LOCK
    try:
        with exclusive(lock):
            _remove_leftovers(runs)
            try:
                yield
            finally:
                _remove_leftovers(runs)
                lock.unlink(missing_ok=True)
    except Busy:
        raise Conflict("another import is under way", "wait for it to end") from None


def sweep_imports(runs: Path) -> None:
    """Remove what killed imports have left, unless an import is under way."""
    if not list(_leftovers(runs)):
        return
    try:
        with exclusive(runs / _LOCK):
            _remove_leftovers(runs)
    except Busy:
        logger.info("an import is under way: leftovers of killed imports stay until the next sweep")


def _leftovers(runs: Path) -> Iterator[Path]:
    yield from runs.glob(f"{ASIDE}*")
    yield from runs.glob(UNPACKED)


def _remove_leftovers(runs: Path) -> None:
    for path in list(_leftovers(runs)):
        shutil.rmtree(path, ignore_errors=True)
