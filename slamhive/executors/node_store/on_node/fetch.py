"""Fetches items from the controller into the cache: what has arrived before is not asked for again."""

from __future__ import annotations

import http.client
import os
import socket
import ssl
from pathlib import Path
from typing import IO, Callable, Optional

from slamhive.executors.node_store.on_node.cache import Item, sha256_of
from slamhive.executors.node_store.on_node.connection import Away, Connection, Refused, patiently

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
        except Refused as refused:
            if refused.status == _CHANGED:
                raise WrongContent(str(refused)) from None
            raise
        try:
            if begin and answer.status != 206:
                _empty(stream)
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
