"""``slamhive`` commands in processes of their own, forked from one that has imported what commands use.

Run as a program, it carries out one command for each line: arguments, environment, and files for the output, as JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.forking import forked, serve

Run = Callable[[Sequence[str], Mapping[str, str]], "subprocess.CompletedProcess[str]"]
"""Carries out the command with these arguments in this environment."""


@contextmanager
def forked_commands() -> Iterator[Run]:
    """Yields what carries out one command, as ``python -m slamhive`` in the folder of the checkout would."""
    with forked("-m", "tests.forked_commands") as work, tempfile.TemporaryDirectory() as folder:
        files = [Path(folder) / name for name in ("stdout", "stderr")]

        def run(arguments: Sequence[str], environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
            ended = work(json.dumps([list(arguments), dict(environment), list(map(str, files))]))
            code = ended.returncode or ended.value
            return subprocess.CompletedProcess(arguments, code, *(path.read_text() for path in files))

        yield run


def carry_out(line: str) -> int:
    """Become the command that the line describes; returns its exit code."""
    arguments, environment, outputs = json.loads(line)
    for descriptor, path in enumerate((os.devnull, *outputs)):
        flags = os.O_RDONLY if descriptor == 0 else os.O_WRONLY | os.O_CREAT | os.O_TRUNC
        os.dup2(os.open(path, flags, 0o644), descriptor)
    os.environ.clear()
    os.environ.update(environment)
    paths = environment.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:0] = [path for path in paths if path not in sys.path]
    from slamhive.cli import main  # noqa: PLC0415 - after the environment is set

    try:
        main(arguments, prog_name="slamhive")
    except SystemExit as ended:
        return ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
    return 0


if __name__ == "__main__":
    # SLAM Hive asks for plug-ins when it first uses a registry, so each process finds its own.
    serve(carry_out, without="slamhive_")
