"""Run a batch of evaluations in a plain process of its own."""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

from slamhive.base.errors import Unavailable

# The seam between evaluations and what runs them: a process in this package, a container in ``executors``.


IMAGE = "slam-hive-evaluation:evo"
"""The evaluation image; its entry script is started with the job file as its only argument."""

PARENT_VARIABLE = "SLAMHIVE_EVALUATION_PARENT"
"""Holds the pid of the process that started the batch. The batch ends when that process does."""

LineCallback = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class BatchMount:
    """A file or folder of the host, and its path inside the batch."""

    source: Path
    target: str
    read_only: bool


@dataclass(frozen=True, slots=True)
class EvaluationBatch:
    """One start of the evaluation.

    Attributes:
        job: Path of ``job.json`` inside the batch, the argument of the entry script.
        mounts: Files and folders that the batch needs. If the starter is not isolated, every target is its source.
        scratch: A folder of the host for temporary files of the starter.
        timeout_s: The batch is ended after this time.
        cores: The numbers of the cores that it may use, None for all. Runs are measured on the others.
    """

    job: str
    mounts: tuple[BatchMount, ...]
    scratch: Path
    timeout_s: float
    cores: tuple[int, ...] | None = None


class BatchStarter(Protocol):
    """One way to run a batch.

    ``isolated``: the batch sees mount targets (a container) instead of the paths of the host (a process).
    """

    isolated: bool

    def prepare(self, progress: LineCallback) -> None:
        """Make what every batch needs unless it exists; ``progress`` takes lines that say what happens.

        :meth:`run_batch` does the same first. Raises SlamHiveError if it fails.
        """

    def run_batch(self, batch: EvaluationBatch, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Run the batch and pass each line of its standard output to ``on_line``. End it when ``stopping`` is set.

        Returns None if it ended well, otherwise one line that says how it ended. Raises Unavailable if it cannot be
        started.
        """


# Follows the output of a batch, with a time limit and a way to stop.


_POLL_S = 0.2


class LineFeed:
    """Reads lines in a thread, so that a batch that prints nothing can be ended.

    Args:
        source: The lines. It blocks until there is one, and ends when the batch closes its output.
    """

    def __init__(self, source: Iterable[str]) -> None:
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, args=(source,), daemon=True)
        self._reader.start()

    def follow(self, timeout_s: float, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Pass on lines until they end. Returns None then, otherwise why the batch must be ended."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                line = self._lines.get(timeout=_POLL_S)
            except queue.Empty:
                line = ""
            if line is None:
                return None
            if line:
                on_line(line)
            if stopping.is_set():
                return "it was stopped"
            if time.monotonic() > deadline_s:
                return f"it was still running after {timeout_s:.0f} s"

    def drain(self, patience_s: float, on_line: LineCallback) -> None:
        """Pass on the remaining lines after the batch has ended; waits at most ``patience_s`` for the reader."""
        self._reader.join(patience_s)
        while not self._lines.empty():
            if line := self._lines.get():
                on_line(line)

    def _read(self, source: Iterable[str]) -> None:
        try:
            for line in source:
                self._lines.put(line)
        finally:
            self._lines.put(None)


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

    def run_batch(self, batch: EvaluationBatch, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Run the batch to its end; see :class:`~slamhive.evaluation.process.BatchStarter`."""
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
        # A process that closed its output is about to end; one that did not is ended, with its children.
        if ended is not None:
            _signal_group(process, signal.SIGTERM)
        try:
            process.wait(timeout=_GRACE_S)
        except subprocess.TimeoutExpired:
            pass
        finally:
            _signal_group(process, signal.SIGKILL)
            process.wait()
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
