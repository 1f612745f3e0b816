"""The web server: waitress, with live streams that end with it."""

from __future__ import annotations

import contextlib
import logging
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any, cast

from slamhive.base.budget import Budget
from slamhive.base.http_server import HttpServer, ServerLimits, listen
from slamhive.services.hive import Hive
from slamhive.services.stored_analyses import AnalysisComputer
from slamhive.web.app import BODY_LIMITS, MOST_STREAMS, MOST_UPLOAD_BYTES, create_app
from slamhive.web.context import BUDGET_EXTENSION, COMPUTER_EXTENSION, LIVE_EXTENSION
from slamhive.web.live import LiveHub

THREADS = MOST_STREAMS + 8
"""Each live stream occupies a thread; eight stay free for pages."""
MOST_CONNECTIONS = 200

logger = logging.getLogger(__name__)


class WebServer:
    """A server bound to its address; :meth:`run` serves until :meth:`close` or a signal.

    Raises Unavailable if the address is in use, InvalidInput if this machine does not have it.

    Args:
        hive: The services.
        host: Address to bind to.
        port: Port to bind to; 0 selects a free one, see ``url``.
    """

    def __init__(self, hive: Hive, host: str, port: int) -> None:
        listener = listen(host, port)
        app = create_app(hive, host)
        headers: dict[str, Any] = {}  # without a trusted proxy, waitress believes none
        if hive.settings.trusted_proxy:
            forwarded = {"x-forwarded-for", "x-forwarded-host", "x-forwarded-proto"}
            headers = {"trusted_proxy": hive.settings.trusted_proxy, "trusted_proxy_count": 1}
            headers["trusted_proxy_headers"] = forwarded
        self._hub = cast("LiveHub", app.extensions[LIVE_EXTENSION])
        self._computer = cast("AnalysisComputer | None", app.extensions[COMPUTER_EXTENSION])
        self.budget = cast("Budget", app.extensions[BUDGET_EXTENSION])
        self._server = HttpServer(
            app,
            listener,
            ServerLimits(
                MOST_CONNECTIONS,
                hive.settings.connections_per_address,
                hive.settings.trusted_proxy,
                health_path="/healthz",
            ),
            self.budget,
            threads=THREADS,
            max_request_body_size=max(BODY_LIMITS.values()) + MOST_UPLOAD_BYTES,
            **headers,
        )
        self.url = self._server.url

    def run(self) -> None:
        """Serve requests until SIGINT or SIGTERM (in the main thread) or :meth:`close`."""
        if self._computer is not None:
            self._computer.wake()
        with self._ended_by_signals():
            self._server.run(before_the_end=self._hub.close)
        if self._computer is not None:
            self._computer.close()

    def close(self) -> None:
        """End :meth:`run`. Safe to call from any thread, and repeatedly."""
        self._server.close()
        self._hub.close()

    @contextlib.contextmanager
    def _ended_by_signals(self) -> Iterator[None]:
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def end(_number: int, _frame: FrameType | None) -> None:
            self.close()

        before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def serve(hive: Hive, host: str, port: int) -> None:
    """Serve the pages until the process is stopped."""
    server = WebServer(hive, host, port)
    logger.info("serving %s", server.url)
    server.run()
