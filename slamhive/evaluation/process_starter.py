"""Run a batch of evaluations in a plain process of its own."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from slamhive.errors import Unavailable
from slamhive.evaluation.batch import PARENT_VARIABLE, Batch, LineCallback
from slamhive.evaluation.line_feed import LineFeed

_GRACE_S = 5.0
_KEPT_ENVIRONMENT = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "SYSTEMROOT")


class ProcessStarter:
    """Starts ``evaluation/evaluate.py`` with the Python of this process, in a process group of its own.

    Args:
        project_root: The folder that holds ``evaluation/``.
    """

    isolated = False

    def __init__(self, project_root: Path) -> None:
        self._script = project_root / "evaluation" / "evaluate.py"

    def prepare(self, progress: LineCallback) -> None:
        """Nothing to do: the batch uses the packages of this process."""

    def run_batch(self, batch: Batch, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Run the batch to its end; see :class:`~slamhive.evaluation.batch.BatchStarter`."""
        log_path = batch.scratch / "stderr.txt"
        try:
            with log_path.open("wb") as log, _thread_bound_to(batch.cores):
                process = subprocess.Popen(
                    [sys.executable, str(self._script), batch.job],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=_environment(batch.scratch),
                    start_new_session=True,
                )
        except OSError as error:
            raise Unavailable(f"the evaluation cannot be started: {error}", "check memory, space and rights") from None
        ended = _follow(process, batch.timeout_s, on_line, stopping)
        return ended or _how_it_ended(process.returncode, log_path)


def _environment(home: Path) -> dict[str, str]:
    """A private HOME, since evo writes settings into it, and the path to our own packages."""
    environment = {name: os.environ[name] for name in _KEPT_ENVIRONMENT if name in os.environ}
    package_parent = str(Path(__file__).resolve().parent.parent.parent)
    paths = [package_parent, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    own = {"HOME": str(home), "TMPDIR": str(home), "PYTHONPATH": os.pathsep.join(paths)}
    return environment | own | {PARENT_VARIABLE: str(os.getpid())}


def _follow(
    process: subprocess.Popen[bytes], timeout_s: float, on_line: LineCallback, stopping: threading.Event
) -> str | None:
    """Pass on lines until the process has ended; end it on timeout or when ``stopping`` is set."""
    assert process.stdout is not None
    feed = LineFeed(_lines_of(process.stdout))
    ended: str | None = "it was not followed to its end"
    try:
        ended = feed.follow(timeout_s, on_line, stopping)
    finally:
        _end_group(process, already_ending=ended is None)
        feed.drain(_GRACE_S, on_line)
        process.stdout.close()
    return ended


def _lines_of(stream: IO[bytes]) -> Iterator[str]:
    with contextlib.suppress(ValueError):  # closed under us after the process group was ended
        for line in stream:
            yield line.decode("utf-8", errors="replace")


@contextlib.contextmanager
def _thread_bound_to(cores: tuple[int, ...] | None) -> Iterator[None]:
    """Bind only this thread, so that a process that it starts is bound from its first instruction."""
    if cores is None:
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _end_group(process: subprocess.Popen[bytes], *, already_ending: bool) -> None:
    """Wait for a process that closed its output; end one that did not, with its children."""
    if not already_ending:
        _signal_group(process, signal.SIGTERM)
    try:
        process.wait(timeout=_GRACE_S)
    except subprocess.TimeoutExpired:
        pass
    finally:
        _signal_group(process, signal.SIGKILL)
        process.wait()


def _signal_group(process: subprocess.Popen[bytes], number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, number)


def _how_it_ended(exit_code: int, log_path: Path) -> str | None:
    if exit_code == 0:
        return None
    lines = log_path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last_words = f": {lines[-1]}" if lines else ""
    if exit_code < 0:
        return f"it was killed by {signal.Signals(-exit_code).name}{last_words}"
    return f"exit code {exit_code}{last_words}"
