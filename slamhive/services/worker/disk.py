"""The files that a run writes: watch their size while it runs, clean up after it has ended."""

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
"""After each check, wait this many times its CPU time, so that checks use at most a tenth of a core."""
_HIDDEN_INTERVAL_S = 1.0


class DiskWatch:
    """Watches the disk usage of one run.

    Args:
        hand: The run.
        limits: Its disk limits.
    """

    def __init__(self, hand: RunInHand, limits: DiskLimits) -> None:
        self._hand = hand
        self._limits = limits
        self._folders_due_s = self._hidden_due_s = monotonic_s()

    def exceeded(self) -> str | None:
        """The exceeded limit in words; None if none was exceeded at the last check."""
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
    """The disk limits in the record of a run; none if it was started without limits."""
    limits = saved.get("spec", {}).get("limits", {})
    return DiskLimits(limits.get("disk_bytes"), limits.get("files"))


def settle_result(hand: RunInHand) -> None:
    """Record the files of an ended run, then remove those that must not stay."""
    known = hand.keeper.readable()
    saved = hand.saved() if known else {}
    limits = disk_limits(saved)
    found = survey(hand.folder, limits)
    if known and LEFT not in saved:
        hand.save({LEFT: look_at(hand.folder, found)})
    for problem in settle(hand.folder, found, limits):
        logger.warning("files of run %d cannot be removed: %s", hand.run.id, problem)


def remove_scratch(hand: RunInHand) -> None:
    """Remove the scratch space of a run that its executor no longer needs."""
    _remove(hand.folder.work)


def sweep_scratch(runs: Path, store: Store) -> None:
    """Remove the scratch space of ended runs that a killed worker left behind."""
    left = {int(path.parent.name): path for path in runs.glob("*/work") if path.parent.name.isdecimal()}
    for number in store.read(lambda t: t.archive.ended_among(list(left))):
        _remove(left[number])


def _remove(folder: Path) -> None:
    try:
        remove_tree(folder)
    except OSError as error:
        logger.warning("%s cannot be removed: %s", folder, error.strerror)
