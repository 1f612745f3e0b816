"""An HTTP server for a WSGI application: waitress with bounds, which can be ended."""

from __future__ import annotations

import contextlib
import errno
import socket
import threading
import weakref
from collections.abc import Callable
from functools import partial
from http import HTTPStatus
from typing import Any

import waitress
from waitress import wasyncore
from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser, ParsingError
from waitress.utilities import Error

from slamhive.budget import RETRY_AFTER_S, Budget, Lent, Share
from slamhive.errors import InvalidInput, Unavailable

_WAKE_S = 1.0
_RECEIVED_BYTES = 65_536
"""Taken from a connection at a time, and kept of a body in memory before it goes into a temporary file.

With the 8 KiB of waitress, a part of an upload takes a thousand turns; with its 512 KiB, 200 connections take 100 MB.
"""


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


class _Busy(Error):  # type: ignore[misc]
    """The answer to a request whose body the server has no room for."""

    code, reason = HTTPStatus.SERVICE_UNAVAILABLE.value, HTTPStatus.SERVICE_UNAVAILABLE.phrase

    def to_response(self, ident: str | None = None) -> tuple[str, list[tuple[str, str]], bytes]:
        """Status, headers and body."""
        status, headers, body = super().to_response(ident)
        return status, [*headers, ("Retry-After", str(RETRY_AFTER_S))], body


class _Parser(HTTPRequestParser):  # type: ignore[misc]
    """Waitress's parser, which answers malformed requests instead of closing the connection with a traceback.

    The bodies of all requests together, which waitress keeps in temporary files, take no more than the budget lends.
    """

    error: Any

    def __init__(self, budget: Budget, adj: Any) -> None:
        super().__init__(adj)
        self._budget = budget
        self._share: Share | None = None

    def received(self, data: bytes) -> int:
        """Take some bytes of a request; how many of them belong to it."""
        before: int = self.body_bytes_received
        consumed: int = super().received(data)
        if self.body_bytes_received > before and not self.error:
            if self._share is None:
                self._share = self._budget.open_share("the body of a request")
                # Requests that wait behind another one are dropped without being closed when their connection breaks.
                weakref.finalize(self, self._share.give_back)
            try:
                self._share.take(Lent.DISK, self.body_bytes_received - before)
            except (Unavailable, InvalidInput) as error:
                self.error, self.completed = _Busy(str(error)), True
        return consumed

    def close(self) -> None:
        """Remove the body; the request has been answered."""
        super().close()
        if self._share is not None:
            self._share.give_back()

    def parse_header(self, header_plus: bytes) -> None:
        """Parse the head of a request. Python rejects some addresses and lengths that waitress passes on."""
        try:
            super().parse_header(header_plus)
        except ValueError:
            raise ParsingError("the head of the request is malformed") from None


class _Channel(HTTPChannel):  # type: ignore[misc]
    def del_channel(self, map: dict[int, Any] | None = None) -> None:  # noqa: A002 - its name in waitress
        """Forget a connection that is closed, by whoever; what has arrived of a request goes."""
        super().del_channel(map)
        if self.request is not None:
            self.request.close()


class HttpServer:
    """:meth:`run` serves until :meth:`close`.

    Args:
        app: The application.
        listener: What :func:`listen` returned.
        budget: What bodies of requests are taken out of; None for no limit but that of each.
        options: Further ones of ``waitress.create_server``.
    """

    def __init__(self, app: Any, listener: socket.socket, budget: Budget | None = None, **options: Any) -> None:
        self._connections: dict[int, Any] = {}
        self._server: Any = waitress.create_server(
            app,
            map=self._connections,
            sockets=[listener],
            ident="slamhive",
            recv_bytes=_RECEIVED_BYTES,
            inbuf_overflow=_RECEIVED_BYTES,
            **options,
        )
        parser = partial(_Parser, budget or Budget({}))
        self._server.channel_class = type("_BudgetedChannel", (_Channel,), {"parser_class": parser})
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
