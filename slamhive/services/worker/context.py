"""What the drivers of one worker share."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from slamhive.clock import utc_now
from slamhive.domain.protocol import Protocol
from slamhive.errors import SlamHiveError
from slamhive.executors.base import Executor
from slamhive.services.datasets import Catalogue, Variants
from slamhive.settings import Settings
from slamhive.store import Store
from slamhive.store.records import RunRecord


class WorkerStopping(SlamHiveError):
    """The worker ends; the run goes on and is adopted by the next worker."""


@dataclass(frozen=True)
class DriverContext:
    """What every driver of a worker shares."""

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
    now: Callable[[], datetime] = utc_now
