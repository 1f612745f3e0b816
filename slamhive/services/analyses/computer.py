"""Computes analyses where no worker runs, as on a view-only server: one thread, one process at a time."""

from __future__ import annotations

import logging
import threading

from slamhive.errors import SlamHiveError
from slamhive.executors.identity import owner_is_dead, worker_identity
from slamhive.services.analyses.jobs import AnalysisJobs
from slamhive.store import Store

logger = logging.getLogger(__name__)

IDLE_S = 30.0
TROUBLE_S = 5.0


class AnalysisComputer:
    """Takes analyses from the queue as a worker does. The thread starts with the first :meth:`wake`.

    Args:
        store: The queue.
        jobs: What computes an analysis of the queue.
    """

    def __init__(self, store: Store, jobs: AnalysisJobs) -> None:
        self._store = store
        self._jobs = jobs
        self._owner = worker_identity()
        self._asked = threading.Event()
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def wake(self) -> None:
        """Look for work now."""
        self._asked.set()
        with self._lock:
            if self._thread is None and not self._stopping.is_set():
                self._thread = threading.Thread(target=self._work, name="slamhive-analyses", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Stop. The analysis in progress returns to the queue."""
        self._stopping.set()
        self._asked.set()
        with self._lock:
            thread = self._thread
        if thread is not None:
            thread.join()

    def _work(self) -> None:
        self._free_what_the_dead_hold()
        while not self._stopping.is_set():
            self._asked.clear()
            try:
                while not self._stopping.is_set() and self._jobs.work_once(self._owner, self._stopping):
                    pass
            except SlamHiveError as error:
                logger.warning("analyses: %s; retrying in %.0f s", error, TROUBLE_S)
                self._stopping.wait(TROUBLE_S)
                continue
            except Exception:
                logger.exception("unexpected error while computing analyses; retrying in %.0f s", TROUBLE_S)
                self._stopping.wait(TROUBLE_S)
                continue
            self._asked.wait(IDLE_S)

    def _free_what_the_dead_hold(self) -> None:
        try:
            for owner in self._store.read(lambda t: t.analyses.owners()):
                if owner != self._owner and owner_is_dead(owner):
                    self._store.write(lambda t, owner=owner: t.analyses.release_all(owner))  # type: ignore[misc]
        except SlamHiveError as error:
            logger.warning("analyses: %s", error)
