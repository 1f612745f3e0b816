"""Workers that kill themselves (SIGKILL) at their N-th step: before or after a write, a start, a poll, a removal.

Every write to the database and to the record, and every call of the executor, is two steps: before and after.

Run as a program, it reads one N from each line. Each worker is a process of its own, forked from this one, which
imports what the first one has used: importing takes longer than the work. A line with its exit code (-9: step N was
reached) and the number of its steps, 0 if it was killed, answers each N.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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


def serve(work: Callable[[int], int]) -> None:
    """Answer each line of standard input. ``work`` gets the fatal step and returns the number of its steps."""
    for line in sys.stdin:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            with os.fdopen(writing, "w") as report:
                report.write(" ".join((str(work(int(line))), *sys.modules)))
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as report:
            steps, *modules = report.read().split() or ("0",)
        _, status = os.waitpid(child, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)} {steps}\n")
        sys.stdout.flush()
        for name in modules:
            with contextlib.suppress(ImportError):  # some modules have names that cannot be imported
                importlib.import_module(name)


@dataclass(frozen=True)
class Ended:
    """How a worker ended; ``errors`` is what all workers have written to standard error so far."""

    returncode: int
    steps: int
    errors: str


@contextmanager
def killed_workers(script: str = __file__, *arguments: str) -> Iterator[Callable[[int], Ended]]:
    """Yields what runs one worker up to a step. The environment of this moment says on which data root.

    ``script`` is a program that calls :func:`serve`.
    """
    with tempfile.TemporaryFile("w+") as errors:
        program = [sys.executable, script, *arguments]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors, "text": True}
        with subprocess.Popen(program, env=dict(os.environ), **pipes) as server:  # type: ignore[call-overload]

            def run(fatal_step: int) -> Ended:
                server.stdin.write(f"{fatal_step}\n")
                server.stdin.flush()
                answer = server.stdout.readline().split()
                errors.seek(0)
                said = errors.read()
                assert len(answer) == 2, said
                return Ended(int(answer[0]), int(answer[1]), said)

            try:
                yield run
            finally:
                server.kill()


if __name__ == "__main__":
    serve(work)
