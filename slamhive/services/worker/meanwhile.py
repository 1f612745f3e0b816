"""A worker in a thread of a process that waits for runs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from slamhive.errors import Conflict
from slamhive.services.worker.worker import Worker

TAKE_OVER_S = 1.0
WORKED_ON = 500
"""Runs of an experiment that such a worker takes on at a time."""


class WorkingMeanwhile:
    """Works on the given runs whenever no other worker of this machine does, within a ``with`` statement.

    Args:
        make_worker: Makes a worker for some runs.
        run_ids: The runs; asked again each time there may be work.
    """

    def __init__(self, make_worker: Callable[[Sequence[int]], Worker], run_ids: Callable[[], Sequence[int]]) -> None:
        self._make_worker = make_worker
        self._run_ids = run_ids
        self._failure: BaseException | None = None
        self._ends = threading.Event()
        self._worker: Worker | None = None
        self._thread = threading.Thread(target=self._work, name="embedded-worker")

    def check(self) -> None:
        """Raise what ended the worker, if anything did: without one, waiting would take forever."""
        if self._failure is not None:
            raise self._failure

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ends.set()
        if self._worker is not None:
            self._worker.stop()
        self._thread.join()
        if kind is None:
            self.check()

    def _work(self) -> None:
        while not self._ends.is_set():
            try:
                self._worker = self._make_worker(self._run_ids())
                self._worker.run(until_idle=True)
            except Conflict:
                pass  # another worker has the machine; it may take these runs, or end without
            except BaseException as error:  # noqa: BLE001 - handed to the waiting thread
                self._failure = error
                return
            self._ends.wait(TAKE_OVER_S)
