"""The worker: claims queued runs, takes each to its end, and evaluates those that succeeded."""

from __future__ import annotations

from typing import TYPE_CHECKING

from slamhive.base.lazy import lazy_names

if TYPE_CHECKING:
    from slamhive.services.worker.holding import WorkerLock
    from slamhive.services.worker.worker import WORKED_ON, Chores, Worker, WorkerProcess, WorkingMeanwhile


if not TYPE_CHECKING:
    __getattr__ = lazy_names(__name__)
