"""How fast this machine is, so that limits on CPU time mean the same everywhere. Standard library only."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

REFERENCE_S = 0.125
"""CPU time of :func:`work_s` on the machine that the limits were set on.

Derived: a machine that takes 0.182 s needs 1.45 to 1.6 times the CPU time for the quick tests.
"""
ATTEMPTS = 3


def slowness() -> float:
    """How many times longer than the reference this machine takes, at least 1: a fast one gets no tighter limits."""
    return max(1.0, min(work_s() for _ in range(ATTEMPTS)) / REFERENCE_S)


def work_s(rounds: int = 10) -> float:
    """The CPU time (s) of compiling a long module of the standard library so often."""
    source = Path(argparse.__file__).read_text(encoding="utf-8")
    began_s = time.process_time()
    for _ in range(rounds):
        compile(source, "argparse.py", "exec")
    return time.process_time() - began_s
