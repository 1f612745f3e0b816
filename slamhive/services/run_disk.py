"""What a run writes: watched while it runs, and tidied up when it has ended."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from slamhive.runs.leftovers import DiskLimits, settle, survey
from slamhive.services.evidence import LEFT, look_at
from slamhive.services.run_in_hand import RunInHand
from slamhive.tree import remove_tree

logger = logging.getLogger(__name__)

_SHARE = 20
"""A look is followed by a pause of so many times its duration: at most a twentieth of a core goes into looking."""
_HIDDEN_INTERVAL_S = 1.0


class DiskWatch:
    """Watches what one run writes.

    Args:
        hand: The run.
        limits: What it may write.
        clock: Monotonic seconds.
    """

    def __init__(self, hand: RunInHand, limits: DiskLimits, clock: Callable[[], float] = time.monotonic) -> None:
        self._hand = hand
        self._limits = limits
        self._clock = clock
        self._folders_due_s = self._hidden_due_s = clock()

    def exceeded(self) -> str | None:
        """In words the limit that is exceeded; None if none is, as far as was looked at."""
        hand, limit_bytes = self._hand, self._limits.size_bytes
        began_s = self._clock()
        if limit_bytes is not None and began_s >= self._hidden_due_s:
            hidden_bytes = hand.executor.hidden_bytes(hand.handle)
            self._hidden_due_s = self._after(began_s, _HIDDEN_INTERVAL_S)
            if hidden_bytes > limit_bytes:
                return f"more than {limit_bytes / 1e6:.0f} MB into its container"
        began_s = self._clock()
        if self._limits == DiskLimits() or began_s < self._folders_due_s:
            return None
        found = survey((hand.folder.result, hand.folder.work), self._limits)
        self._folders_due_s = self._after(began_s, 0.0)
        return found.exceeded

    def _after(self, began_s: float, pause_s: float) -> float:
        """When to look again after a look that began at ``began_s``."""
        now_s = self._clock()
        return now_s + max(pause_s, _SHARE * (now_s - began_s))


def disk_limits(saved: dict[str, Any]) -> DiskLimits:
    """The limits in the record of a run; none for one that was started without."""
    limits = saved.get("spec", {}).get("limits", {})
    return DiskLimits(limits.get("disk_bytes"), limits.get("files"))


def settle_result(hand: RunInHand) -> None:
    """Write down what a run has left that has ended, then remove what must not stay of it."""
    known = hand.keeper.readable()
    saved = hand.saved() if known else {}
    limits = disk_limits(saved)
    found = survey((hand.folder.result,), limits)
    if known and LEFT not in saved:
        hand.save({LEFT: look_at(hand.folder, found)})
    for problem in settle(hand.folder, found, limits):
        logger.warning("run %d has left what cannot be removed: %s", hand.run.id, problem)


def remove_scratch(hand: RunInHand) -> None:
    """Remove the scratch space of a run whose executor needs it no more."""
    try:
        remove_tree(hand.folder.work)
    except OSError as error:
        logger.warning("%s is left: %s", hand.folder.work, error.strerror)
