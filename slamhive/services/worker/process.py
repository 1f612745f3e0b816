"""A worker in a process of its own, beside the web server."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from types import TracebackType
from typing import Self

from slamhive.settings import ENVIRONMENT_PREFIX, Settings

END_S = 15.0


class WorkerProcess:
    """Starts ``slamhive worker`` on entry and ends it on exit; its runs go on and are found by the next worker.

    Args:
        settings: The worker's data root and database.
        wanted: False does nothing. A worker that runs already goes first, this one stands by.
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
            # A session of its own: Ctrl-C reaches the server, which then ends the worker in order.
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
