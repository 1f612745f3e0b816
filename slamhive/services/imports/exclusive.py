"""One import files runs at a time, be they single or of an archive."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from slamhive.bags.variants.locks import Busy, exclusive
from slamhive.clock import monotonic_s, utc_now
from slamhive.errors import Conflict, Unavailable
from slamhive.files import remedy_of, sweep_folder

logger = logging.getLogger(__name__)

ASIDE = ".import-"
"""How the names of folders begin in which imported runs are put together."""
UNPACKED = ".archive"
"""How the names of folders begin for what is unpacked from an archive; their import holds them."""
WAIT_S = 10.0
"""Longest that an import waits for its turn to file runs."""
_LOCK = ".import.lock"

Waiting = Callable[[str], None]
"""Called with what an import waits for, in words."""


@contextmanager
def one_import(runs: Path, what: str, waiting: Waiting = lambda _text: None) -> Iterator[None]:
    """Lock the runs folder against other imports and remove what killed ones have left.

    An import takes the lock for each batch that it files, so that a small one gets its turn between the batches of a
    large one. Reading, checking and unpacking need no lock.

    Args:
        runs: The folder of runs.
        what: What is imported, for the messages of others who wait for it; neither a name nor a token of somebody.
        waiting: Called while another import files runs.

    Raises Conflict, saying what files runs and since when.
    """
    lock, began_s = runs / _LOCK, monotonic_s()

    def wait(_share: float, _text: str) -> None:
        text = _holder(lock)
        if monotonic_s() - began_s >= WAIT_S:
            raise Conflict(text, "wait for it to end")
        waiting(f"waiting: {text}")

    with exclusive(lock, wait):
        try:
            lock.write_text(json.dumps({"what": what, "since": utc_now().isoformat()}), encoding="utf-8")
        except OSError as error:
            raise Unavailable(f"{lock} cannot be written: {error.strerror}", remedy_of(error)) from None
        _remove_leftovers(runs)
        try:
            yield
        finally:
            _remove_leftovers(runs)
            lock.unlink(missing_ok=True)


def _holder(lock: Path) -> str:
    """In words, which import holds the lock, and since when."""
    try:
        content = json.loads(lock.read_text(encoding="utf-8"))
        since = datetime.fromisoformat(content["since"])
        return f"another import files {content['what']} since {since:%H:%M:%S} UTC"
    except (OSError, ValueError, KeyError, TypeError):  # it begins or ends now, or an earlier version made it
        return "another import files runs"


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
    yield from runs.glob(f"{UNPACKED}*")


def _remove_leftovers(runs: Path) -> None:
    for path in list(_leftovers(runs)):
        sweep_folder(path)
