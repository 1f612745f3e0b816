"""The speed of this machine, by the CPU time of a fixed piece of work. Standard library only."""

from __future__ import annotations

import argparse
from pathlib import Path
from time import thread_time

REFERENCE_S = 0.0125
"""CPU time of :func:`work_s` on the machine that the limits of tests and the times of the demo were measured on.

Derived: a machine that takes 0.0182 s needs 1.45 to 1.6 times the CPU time for the quick tests.
"""


def work_s() -> float:
    """The CPU time (s) that this thread takes to compile a long module of the standard library."""
    source = Path(argparse.__file__).read_text(encoding="utf-8")
    began_s = thread_time()
    compile(source, "argparse.py", "exec")
    return thread_time() - began_s


def slowness() -> float:
    """The factor by which CPU work takes longer here than on the reference; below 1 on a faster machine."""
    return min(work_s() for _ in range(3)) / REFERENCE_S


# The identifier of this start of the machine.


_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def boot_id() -> str:
    """Another one after each start of the machine, whatever its clock says. Empty where the kernel has none."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""
