"""A node's connection to the controller. Everything that it asks can be asked again."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import random
import socket
import ssl
import time
from pathlib import Path
from typing import IO, Any, Callable, Dict, Optional, TypeVar
from urllib.parse import quote, urlsplit

from slamhive.executors.node_store.on_node.cache import Item, sha256_of

FROM_HEADER = "X-From"
TOTAL_HEADER = "X-Total"
SHA256_HEADER = "X-SHA256"
OVER = "over"
TOO_LARGE_FOR_PROXY = (
    "a proxy before NODE_ADDRESS takes no pieces of 8 MB (status 413); raise its limit, for example by "
    "client_max_body_size 16m in nginx"
)
_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.2, 10.0
_LONGEST_ERROR_BYTES = 10000

T = TypeVar("T")


class NodeRefused(Exception):
    """The controller said no, and would say it again. ``answer`` holds its words and what else it said.

    ``over`` says that the run is over for it: what the node has of it can go.
    """

    def __init__(self, status: int, answer: Dict[str, Any]) -> None:
        self.status = status
        self.over = bool(answer.get(OVER))
        self.answer = answer
        super().__init__(str(answer.get("error", "the controller refuses with status " + str(status))))


class Away(Exception):
    """The controller does not answer now, or the connection was cut."""


class Connection:
    """Asks the controller about one run. Not safe to share between threads: give each its own :meth:`copy`.

    Args:
        url: The address of the controller, without a path or with the path of a proxy.
        key: The run.
        token: Proves that the caller works for this run.
        timeout_s: After so long without a byte, the controller counts as away.
    """

    def __init__(self, url: str, key: str, token: str, timeout_s: float = 30.0) -> None:
        self._url, self._key, self._token, self._timeout_s = url, key, token, timeout_s
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError("NODE_URL={!r} is no address such as http://HOST:PORT".format(url))
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        self._http = kind(parts.hostname, parts.port, timeout=timeout_s)
        self._root = parts.path.rstrip("/") + "/v1/runs/" + quote(key, safe="") + "/"

    def copy(self) -> Connection:
        """The same for another thread."""
        return Connection(self._url, self._key, self._token, self._timeout_s)

    def ask(
        self, method: str, place: str, body: bytes = b"", headers: Optional[Dict[str, str]] = None
    ) -> Dict[str, Any]:
        """The answer, which is JSON. Raises Refused, Away."""
        answer = self.open(method, place, body, headers)
        try:
            return _content(answer.read())
        except (OSError, http.client.HTTPException) as error:
            self.close()
            raise Away(_words(error)) from None
        finally:
            answer.close()

    def open(
        self, method: str, place: str, body: bytes = b"", headers: Optional[Dict[str, str]] = None
    ) -> http.client.HTTPResponse:
        """The answer, to be read to its end or closed with the connection. Raises Refused, Away."""
        reused = self._http.sock is not None
        try:
            answer = self._send(method, place, body, headers or {})
        except (OSError, http.client.HTTPException) as error:
            self.close()
            if not reused:
                raise Away(_words(error)) from None
            # The controller closes connections that nobody has used for a while.
            try:
                answer = self._send(method, place, body, headers or {})
            except (OSError, http.client.HTTPException) as again:
                self.close()
                raise Away(_words(again)) from None
        if answer.status < 400:
            return answer
        try:
            content = _content(answer.read(_LONGEST_ERROR_BYTES))
        except (OSError, http.client.HTTPException):
            content = {}
        answer.close()
        self.close()
        if answer.status == 413 and "error" not in content:
            raise NodeRefused(413, {"error": TOO_LARGE_FOR_PROXY})
        # 413 and the like are ours. What a proxy says while the controller is down is not about this run.
        if answer.status >= 500 or (answer.status in (404, 408, 429) and "error" not in content):
            raise Away(str(content.get("error", "status " + str(answer.status))))
        raise NodeRefused(answer.status, content)

    def close(self) -> None:
        """Close the connection; the next question opens it again."""
        with contextlib.suppress(OSError):
            self._http.close()

    def _send(self, method: str, place: str, body: bytes, headers: Dict[str, str]) -> http.client.HTTPResponse:
        sent = dict(headers)
        sent["Authorization"] = "Bearer " + self._token
        self._http.request(method, self._root + place, body=body or None, headers=sent)
        return self._http.getresponse()


def unreached_because(url: str, timeout_s: float = 10.0) -> str:
    """Why this machine does not reach the controller; empty if it does. The controller knows no run of this name."""
    connection = Connection(url, "nobody", "none", timeout_s)
    try:
        connection.ask("GET", "wanted")
    except NodeRefused as refused:
        return "" if refused.status == 401 else str(refused)
    except Away as away:
        return str(away)
    finally:
        connection.close()
    return "something else answers there"


def clock_offset(ask: Callable[[], Dict[str, Any]], clock: Callable[[], float] = time.time) -> float:
    """Return the seconds to add to this node's clock to get the controller's; 0 if that is within the uncertainty.

    Args:
        ask: Asks the controller; its answer holds its time as ``time_s``.
        clock: Seconds since 1970 on this node.
    """
    # The answer was given between the two readings, so it is wrong by half of the time between them at most.
    before_s = clock()
    answer = ask()
    after_s = clock()
    offset_s = float(answer["time_s"]) - (before_s + after_s) / 2
    return offset_s if abs(offset_s) > max(0.05, (after_s - before_s) / 2) else 0.0


def patiently(
    call: Callable[[], T],
    patience_s: Optional[float] = None,
    given_up: Callable[[], bool] = lambda: False,
    sleep: Callable[[float], None] = time.sleep,
) -> T:
    """The result of ``call``, repeated while the controller is away.

    Args:
        call: May raise Away.
        patience_s: Raise Away after so long; None to wait for as long as it takes.
        given_up: Whether to raise Away although there is time left.
        sleep: Waits (s).
    """
    deadline_s = None if patience_s is None else time.monotonic() + patience_s
    pause_s = _FIRST_PAUSE_S
    while True:
        try:
            return call()
        except Away:
            if given_up() or (deadline_s is not None and time.monotonic() >= deadline_s):
                raise
        # Not all nodes at once when the controller is back.
        sleep(pause_s * random.uniform(0.7, 1.3))  # noqa: S311 - no secret
        pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)


def _content(text: bytes) -> Dict[str, Any]:
    try:
        found = json.loads(text.decode("utf-8")) if text else {}
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _words(error: Exception) -> str:
    return str(error) or type(error).__name__


# Fetches items from the controller into the cache: what has arrived before is not asked for again.


_PIECE_BYTES = 1 << 20
_CHANGED = 409
_CUT = (http.client.HTTPException, ConnectionError, socket.timeout, ssl.SSLError)

Progress = Callable[[Item, int], None]
"""Gets the number of bytes of an item that have arrived."""


class WrongContent(Exception):
    """The controller sent something else than the run needs."""


class Fetcher:
    """Completes parts of items; see ``cache.Fetch``.

    Args:
        connection: To the controller.
        patience_s: For how long the controller may be away; None for as long as it takes.
        progress: Gets what has arrived; None if nobody asks.
    """

    def __init__(
        self, connection: Connection, patience_s: Optional[float] = None, progress: Optional[Progress] = None
    ) -> None:
        self._connection = connection
        self._patience_s = patience_s
        self._progress = progress

    def __call__(self, item: Item, part: Path) -> None:
        """Bring ``part`` to the size and hash of ``item``. Raises WrongContent, Refused, Away, OSError."""
        resumed = part.exists() and part.stat().st_size > 0
        try:
            self._complete(item, part)
        except WrongContent:
            part.unlink()
            raise
        if sha256_of(part) == item.sha256:
            return
        part.unlink()
        if resumed:
            # The rest of an earlier transfer may be what is wrong, such as after a loss of power.
            self._complete(item, part)
            if sha256_of(part) == item.sha256:
                return
            part.unlink()
        raise WrongContent(
            "{} has another checksum than recorded ({}...): it has changed on the controller, or the transfer damages "
            "it; check the file on the controller".format(item.words, item.sha256[:12])
        )

    def _complete(self, item: Item, part: Path) -> None:
        """Ask until all has arrived. Each piece that arrives renews the patience."""
        with part.open("ab") as stream:
            if stream.tell() > item.size_bytes:
                _empty(stream)
            while stream.tell() < item.size_bytes or item.size_bytes == 0:
                patiently(lambda: self._receive(item, stream), self._patience_s)
                if item.size_bytes == 0:
                    break
            stream.flush()
            os.fsync(stream.fileno())

    def _receive(self, item: Item, stream: IO[bytes]) -> None:
        """Append what the controller sends until the connection ends."""
        begin = stream.tell()
        headers = {"Range": "bytes={}-".format(begin), "If-Range": '"{}"'.format(item.sha256)} if begin else {}
        try:
            answer = self._connection.open("GET", "items/" + item.sha256, headers=headers)
        except NodeRefused as refused:
            if refused.status == _CHANGED:
                raise WrongContent(str(refused)) from None
            raise
        try:
            if begin and answer.status != 206:
                _empty(stream)  # the item has changed, or a proxy knows no ranges: all of it comes
            while True:
                piece = answer.read(_PIECE_BYTES)
                if not piece:
                    break
                if stream.tell() + len(piece) > item.size_bytes:
                    self._connection.close()
                    raise WrongContent("{} is longer than recorded ({} bytes)".format(item.words, item.size_bytes))
                stream.write(piece)
                if self._progress is not None:
                    self._progress(item, stream.tell())
        except _CUT as error:
            self._connection.close()
            raise Away(str(error)) from None
        finally:
            answer.close()
        if stream.tell() == begin and begin < item.size_bytes:
            self._connection.close()
            raise Away("the connection was cut")


def _empty(stream: IO[bytes]) -> None:
    stream.seek(0)
    stream.truncate()
