"""A worker in a separate process, beside the web server."""

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
