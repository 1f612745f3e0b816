"""The worker: claims queued runs, takes each to its end, and evaluates those that succeeded."""

from __future__ import annotations

from slamhive.services.worker.lock import WorkerLock
from slamhive.services.worker.process import WorkerProcess
from slamhive.services.worker.worker import Worker

__all__ = [
    "Worker",
    "WorkerLock",
    "WorkerProcess",
]
