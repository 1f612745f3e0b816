"""What is kept: by browsers, what has not changed; by a server that only shows, its pages for some seconds."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from flask import Flask, Response, g, request, session

from slamhive.clock import monotonic_s

YEAR_S = 365 * 86_400
KEPT_S = 5.0
MOST_PAGE_BYTES = 2_000_000
MOST_KEPT_BYTES = 100_000_000
_ENTRY_BYTES = 2_000
"""What an entry takes besides its texts, at most."""
_ASSETS = "static"
Key = tuple[str, str]


@dataclass(frozen=True, slots=True)
class _Kept:
    until_s: float
    content: bytes
    headers: tuple[tuple[str, str], ...]
    size_bytes: int


class PageCache:
    """Pages of view-only mode, where all visitors see the same; each for a few seconds.

    Args:
        kept_s: How long; what the owner's installation changes is seen so much later.
        clock: Monotonic seconds.
    """

    def __init__(self, kept_s: float = KEPT_S, clock: Callable[[], float] = monotonic_s) -> None:
        self._kept_s = kept_s
        self._clock = clock
        self._lock = threading.Lock()
        self._pages: OrderedDict[Key, _Kept] = OrderedDict()
        self._bytes = 0

    def get(self, key: Key) -> Response | None:
        """The page, if it is kept and not too old."""
        with self._lock:
            found = self._pages.get(key)
        if found is None or found.until_s < self._clock():
            return None
        return Response(found.content, headers=list(found.headers))

    def put(self, key: Key, response: Response) -> None:
        """Keep a page; the oldest go when there are too many."""
        content, headers = response.get_data(), tuple(response.headers.items())
        # An address may be longer than its page.
        size_bytes = _ENTRY_BYTES + len(content) + sum(map(len, key)) + sum(len(name + text) for name, text in headers)
        if size_bytes > MOST_PAGE_BYTES:
            return
        kept = _Kept(self._clock() + self._kept_s, content, headers, size_bytes)
        with self._lock:
            before = self._pages.pop(key, None)
            self._bytes += size_bytes - (0 if before is None else before.size_bytes)
            self._pages[key] = kept
            while self._bytes > MOST_KEPT_BYTES:
                self._bytes -= self._pages.popitem(last=False)[1].size_bytes


def add_caching(app: Flask) -> None:
    """Answers get an ETag, and 304 where the browser has them; register before the security headers."""

    @app.after_request
    def mark(response: Response) -> Response:
        if request.endpoint == _ASSETS and "v" in request.args and response.status_code == 200:
            response.cache_control.no_cache = None
            response.cache_control.max_age = YEAR_S
            response.cache_control.immutable = True
            response.cache_control.public = True
            return response
        if request.method in ("GET", "HEAD") and _plain(response):
            if response.get_etag()[0] is None:
                response.add_etag(weak=True)
            response.make_conditional(request)
        return response


def keep_pages(app: Flask, cache: PageCache) -> None:
    """Answer out of ``cache`` what was asked for a moment ago; register after the checks of every request."""

    @app.before_request
    def kept() -> Response | None:
        found = cache.get(_key()) if request.method == "GET" else None
        g.kept = found is not None
        return found

    @app.after_request
    def keep(response: Response) -> Response:
        # What holds a token, or told this visitor something, is for this visitor alone.
        own = "csrf_token" in g or session.modified
        if request.method == "GET" and _plain(response) and not own and not g.get("kept", True):
            if response.get_etag()[0] is None:
                response.add_etag(weak=True)
            cache.put(_key(), response)
        return response


def _key() -> Key:
    return request.full_path, request.headers.get("Accept", "")


def _plain(response: Response) -> bool:
    whole = response.status_code == 200 and not response.is_streamed and not response.direct_passthrough
    return whole and "no-store" not in response.headers.get("Cache-Control", "")
