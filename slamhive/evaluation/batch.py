"""The seam between a list of evaluations and what runs them: a process here, a container in ``executors``."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

IMAGE = "slam-hive-evaluation:evo"
"""The evaluation image; its entry script is started with the job file as its only argument."""

PARENT_VARIABLE = "SLAMHIVE_EVALUATION_PARENT"
"""Passes the pid of the parent to a batch process; the batch ends when the parent does."""

LineCallback = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class BatchMount:
    """A file or folder of the host, and where the batch sees it."""

    source: Path
    target: str
    read_only: bool


@dataclass(frozen=True, slots=True)
class Batch:
    """One start of the evaluation.

    Attributes:
        job: ``job.json`` as the batch sees it: the argument of the entry script.
        mounts: What the batch needs to see; where ``isolated`` is False every target is its source.
        scratch: A folder of the host for what the starter needs to keep while it runs.
        timeout_s: The batch is ended after this time.
        cores: The numbers of the cores it may use, None for all: runs are measured on the others.
    """

    job: str
    mounts: tuple[BatchMount, ...]
    scratch: Path
    timeout_s: float
    cores: tuple[int, ...] | None = None


class BatchStarter(Protocol):
    """One way of running a batch.

    ``isolated`` says whether the batch sees mount targets (a container) or the host's own paths (a process).
    """

    isolated: bool

    def prepare(self, progress: LineCallback) -> None:
        """Make what every batch needs, unless it is there already; ``progress`` takes one line of what goes on.

        :meth:`run_batch` does so too. Raises SlamHiveError if it cannot be made.
        """

    def run_batch(self, batch: Batch, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Run the batch to its end, handing over each line of its standard output as it comes.

        Ends it when ``stopping`` is set. Returns None if it ended well, else one line that says how it ended. Raises
        Unavailable if it cannot be started at all.
        """
