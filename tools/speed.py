"""Speed of this machine while tests run, so that limits on CPU time mean the same everywhere."""

from __future__ import annotations

import contextlib
import statistics
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

from slamhive.base.machine import REFERENCE_S, work_s

EVERY_S = 1.0


@dataclass
class Slowness:
    """Slowness of the machine against the reference while something ran."""

    taken_s: list[float] = field(default_factory=list)

    def factor(self) -> float:
        """Ratio by which the same work takes longer; 1 if nothing was measured.

        At least 1, because a fast machine gets no tighter limits.
        """
        return max(1.0, statistics.median(self.taken_s or [REFERENCE_S]) / REFERENCE_S)


@contextlib.contextmanager
def slowness_meanwhile(every_s: float = EVERY_S) -> Iterator[Slowness]:
    """Measure while the block runs, because what others do on the machine changes from one minute to the next."""
    slowness, ended = Slowness(), threading.Event()

    def measure() -> None:
        while True:
            slowness.taken_s.append(work_s())
            if ended.wait(every_s):
                return

    thread = threading.Thread(target=measure, daemon=True)
    thread.start()
    try:
        yield slowness
    finally:
        ended.set()
        thread.join()
