"""Parts of a machine and its engine are killed at random moments; afterwards each run is accounted for."""

from __future__ import annotations

import random
import sys
from collections import Counter
from collections.abc import Callable, Mapping

from slamhive.domain.run import FailureReason
from tests.services.installation import Installation
from tests.services.machine import wait_s
from tests.waiting import eventually

RUNS = 40
KILLS = 60
LEAST = 8
"""With fewer runs that wait or go on, some more are queued, so that each kill meets some."""
PATIENCE_S = 600.0
LONGEST_PAUSE_S = 1.0


class RandomKills:
    """Kills one part after the other, with a seed that is printed.

    Args:
        made: The installation. Its worker is the first part.
        seed: Decides what is killed, and when.
        seconds: How long the runs take, one after the other.
    """

    def __init__(self, made: Installation, seed: int, seconds: tuple[float, ...]) -> None:
        self.rng = random.Random(seed)
        self.killed: Counter[str] = Counter()
        self.submitted = 0
        self._made = made
        self._seed = seed
        self._seconds = seconds
        self._worker = made.machine.start_worker()

    def pause(self) -> None:
        """A moment in which the rest works."""
        wait_s(self.rng.uniform(0.0, LONGEST_PAUSE_S))

    def kill(self, parts: Mapping[str, Callable[[], None]], tend: Callable[[], None] = lambda: None) -> None:
        """Kill :data:`KILLS` times the worker or one of ``parts``, with runs under way, and wait for all runs.

        ``tend`` is what an administrator does meanwhile.
        """
        kinds = {"worker": self._kill_worker, **parts}
        while self.killed.total() < KILLS:
            if self._under_way() < LEAST:
                self._made.submit(RUNS, self._seconds)
                self.submitted += RUNS
            self.pause()
            tend()
            name = self.rng.choice(list(kinds))
            kinds[name]()
            self.killed[name] += 1
        sys.stdout.write(f"\nkilled (seed {self._seed}): {dict(self.killed)}\n")

        def finished() -> bool:
            tend()
            return self._made.finished()

        eventually(finished, "the end of all runs", PATIENCE_S)

    def _under_way(self) -> int:
        counts = self._made.hive.runs.counts()
        return sum(count for state, count in counts.items() if not state.ended)

    def _kill_worker(self) -> None:
        self._made.machine.kill_worker(self._worker)
        self.pause()
        self._worker = self._made.machine.start_worker()


def check_accounts(made: Installation, runs: int, most_lost: int) -> None:
    """All runs have ended, none was executed twice, and what succeeded is evaluated. Only lost runs have failed."""
    made.machine.die()
    made.machine.work_to_the_end()
    found = made.accounts()
    sys.stdout.write(f"{found.row()}\n")
    failed = [run for run in made.hive.runs.page(limit=1000).records if run.reason is not None]
    for run in failed:
        sys.stdout.write(f"run {run.id}: {run.reason}: {run.detail}\n")
    assert found.runs == runs
    assert found.faults == {}, found.faults
    reasons = Counter(run.reason for run in failed)
    assert set(reasons) <= {FailureReason.LOST}, "a run is blamed for the end of its machine"
    assert reasons[FailureReason.LOST] <= most_lost
