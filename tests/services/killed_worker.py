"""A worker that kills itself (SIGKILL) at its N-th step: before or after a write, a start, a poll, a removal.

Run as ``python killed_worker.py N``; exit by signal 9 means that step N was reached, exit 0 that the work was done
before. Every write to the database and to the record, and every call of the executor, is two steps: before and after.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from typing import Any

from slamhive.runs.folder import RunFolder
from slamhive.services.evaluations.service import Evaluations
from slamhive.services.hive import open_hive
from slamhive.store import Store


class Countdown:
    """Counts steps, and ends the process at the chosen one."""

    def __init__(self, fatal_step: int) -> None:
        self.fatal_step = fatal_step
        self.step = 0

    def tick(self) -> None:
        self.step += 1
        if self.step == self.fatal_step:
            os.kill(os.getpid(), signal.SIGKILL)

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any, **keywords: Any) -> Any:
            self.tick()
            result = function(*args, **keywords)
            self.tick()
            return result

        return wrapped


def main(fatal_step: int) -> None:
    """Work until nothing is left, or until the chosen step."""
    countdown = Countdown(fatal_step)
    hive = open_hive()
    for owner, names in (
        (RunFolder, ("write_record",)),
        (Store, ("write",)),
        (type(hive.executors.get(hive.settings.executor)), ("build", "start", "save_log", "collect", "remove", "stop")),
    ):
        for name in names:
            setattr(owner, name, countdown.around(getattr(owner, name)))
    # Nothing is evaluated here: the test counts what is queued for it.
    Evaluations.work_once = lambda *_arguments, **_options: 0  # type: ignore[method-assign]
    hive.worker().run(until_idle=True)
    sys.stdout.write(f"steps {countdown.step}\n")


if __name__ == "__main__":
    main(int(sys.argv[1]))
