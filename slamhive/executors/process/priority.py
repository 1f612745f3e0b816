"""Makes sure that a supervisor gets CPU time whatever its run does.

The supervisor's priority is raised, rather than the run's lowered: a run that is measured should get what any program
gets. Only if raising is refused, and both share CPU time, the run is one step nicer.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_OOM_SCORE = Path("/proc/self/oom_score_adj")
_RAISED_BY = 5
_SPARED_BY = 500
_LOWEST_OOM_SCORE = -1000
_SPARED = "; the kernel kills the supervisor late when the machine runs out of memory"
_NOT_SPARED = "; the kernel may kill the supervisor when the machine runs out of memory"


@dataclass(frozen=True, slots=True)
class Priority:
    """The values before, for the run, and which of them could be raised for the supervisor."""

    nice_before: int
    oom_score_before: str | None
    raised: bool
    spared: bool

    def give_back(self, *, shares_processors: bool) -> None:
        """In the run's first process: the values of before; one step nicer if the supervisor was not raised."""
        if not self.raised and shares_processors:
            os.nice(1)
        elif self.raised:
            os.setpriority(os.PRIO_PROCESS, 0, self.nice_before)
        if self.oom_score_before is not None and self.spared:
            _OOM_SCORE.write_text(self.oom_score_before, encoding="ascii")

    def words(self, *, shares_processors: bool) -> str:
        """For the record."""
        if self.raised:
            nice = f"the supervisor runs at nice -{_RAISED_BY}, the run as any program"
        elif shares_processors:
            nice = "the supervisor may not raise itself; the run has nice +1"
        else:
            nice = "the supervisor may not raise itself; the run has its own share of the processors"
        return nice + (_SPARED if self.spared else _NOT_SPARED)


def raise_supervisor() -> Priority:
    """Raise the calling process above what it will start, as far as this is allowed."""
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    raised = spared = False
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, nice - _RAISED_BY)
        raised = True
    score: str | None = None
    with contextlib.suppress(OSError, ValueError):
        score = _OOM_SCORE.read_text(encoding="ascii").strip()
        _OOM_SCORE.write_text(str(max(_LOWEST_OOM_SCORE, int(score) - _SPARED_BY)), encoding="ascii")
        spared = True
    return Priority(nice, score, raised, spared)


@contextlib.contextmanager
def urgent() -> Iterator[None]:
    """Run before all other programs for a moment, if allowed: to count processes and end those that are too many."""
    before = os.sched_getscheduler(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(1))
    except OSError:
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, before, os.sched_param(0))


if __name__ == "__main__":
    sys.stdout.write(raise_supervisor().words(shares_processors=sys.argv[1:] == ["shares"]))
