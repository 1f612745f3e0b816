"""The seam between evaluations and what runs them: a process in this package, a container in ``executors``."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

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
class Batch:
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

    def run_batch(self, batch: Batch, on_line: LineCallback, stopping: threading.Event) -> str | None:
        """Run the batch and pass each line of its standard output to ``on_line``. End it when ``stopping`` is set.

        Returns None if it ended well, otherwise one line that says how it ended. Raises Unavailable if it cannot be
        started.
        """
