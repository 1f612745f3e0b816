"""The worker: claims queued runs, takes each to its end, and evaluates those that succeeded."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.worker.chores import Chores
    from slamhive.services.worker.lock import WorkerLock
    from slamhive.services.worker.meanwhile import WORKED_ON, WorkingMeanwhile
    from slamhive.services.worker.process import WorkerProcess
    from slamhive.services.worker.worker import Worker

__all__ = [
    "WORKED_ON",
    "Chores",
    "Worker",
    "WorkerLock",
    "WorkerProcess",
    "WorkingMeanwhile",
]

if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
