"""An HTTP server for a WSGI application: waitress with bounds, which can be ended."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
from collections.abc import Callable
from typing import Any

import waitress
from waitress import wasyncore
from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser, ParsingError

from slamhive.errors import InvalidInput, Unavailable

_WAKE_S = 1.0
_RECEIVED_BYTES = 65_536
"""Taken from a connection at a time. With the 8 KiB of waitress, a part of an upload takes a thousand turns."""


def listen(host: str, port: int, asked: str = "--port") -> socket.socket:
    """A socket that listens; port 0 selects a free one. ``asked`` is where the user chose it.

    Raises Unavailable if the address is in use, InvalidInput if this machine does not have it.
    """
    if not 0 <= port <= 65535:
        raise InvalidInput(f"port {port} is not valid", f"choose a {asked} from 1 to 65535")
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        return socket.create_server((host, port), family=family, backlog=128)
    except OSError as error:
        raise _explained(error, f"{port} on {host}", asked) from None


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


class HttpServer:
    """:meth:`run` serves until :meth:`close`.

    Args:
        app: The application.
        listener: What :func:`listen` returned.
        options: Further ones of ``waitress.create_server``.
    """

    def __init__(self, app: Any, listener: socket.socket, **options: Any) -> None:
        self._connections: dict[int, Any] = {}
        self._server: Any = waitress.create_server(
            app, map=self._connections, sockets=[listener], ident="slamhive", recv_bytes=_RECEIVED_BYTES, **options
        )
        self._server.channel_class = _Channel
        self._ended = threading.Event()
        host, port = listener.getsockname()[:2]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"

    def run(self, before_the_end: Callable[[], None] = lambda: None) -> None:
        """Serve requests until :meth:`close`; then, after ``before_the_end``, close all connections."""
        while not self._ended.is_set():
            wasyncore.loop(timeout=_WAKE_S, map=self._connections, use_poll=True, count=1)
        before_the_end()
        self._server.task_dispatcher.shutdown()
        wasyncore.close_all(self._connections)

    def close(self) -> None:
        """End :meth:`run`. Safe to call from any thread, and repeatedly."""
        self._ended.set()
        with contextlib.suppress(OSError):  # already closed
            self._server.pull_trigger()


def _explained(error: OSError, place: str, asked: str) -> InvalidInput | Unavailable:
    if error.errno == errno.EADDRINUSE:
        return Unavailable(f"port {place} is in use", f"stop the other program, or choose another {asked}")
    if error.errno == errno.EACCES:
        return Unavailable(f"port {place} is not allowed for this user", f"choose a {asked} above 1023")
    return InvalidInput(f"cannot bind to port {place}: {error.strerror or error}", "choose another address")
