"""An HTTP server for a WSGI application: waitress with bounds, which can be ended."""

from __future__ import annotations

import contextlib
import errno
import logging
import socket
import threading
import weakref
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from ipaddress import IPv4Address, IPv6Network, ip_address
from typing import Any

from waitress import wasyncore
from waitress.adjustments import Adjustments
from waitress.channel import HTTPChannel
from waitress.parser import HTTPRequestParser, ParsingError
from waitress.server import TcpWSGIServer
from waitress.task import ThreadedTaskDispatcher
from waitress.utilities import Error

from slamhive.base.budget import RETRY_AFTER_S, Budget, BudgetShare, Lent
from slamhive.base.clock import monotonic_s
from slamhive.base.errors import InvalidInput, Unavailable

logger = logging.getLogger(__name__)

LEAST_BYTES_PER_S = 1000
"""A transfer that is slower is given up: an answer that nobody reads may hold a thread."""
HEALTH_CONNECTIONS = 8
"""Connections beyond the limits, on which this machine may only ask for the health of the server."""
_TURNED_AWAY = b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
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


@dataclass(frozen=True, slots=True)
class ServerLimits:
    """Limits of connections: their number and their time.

    Attributes:
        connections: Most connections of all clients.
        per_client: Most of one client: an IPv4 address, or an IPv6 network of 64 bits.
        exempt: Address of a proxy, which may hold as many for its own clients; ``*`` for any, empty for none.
        health_path: Address that this machine may ask also when the limits are reached or all threads are busy.
        idle_s: How long a connection may stay without a request after an answer.
        head_s: How long the head of a request may take, and how long a client may wait with its first.
        transfer_s: A body or an answer that moves fewer than 1,000 bytes/s for this time is given up.
    """

    connections: int
    per_client: int
    exempt: str = ""
    health_path: str = ""
    idle_s: float = 75.0
    head_s: float = 20.0
    transfer_s: float = 60.0


class _Busy(Error):  # type: ignore[misc]
    """The answer to a request that the server has no room for now."""

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
        self._share: BudgetShare | None = None

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
        # RFC 9112, 6.1: a proxy that believes the other of the two lets one client put requests before those of others.
        if self.chunked and "CONTENT_LENGTH" in self.headers:
            raise ParsingError("a request has Content-Length or Transfer-Encoding, not both")
        if "TRANSFER_ENCODING" in self.headers:  # waitress has taken it out of the requests that may have it
            raise ParsingError("only requests of HTTP/1.1 have Transfer-Encoding")


class _Channel(HTTPChannel):  # type: ignore[misc]
    """A connection that knows how long its client has taken. Only the thread of :meth:`HttpServer.run` closes it."""

    for_health_only = False

    def __init__(self, server: Any, sock: socket.socket, addr: Any, adj: Adjustments, map: Any = None) -> None:  # noqa: A002 - the name is waitress's
        super().__init__(server, sock, addr, adj, map)
        self.parser_class = partial(_Parser, server.budget)
        self.client = client_of(addr[0])
        self.is_local = self.client.is_loopback
        self.waits_since_s = monotonic_s()
        """When it was opened, or its last request answered."""
        self._answered = 0
        self._head_since_s = self.waits_since_s
        self._moved_bytes = 0
        self._transfer: tuple[float, int] | None = None
        """When the rate of the transfer was last looked at, and how much had moved then."""

    def received(self, data: bytes) -> bool:
        """Take what the client sent."""
        self._moved_bytes += len(data)
        if self.request is None:
            self._head_since_s = monotonic_s()
        return bool(super().received(data))

    def send(self, data: bytes, do_close: bool = True) -> int:
        """Send, and count."""
        sent: int = super().send(data, do_close)
        self._moved_bytes += sent
        return sent

    def service(self) -> None:
        """Answer one request, in a thread of the server."""
        super().service()
        self._answered += 1
        self.waits_since_s = monotonic_s()

    def del_channel(self, map: dict[int, Any] | None = None) -> None:  # noqa: A002 - its name in waitress
        """Forget a connection that is closed, by whoever; what has arrived of a request goes."""
        super().del_channel(map)
        if self.request is not None:
            self.request.close()

    @property
    def can_go(self) -> bool:
        """Return whether nothing is lost with it: no request has arrived yet, or all are answered."""
        return not self.requests and not self.total_outbufs_len and not self._in_body

    @property
    def _in_body(self) -> bool:
        return self.request is not None and self.request.headers_finished

    def is_overdue(self, now_s: float, limits: ServerLimits) -> bool:
        """Return whether the client takes too long with a request, an answer or nothing. To be asked often."""
        if self.total_outbufs_len or (self._in_body and not self.requests):
            since_s, moved_before = self._transfer or (now_s, self._moved_bytes)
            took_s, moved = now_s - since_s, self._moved_bytes - moved_before
            if self._transfer is None or took_s > limits.transfer_s:
                self._transfer = now_s, self._moved_bytes
            return took_s > limits.transfer_s and moved < LEAST_BYTES_PER_S * took_s
        self._transfer = None
        if self.requests:
            return False
        if self.request is not None:
            return now_s - self._head_since_s > limits.head_s
        return now_s - self.waits_since_s > (limits.idle_s if self._answered else limits.head_s)


class _Server(TcpWSGIServer):  # type: ignore[misc]
    """Waitress's server with limits for each client.

    Waitress stops accepting at its limit, so whoever opens that many connections shuts out everybody. Here a newcomer
    takes the place of a connection that waits for a request. It is one of the same client if that has too many, else of
    the client with most that wait. Where none waits, the newcomer is turned away.
    """

    def __init__(
        self, app: Any, listener: socket.socket, limits: ServerLimits, budget: Budget, connections: Any, **options: Any
    ) -> None:
        self.budget = budget
        most_open = limits.connections + HEALTH_CONNECTIONS
        # Beyond ours, so that it never holds: waitress counts listener and trigger too.
        adjustments = Adjustments(sockets=[listener], connection_limit=2 * most_open + 100, **options)
        dispatcher = ThreadedTaskDispatcher()
        dispatcher.set_thread_count(adjustments.threads)
        self._limits = limits
        self._for_health = ThreadedTaskDispatcher()
        self._for_health.set_thread_count(1 if limits.health_path else 0)
        sockinfo = (listener.family, listener.type, listener.proto, listener.getsockname())
        super().__init__(
            app, connections, True, listener, dispatcher, adjustments, sockinfo=sockinfo, bind_socket=False
        )

    def handle_accept(self) -> None:
        """Accept a connection, for which another may have to go."""
        self.channel_class = self._admitted  # a factory, which waitress calls with what it accepted
        super().handle_accept()

    def _admitted(self, _server: Any, sock: socket.socket, addr: Any, adj: Adjustments, **more: Any) -> None:
        client, limits = client_of(addr[0]), self._limits
        channels: list[_Channel] = list(self.active_channels.values())
        rivals = [channel for channel in channels if channel.client == client]
        if limits.exempt in {"*", addr[0]} or len(rivals) < limits.per_client:
            rivals = channels if len(channels) >= limits.connections else []
        # The one that has waited longest, of the client with most that wait, is missed least. None can go if all work.
        waiting = [channel for channel in rivals if channel.can_go]
        count = Counter(channel.client for channel in waiting)
        leaving = min(waiting, key=lambda channel: (-count[channel.client], channel.waits_since_s), default=None)
        if leaving is not None:
            leaving.handle_close()
        crowded = bool(rivals) and leaving is None
        room_for_health = sum(channel.for_health_only for channel in channels) < HEALTH_CONNECTIONS
        if crowded and not (limits.health_path and client.is_loopback and room_for_health):
            logger.warning("a connection of %s is turned away: %d are open, all at work", client, len(channels))
            with contextlib.suppress(OSError):
                sock.send(_TURNED_AWAY)
            sock.close()
            return
        _Channel(self, sock, addr, adj, **more).for_health_only = crowded

    def add_task(self, task: _Channel) -> None:
        """Have a request answered: that for the health of the server in a thread of its own, if it comes from here."""
        request = task.requests[0]
        asks_health = task.is_local and request.error is None and request.path == self._limits.health_path
        if task.for_health_only and not asks_health:
            request.error = _Busy("too many connections are open; try again later")
        (self._for_health if asks_health or task.for_health_only else self.task_dispatcher).add_task(task)

    def maintenance(self, now: float) -> None:
        """Nothing: waitress would close by another clock than :meth:`close_overdue`, and never an answer unread."""

    def close_overdue(self) -> None:
        """Close connections whose clients take too long."""
        now_s = monotonic_s()
        for channel in list(self.active_channels.values()):
            if channel.is_overdue(now_s, self._limits):
                channel.handle_close()

    def end(self) -> None:
        """Wait some seconds for requests at work, drop the others, and close all connections with their buffers."""
        self.task_dispatcher.shutdown()
        self._for_health.shutdown()
        for channel in list(self.active_channels.values()):
            channel.handle_close()


def client_of(address: str) -> IPv4Address | IPv6Network:
    """The client behind an address: one household or office has an IPv4 address, or 2^64 addresses of IPv6."""
    found = ip_address(address.partition("%")[0])
    if isinstance(found, IPv4Address):
        return found
    return found.ipv4_mapped or IPv6Network((found, 128 if found.is_loopback else 64), strict=False)


class HttpServer:
    """:meth:`run` serves until :meth:`close`.

    Args:
        app: The application.
        listener: What :func:`listen` returned.
        limits: For its connections.
        budget: What bodies of requests are taken out of; None for no limit but that of each.
        options: Further ones of ``waitress.Adjustments``.
    """

    def __init__(
        self, app: Any, listener: socket.socket, limits: ServerLimits, budget: Budget | None = None, **options: Any
    ) -> None:
        self._connections: dict[int, Any] = {}
        self._server = _Server(
            app,
            listener,
            limits,
            budget or Budget({}),
            self._connections,
            ident="slamhive",
            recv_bytes=_RECEIVED_BYTES,
            inbuf_overflow=_RECEIVED_BYTES,
            **options,
        )
        self._ended = threading.Event()
        host, port = listener.getsockname()[:2]
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{port}"

    def run(self, before_the_end: Callable[[], None] = lambda: None) -> None:
        """Serve requests until :meth:`close`; then, after ``before_the_end``, close all connections."""
        next_look_s = 0.0
        while not self._ended.is_set():
            wasyncore.loop(timeout=_WAKE_S, map=self._connections, use_poll=True, count=1)
            if monotonic_s() >= next_look_s:
                self._server.close_overdue()
                next_look_s = monotonic_s() + _WAKE_S
        before_the_end()
        self._server.end()
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
