"""Workers that kill themselves (SIGKILL) at their N-th step: before or after a write, a start, a poll, a removal.

Every write to the database and to the record, and every call of the executor, is two steps: before and after.

Run as a program, it answers each line with an N by the number of steps of a worker, see :mod:`tests.forking`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from slamhive.runs.folder import RunFolder
from slamhive.services.evaluations.service import Evaluations
from slamhive.services.hive import open_hive
from slamhive.store import Store
from tests.forking import Ended, forked, serve


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


def work(fatal_step: int) -> int:
    """Work until nothing is left, or until the chosen step; how many steps that took."""
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
    hive.close()
    return countdown.step


@contextmanager
def killed_workers(script: str = __file__, *arguments: str) -> Iterator[Callable[[int], Ended]]:
    """Yields what runs one worker up to a step. The environment of this moment says on which data root.

    ``script`` is a program that calls :func:`tests.forking.serve`.
    """
    with forked(script, *arguments) as run:
        yield lambda fatal_step: run(str(fatal_step))


if __name__ == "__main__":
    serve(lambda line: work(int(line)))
