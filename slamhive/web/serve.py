"""The web server: waitress, with live streams that end with it."""

from __future__ import annotations

import contextlib
import errno
import logging
import signal
import socket
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any, cast

import waitress
from waitress import wasyncore
from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser, ParsingError

from slamhive.errors import InvalidInput, Unavailable
from slamhive.services.hive import Hive
from slamhive.web.analysis_computer import AnalysisComputer
from slamhive.web.app import BODY_LIMITS, MOST_STREAMS, MOST_UPLOAD_BYTES, create_app
from slamhive.web.context import COMPUTER_EXTENSION, LIVE_EXTENSION
from slamhive.web.live import LiveHub

THREADS = MOST_STREAMS + 8
"""Each live stream occupies a thread; eight stay free for pages."""
MOST_CONNECTIONS = 200
RECEIVED_BYTES = 65_536
"""Taken from a connection at a time. With the 8 KiB of waitress, a part of an upload takes a thousand turns."""

WAKE_S = 1.0

logger = logging.getLogger(__name__)


class _Parser(HTTPRequestParser):  # type: ignore[misc]
    """Waitress's parser, which answers malformed requests instead of closing the connection with a traceback."""

    def parse_header(self, header_plus: bytes) -> None:
        """Parse the head of a request. Python rejects some addresses and lengths that waitress passes on."""
        try:
            super().parse_header(header_plus)
        except ValueError:
            raise ParsingError("the head of the request is malformed") from None


class _Channel(HTTPChannel):  # type: ignore[misc]
    parser_class = _Parser


class WebServer:
    """A server bound to its address; :meth:`run` serves until :meth:`close` or a signal.

    Raises Unavailable if the address is in use, InvalidInput if this machine does not have it.

    Args:
        hive: The services.
        host: Address to bind to.
        port: Port to bind to; 0 selects a free one, see ``url``.
    """

    def __init__(self, hive: Hive, host: str, port: int) -> None:
        listener = _bind(host, port)
        app = create_app(hive, host)
        self._hub = cast("LiveHub", app.extensions[LIVE_EXTENSION])
        self._computer = cast("AnalysisComputer | None", app.extensions[COMPUTER_EXTENSION])
        self._connections: dict[int, Any] = {}
        self._server: Any = waitress.create_server(
            app,
            map=self._connections,
            sockets=[listener],
            threads=THREADS,
            connection_limit=MOST_CONNECTIONS,
            recv_bytes=RECEIVED_BYTES,
            max_request_body_size=max(BODY_LIMITS.values()) + MOST_UPLOAD_BYTES,
            ident="slamhive",
            **_proxy_options(hive.settings.trusted_proxy),
        )
        self._server.channel_class = _Channel
        self._ended = threading.Event()
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}"

    def run(self) -> None:
        """Serve requests until SIGINT or SIGTERM (in the main thread) or :meth:`close`."""
        if self._computer is not None:
            self._computer.wake()
        with self._ended_by_signals():
            while not self._ended.is_set():
                wasyncore.loop(timeout=WAKE_S, map=self._connections, use_poll=True, count=1)
            self._hub.close()
            self._server.task_dispatcher.shutdown()
            wasyncore.close_all(self._connections)
        if self._computer is not None:
            self._computer.close()

    def close(self) -> None:
        """End :meth:`run`. Safe to call from any thread, and repeatedly."""
        self._ended.set()
        self._hub.close()
        with contextlib.suppress(OSError):  # already closed
            self._server.pull_trigger()

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


def _proxy_options(trusted: str) -> dict[str, Any]:
    """What waitress believes of headers that say who is behind a proxy; without a trusted proxy, nothing."""
    if not trusted:
        return {}
    headers = {"x-forwarded-for", "x-forwarded-host", "x-forwarded-proto"}
    return {"trusted_proxy": trusted, "trusted_proxy_count": 1, "trusted_proxy_headers": headers}


def _bind(host: str, port: int) -> socket.socket:
    if not 0 <= port <= 65535:
        raise InvalidInput(f"port {port} is not valid", "choose a --port from 1 to 65535")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise _explained(error, host, port) from None


def _explained(error: OSError, host: str, port: int) -> InvalidInput | Unavailable:
    if error.errno == errno.EADDRINUSE:
        return Unavailable(f"port {port} on {host} is in use", "stop the other program, or choose another --port")
    if error.errno == errno.EACCES:
        return Unavailable(f"port {port} on {host} is not allowed for this user", "choose a --port above 1023")
    return InvalidInput(f"cannot bind to {host}:{port}: {error.strerror or error}", "choose another --host or --port")
