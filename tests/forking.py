"""Processes that begin in milliseconds: forked from one that has imported what they need, which takes longest.

A program calls :func:`serve`; :func:`forked` starts it and has it do one piece of work after the other.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests import compiled_once, durability, fresh_tables

CHECKOUT = Path(__file__).resolve().parents[1]


def serve(work: Callable[[str], int], *, without: str | None = None) -> None:
    """Call ``work`` with each line of standard input, in a process of its own that is forked from this one.

    This one imports what they have used, but for modules whose names begin with ``without``. The answer to a line is
    the exit code (-9: it was killed) and what ``work`` returned, 0 if it did not.
    """
    for line in sys.stdin:
        durability.leave_out(True)  # again each time: SQLAlchemy is imported after the first
        fresh_tables.copy_tables()
        compiled_once.compile_once()
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            with os.fdopen(writing, "w") as report:
                report.write(" ".join((str(work(line)), *sys.modules)))
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as report:
            returned, *modules = report.read().split() or ("0",)
        _, status = os.waitpid(child, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)} {returned}\n")
        sys.stdout.flush()
        for name in modules:
            if without is not None and name.startswith(without):
                continue
            with contextlib.suppress(ImportError):  # some modules have names that cannot be imported
                importlib.import_module(name)


@dataclass(frozen=True)
class Ended:
    """How a process ended, and the ``value`` that its work returned.

    ``errors`` is what all of them have written to standard error so far.
    """

    returncode: int
    value: int
    errors: str


@contextmanager
def forked(*program: str) -> Iterator[Callable[[str], Ended]]:
    """Yields what has the program do one piece of work. It has the environment of this moment.

    ``program``: arguments of Python for a program that calls :func:`serve`.
    """
    with tempfile.TemporaryFile("w+") as errors:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": errors, "text": True}
        command = [sys.executable, *program]
        with subprocess.Popen(command, cwd=CHECKOUT, env=dict(os.environ), **pipes) as server:  # type: ignore[call-overload]

            def run(line: str) -> Ended:
                server.stdin.write(f"{line}\n")
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
