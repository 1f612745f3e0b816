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
from typing import Any

from tests import compiled_once, durability, fresh_tables

CHECKOUT = Path(__file__).resolve().parents[1]


def serve(work: Callable[[str], int], *, without: str | None = None) -> None:
    """Call ``work`` with each line of standard input, in a process of its own that is forked from this one.

    This one imports what they have used, but for modules whose names begin with ``without``, and completes the data
    models that they have completed. The answer to a line is the exit code (-9: it was killed) and what ``work``
    returned, 0 if it did not.
    """
    for line in sys.stdin:
        durability.leave_out(True)  # again each time: SQLAlchemy is imported after the first
        fresh_tables.copy_tables()
        compiled_once.compile_once()
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            with os.fdopen(writing, "w") as report:
                returned = str(work(line))
                finished = (f"+{name}" for name, model in models().items() if model.__pydantic_complete__)
                report.write(" ".join((returned, *sys.modules, *finished)))
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as report:
            returned, *names = report.read().split() or ("0",)
        _, status = os.waitpid(child, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)} {returned}\n")
        sys.stdout.flush()
        for name in names:
            if name.startswith("+") or (without is not None and name.startswith(without)):
                continue
            with contextlib.suppress(ImportError):  # some modules have names that cannot be imported
                importlib.import_module(name)
        complete = {name[1:] for name in names if name.startswith("+")}
        for name, model in models().items():
            if name in complete and not model.__pydantic_complete__:
                model.model_rebuild(raise_errors=False)


def models() -> dict[str, Any]:
    """The data models that have been imported, by module and name. Many are completed when they are first used."""
    waiting = [sys.modules["pydantic"].BaseModel] if "pydantic" in sys.modules else []
    found = {}
    while waiting:
        for model in waiting.pop().__subclasses__():
            waiting.append(model)
            if model.__module__.startswith("slamhive."):
                found[f"{model.__module__}.{model.__qualname__}"] = model
    return found


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
