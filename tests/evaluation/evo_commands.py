"""evo's command line, each command in a process of its own, forked from one that has imported evo.

Importing evo, with pandas and Matplotlib, takes longer than most of its commands. Run as a program, it reads one
command from each line, as a list in JSON, and answers with its exit code.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path

IMPORTED = ("ape", "res", "rpe")


def serve() -> None:
    """Carry out the commands on standard input, as the installed programs of these names do."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # evo prints, even when it is imported
    for name in IMPORTED:
        import_module(f"evo.cli.{name}")
        import_module(f"evo.cli.{name}_parser")
    programs = entry_points(group="console_scripts")
    for line in sys.stdin:
        arguments = json.loads(line)
        child = os.fork()
        if child == 0:
            sys.argv = arguments
            sys.exit(programs[arguments[0]].load()())
        _, status = os.waitpid(child, 0)
        answers.write(f"{os.waitstatus_to_exitcode(status)}\n")
        answers.flush()


@contextmanager
def evo_commands(folder: Path) -> Iterator[Callable[..., None]]:
    """Yields what carries out one command with its arguments; ``folder`` is its home and working folder."""
    environment = {"PATH": os.environ["PATH"], "HOME": str(folder), "MPLBACKEND": "Agg"}
    errors = folder / "errors.txt"
    with (
        errors.open("w") as stderr,
        subprocess.Popen(
            [sys.executable, str(Path(__file__).resolve())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            env=environment,
            cwd=folder,
        ) as server,
    ):
        assert server.stdin is not None
        assert server.stdout is not None
        asked, answered = server.stdin, server.stdout

        def run(*command: str) -> None:
            asked.write(json.dumps(command) + "\n")
            asked.flush()
            assert answered.readline() == "0\n", errors.read_text()

        try:
            yield run
        finally:
            server.kill()


if __name__ == "__main__":
    serve()
