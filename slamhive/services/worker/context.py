"""Objects that all run drivers of a worker share."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime

from slamhive.clock import utc_now
from slamhive.domain.protocol import Protocol
from slamhive.errors import SlamHiveError
from slamhive.executors.base import Executor
from slamhive.services.datasets import Catalogue, Variants
from slamhive.services.worker.other_cpus import OtherCpus
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.records import RunRecord


class WorkerStopping(SlamHiveError):
    """The worker is stopping; the run continues, and the next worker adopts it."""


@dataclass(frozen=True)
class DriverContext:
    """Objects that all run drivers of a worker share."""

    settings: Settings
    store: Store
    catalogue: Catalogue
    executors: Callable[[str], Executor]
    owner: str
    stopping: threading.Event
    still_held: Callable[[int], bool]
    cancel_requested: Callable[[int], bool]
    protocol_of: Callable[[RunRecord], Protocol]
    variants: Variants
    other_cpus: OtherCpus = field(default_factory=OtherCpus)
    now: Callable[[], datetime] = utc_now
