"""Workers beside other work: in a process beside the web server, or in a thread of a command that waits for runs."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from slamhive.base.errors import Conflict
from slamhive.base.settings import ENVIRONMENT_PREFIX, Settings
from slamhive.services.worker.worker import Worker

END_S = 15.0
TAKE_OVER_S = 1.0
WORKED_ON = 500
"""Runs of an experiment that a worker in a thread takes on at a time."""


class WorkerProcess:
    """Starts ``slamhive worker`` on entry and ends it on exit; its runs continue, and the next worker adopts them.

    Args:
        settings: The worker's data root and database.
        wanted: False starts no worker. If another worker is running, this one waits for its end.
    """

    def __init__(self, settings: Settings, *, wanted: bool) -> None:
        self._settings = settings
        self._wanted = wanted
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        if self._wanted:
            environment = {
                **os.environ,
                f"{ENVIRONMENT_PREFIX}DATA": str(self._settings.data),
                f"{ENVIRONMENT_PREFIX}DATABASE_URL": self._settings.database_url,
            }
            # A separate session: Ctrl-C reaches the server only, which then stops the worker.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "slamhive", "worker", "--patient"], env=environment, start_new_session=True
            )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is None:
            return
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class WorkingMeanwhile:
    """Works in a thread on the given runs whenever no other worker of this machine does, within a ``with`` statement.

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
