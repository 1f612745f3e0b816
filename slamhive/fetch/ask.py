"""What an address offers, and one span of its bytes."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import TYPE_CHECKING

from slamhive.fetch.failures import Changed, Interrupted, Refused
from slamhive.fetch.part_file import Remote, Span
from slamhive.fetch.web import Web, body

if TYPE_CHECKING:
    import requests

PIECE_BYTES = 256 * 1024
_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+|\*)")

Receive = Callable[[int, bytes], None]
"""Called with the place of some bytes in the file, and the bytes; may raise to end the transfer."""


def probe(web: Web, address: str) -> Remote:
    """Ask for the first byte: the server shows its size, its version and whether it gives ranges.

    Raises:
        Refused: the address gives no file.
        Interrupted: it may later.
    """
    with web.get(address, {"Range": "bytes=0-0"}) as response:
        if response.status_code == 416:
            raise Refused(f"{address} is empty")
        if "text/html" in response.headers.get("Content-Type", "").lower():
            raise Refused(f"{address} answers with a web page, not with a file: it has moved, or wants a login")
        if response.status_code == 206:
            _, _, size = content_range(response)
            return Remote(address, size, ranges=size is not None, version=version_of(response))
        length = response.headers.get("Content-Length", "")
        return Remote(address, int(length) if length.isdecimal() else None, ranges=False, version=version_of(response))


def receive_span(web: Web, remote: Remote, span: Span, receive: Receive) -> None:
    """Request one span and hand its bytes over; raises Changed, Refused or Interrupted."""
    start, end = span
    headers = {"Range": f"bytes={start}-{end - 1}"}
    if remote.version and not remote.version.startswith("W/"):
        headers["If-Range"] = remote.version
    with web.get(remote.address, headers) as response:
        if response.status_code != 206 or version_of(response) != remote.version:
            raise Changed(f"the file at {remote.address} has changed")
        first, last, size = content_range(response)
        if size != remote.size_bytes or first != start or last >= end:
            raise Changed(f"the file at {remote.address} has changed: it sends bytes {first} to {last} of {size}")
        _receive(response, (start, end), remote, receive)


def receive_whole(web: Web, remote: Remote, receive: Receive) -> None:
    """Request the whole file from a server without ranges; raises as :func:`receive_span`."""
    with web.get(remote.address) as response:
        if response.status_code != 200 or version_of(response) != remote.version:
            raise Changed(f"the file at {remote.address} has changed")
        end = remote.size_bytes
        _receive(response, (0, end), remote, receive)


def content_range(response: requests.Response) -> tuple[int, int, int | None]:
    """First and last byte and size of the file from ``Content-Range``; raises Refused if it makes no sense."""
    found = _RANGE.fullmatch(response.headers.get("Content-Range", "").strip())
    if found is None or int(found[2]) < int(found[1]):
        raise Refused(f"{response.url} answers with a range that makes no sense")
    return int(found[1]), int(found[2]), None if found[3] == "*" else int(found[3])


def version_of(response: requests.Response) -> str:
    """The ETag, or the date of the last change; empty without both."""
    return response.headers.get("ETag", "") or response.headers.get("Last-Modified", "")


def _receive(response: requests.Response, span: tuple[int, int | None], remote: Remote, receive: Receive) -> None:
    place, end = span
    for piece in body(response, PIECE_BYTES):
        if end is not None and place + len(piece) > end:
            raise Refused(f"{remote.address} sends more bytes than it announced")
        receive(place, piece)
        place += len(piece)
    if end is not None and place < end:
        raise Interrupted(f"{remote.address} sends fewer bytes than it announced")
