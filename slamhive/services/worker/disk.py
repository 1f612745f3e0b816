"""What a run writes: watched while it runs, and tidied up when it has ended."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from slamhive.clock import monotonic_s
from slamhive.runs.leftovers import DiskLimits, settle, survey
from slamhive.services.worker.evidence import LEFT, look_at
from slamhive.services.worker.run_in_hand import RunInHand
from slamhive.store import Store
from slamhive.tree import remove_tree

logger = logging.getLogger(__name__)

_SHARE = 10
"""A look is followed by a pause of so many times the CPU time that it took: a tenth of a core at most."""
_HIDDEN_INTERVAL_S = 1.0


class DiskWatch:
    """Watches what one run writes.

    Args:
        hand: The run.
        limits: What it may write.
    """

    def __init__(self, hand: RunInHand, limits: DiskLimits) -> None:
        self._hand = hand
        self._limits = limits
        self._folders_due_s = self._hidden_due_s = monotonic_s()

    def exceeded(self) -> str | None:
        """In words the limit that is exceeded; None if none is, as far as was looked at."""
        limit_bytes = self._limits.size_bytes
        if limit_bytes is not None and monotonic_s() >= self._hidden_due_s:
            hidden_bytes = self._hand.executor.hidden_bytes(self._hand.handle)
            self._hidden_due_s = monotonic_s() + _HIDDEN_INTERVAL_S
            if hidden_bytes > limit_bytes:
                return f"more than {limit_bytes / 1e6:.0f} MB, as its executor counts"
        if self._limits == DiskLimits() or monotonic_s() < self._folders_due_s:
            return None
        began_s = time.thread_time()
        found = survey(self._hand.folder, self._limits)
        self._folders_due_s = monotonic_s() + _SHARE * (time.thread_time() - began_s)
        return found.exceeded


def disk_limits(saved: dict[str, Any]) -> DiskLimits:
    """The limits in the record of a run; none for one that was started without."""
    limits = saved.get("spec", {}).get("limits", {})
    return DiskLimits(limits.get("disk_bytes"), limits.get("files"))


def settle_result(hand: RunInHand) -> None:
    """Write down what a run has left that has ended, then remove what must not stay of it."""
    known = hand.keeper.readable()
    saved = hand.saved() if known else {}
    limits = disk_limits(saved)
    found = survey(hand.folder, limits)
    if known and LEFT not in saved:
        hand.save({LEFT: look_at(hand.folder, found)})
    for problem in settle(hand.folder, found, limits):
        logger.warning("run %d has left what cannot be removed: %s", hand.run.id, problem)


def remove_scratch(hand: RunInHand) -> None:
    """Remove the scratch space of a run whose executor needs it no more."""
    _remove(hand.folder.work)


def sweep_scratch(runs: Path, store: Store) -> None:
    """Remove the scratch space of runs that have ended, which a worker that was killed has left."""
    left = {int(path.parent.name): path for path in runs.glob("*/work") if path.parent.name.isdecimal()}
    for number in store.read(lambda t: t.archive.ended_among(list(left))):
        _remove(left[number])


def _remove(folder: Path) -> None:
    try:
        remove_tree(folder)
    except OSError as error:
        logger.warning("%s is left: %s", folder, error.strerror)
