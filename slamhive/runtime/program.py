"""The end of a run's program, and work that may crash or hang in a child process."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable

from slamhive.base.errors import SlamHiveError
from slamhive.runtime.paths import RunPaths, run_paths

_LOOK_EVERY_S = 0.01


def run_program(work: Callable[[RunPaths], None]) -> int:
    """Do ``work`` on the paths of this run; returns the exit code. Each known error is one line on stderr."""
    try:
        work(run_paths())
    except SlamHiveError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)  # noqa: T201 - the program's own output
        return 1
    return 0


def done_by_child(work: Callable[[], object], limit_s: float) -> bool:
    """Tell if a copy of this process did ``work`` without an error within ``limit_s``; a slower one is killed."""
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            work()
            code = 0
        finally:  # An exception must not go on in a second copy of the program.
            os._exit(code)
    end_s = time.monotonic() + limit_s
    while time.monotonic() < end_s:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status == 0
        time.sleep(_LOOK_EVERY_S)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False
