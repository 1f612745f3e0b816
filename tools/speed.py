"""How fast this machine is, so that limits on CPU time mean the same everywhere. Standard library only."""

from __future__ import annotations

import argparse
import contextlib
import statistics
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

REFERENCE_S = 0.0125
"""CPU time of :func:`work_s` on the machine that the limits were set on.

Derived: a machine that takes 0.0182 s needs 1.45 to 1.6 times the CPU time for the quick tests.
"""
EVERY_S = 1.0


@dataclass
class Slowness:
    """How much slower than the reference the machine was while something ran."""

    taken_s: list[float] = field(default_factory=list)

    def factor(self) -> float:
        """How many times longer the same work takes; 1 if nothing was measured.

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


def work_s() -> float:
    """The CPU time (s) that this thread takes to compile a long module of the standard library."""
    source = Path(argparse.__file__).read_text(encoding="utf-8")
    began_s = time.thread_time()
    compile(source, "argparse.py", "exec")
    return time.thread_time() - began_s
