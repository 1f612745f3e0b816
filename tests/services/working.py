"""Workers in a thread of the test, and how often they have executed a run."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tests.services.tiny_project import executions

if TYPE_CHECKING:
    from slamhive.services.hive import Hive


@contextmanager
def working(hive: Hive) -> Iterator[None]:
    """A worker meanwhile."""
    worker = hive.worker()
    thread = threading.Thread(target=worker.run, kwargs={"until_idle": True})
    thread.start()
    try:
        yield
    finally:
        worker.stop()
        thread.join()


def started_times(hive: Hive, run_id: int) -> int:
    """How many times a run of the test algorithm was executed."""
    return executions(hive.runs.folder(run_id).result)
