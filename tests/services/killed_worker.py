"""Workers that kill themselves (SIGKILL) at their N-th step: before or after a write, a start, a poll, a removal.

Every write to the database and to the record, and every call of the executor, is two steps: before and after. "After
one" and "before the next" are the same moment, so every other step meets all of them.

Run as a program, it answers each line with an N by the number of steps of a worker, see :mod:`tests.forking`.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.run_folder.folder import RunFolder
from slamhive.run_folder.profiling import read_profile
from slamhive.services.evaluations.service import Evaluations
from slamhive.services.hive import Hive, open_hive
from slamhive.store import RunRecord, Store
from tests.forking import Ended, forked, serve
from tests.services.working import started_times

NEVER = 10_000
"""A step that no worker reaches."""
LEAST_STEPS = 20
"""A run without as many would not be what these tests are about."""


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
    work_without_evaluating(hive)
    hive.close()
    return countdown.step


def work_without_evaluating(hive: Hive) -> None:
    """Work until nothing is left. Evaluating takes a second each time; tests count what is queued for it."""
    with mock.patch.object(Evaluations, "work_once", return_value=0):
        hive.worker().run(until_idle=True)


@contextmanager
def killed_workers(script: str = __file__, *arguments: str) -> Iterator[Callable[[int], Ended]]:
    """Yields what runs one worker up to a step. The environment of this moment says on which data root.

    ``script`` is a program that calls :func:`tests.forking.serve`.
    """
    with forked(script, *arguments) as run:
        yield lambda fatal_step: run(str(fatal_step))


def kill_at_each_step(
    hive: Hive, asked: Submission, steps: Callable[[int], Iterable[int]], check: Callable[[RunRecord, str], None]
) -> None:
    """A worker is killed at a step of a run, the next works to the end, and the run was started once; for each step.

    Args:
        hive: The installation; the environment of this process leads to it.
        asked: What is run each time.
        steps: Which steps, of as many as a worker takes that is not killed.
        check: What must hold of the run, with words for when it was killed.
    """
    (undisturbed,) = hive.runs.submit(asked)
    with killed_workers() as work:
        ended = work(NEVER)
        assert ended.returncode == 0, ended.errors
        assert ended.value > LEAST_STEPS
        check(hive.runs.get(undisturbed.id), "not killed")
        for fatal_step in steps(ended.value):
            (run,) = hive.runs.submit(asked)
            killed = work(fatal_step)
            assert killed.returncode in (-signal.SIGKILL, 0), killed.errors
            work_without_evaluating(hive)
            assert started_times(hive, run.id) == 1, f"killed at step {fatal_step}"
            check(hive.runs.get(run.id), f"killed at step {fatal_step}")


def check_whole(hive: Hive, run: RunRecord, when: str) -> None:
    """The run has succeeded, says so everywhere, is queued for one evaluation, and has its plots."""
    assert run.state is RunState.SUCCEEDED, f"{when}: {run.state}, {run.detail}"
    assert run.poses == 30
    assert len(hive.evaluations.of_run(run.id)) == 1, when
    record = hive.runs.record(run.id)
    assert (record["state"], record["poses"]) == ("succeeded", 30)
    assert [event.to_state for event in hive.runs.events(run.id)][-1] is RunState.SUCCEEDED
    folder = hive.runs.folder(run.id)
    plots = (folder.profiling_cpu_plot, folder.profiling_ram_plot)
    assert len(read_profile(folder.profiling)) < 2 or all(plot.exists() for plot in plots), when


if __name__ == "__main__":
    serve(lambda line: work(int(line)))
