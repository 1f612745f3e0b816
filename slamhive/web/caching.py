"""HTTP caching: browsers keep unchanged answers, and a view-only server keeps its pages for some seconds."""

from __future__ import annotations

import gzip
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

from cachetools import LRUCache, TTLCache
from flask import Flask, Response, g, request, session

from slamhive.base.clock import monotonic_s

# -- pages, data and scripts are sent compressed to browsers that accept gzip; plotly.js shrinks from 4.8 to 1.4 MB ----

LEAST_BYTES = 1_000
"""A shorter answer fits into one packet."""
_PAGE_LEVEL, _FILE_LEVEL = 5, 9
_MOST_FILES = 64
_FILES = frozenset({"static", "bootstrap.static", "assets.plotly_js"})
"""Endpoints that send files as they are."""
_TEXTS = ("text/", "application/json", "application/javascript", "application/yaml", "image/svg+xml")


def add_compression(app: Flask) -> None:
    """Compress what is worth it; register before everything that changes or keeps answers, so that it comes last."""
    files = _Files()

    @app.after_request
    def compress(response: Response) -> Response:
        if not worth_compressing(response):
            return response
        response.vary.add("Accept-Encoding")
        if not accepts_gzip():
            return response
        response.direct_passthrough = False
        tag, _ = response.get_etag()
        content = response.get_data()
        if request.endpoint in _FILES and tag is not None:
            response.close()
            _send_as_gzip(response, files.get((request.path, tag), content))
        else:
            compress_page(response)
        if tag is not None:
            response.set_etag(tag, weak=True)
        return response


class _Files:
    """Compressed files by address and tag: each is compressed once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: LRUCache[tuple[str, str], bytes] = LRUCache(_MOST_FILES)

    def get(self, key: tuple[str, str], content: bytes) -> bytes:
        with self._lock:
            if key not in self._kept:
                self._kept[key] = gzip.compress(content, _FILE_LEVEL, mtime=0)
            return self._kept[key]


def accepts_gzip() -> bool:
    """True if whoever asks takes gzip."""
    said = request.headers.get("Accept-Encoding", "")
    return "gzip" in said and (";" not in said or bool(request.accept_encodings["gzip"]))


def compress_page(response: Response) -> None:
    """Make an answer that of those who take gzip."""
    _send_as_gzip(response, gzip.compress(response.get_data(), _PAGE_LEVEL, mtime=0))


def _send_as_gzip(response: Response, compressed: bytes) -> None:
    response.set_data(compressed)
    response.content_encoding = "gzip"
    response.vary.add("Accept-Encoding")


def worth_compressing(response: Response) -> bool:
    """Tell if an answer is text of some length; downloads and streams are not, which may be large."""
    is_file = request.endpoint in _FILES
    if request.method != "GET" or response.status_code != 200 or response.content_encoding:
        return False
    if not is_file and (response.direct_passthrough or response.is_streamed):
        return False
    length = response.content_length
    return (response.mimetype or "").startswith(_TEXTS) and (length is None or length >= LEAST_BYTES)


YEAR_S = 365 * 86_400
KEPT_S = 5.0
MOST_PAGE_BYTES = 2_000_000
MOST_KEPT_BYTES = 100_000_000
_ENTRY_BYTES = 2_000
"""Upper bound of what an entry takes besides its texts."""
_ASSETS = "static"
Key = tuple[str, str]


@dataclass(slots=True)
class _Page:
    """A page; ``shrinks`` says if compressing is worth it, and ``small`` is compressed once somebody has asked."""

    content: bytes
    headers: tuple[tuple[str, str], ...]
    shrinks: bool
    size_bytes: int
    small: _Page | None = None

    def answer(self, *, compressed: bool) -> Response:
        if compressed and self.shrinks:
            if self.small is None:
                response = self.answer(compressed=False)
                compress_page(response)
                self.small = replace(self, content=response.get_data(), headers=tuple(response.headers.items()))
            return self.small.answer(compressed=False)
        return Response(self.content, headers=list(self.headers))


class PageCache:
    """Pages of view-only mode, where all visitors see the same.

    Args:
        kept_s: How long a page is kept; changes of the data appear that much later.
        clock: Monotonic seconds.
    """

    def __init__(self, kept_s: float = KEPT_S, clock: Callable[[], float] = monotonic_s) -> None:
        self._lock = threading.Lock()
        self._pages: TTLCache[Key, _Page] = TTLCache(MOST_KEPT_BYTES, kept_s, clock, lambda page: page.size_bytes)

    def get(self, key: Key, *, compressed: bool = False) -> Response | None:
        """The page, if it is kept and young enough; ``compressed`` by gzip if that is worth it."""
        with self._lock:
            page = self._pages.get(key)
        return None if page is None else page.answer(compressed=compressed)

    def put(self, key: Key, response: Response, *, shrinks: bool = False) -> None:
        """Keep a page; it replaces those that were used least recently if there are too many bytes."""
        content, headers = response.get_data(), tuple(response.headers.items())
        # An address may be longer than its page.
        size_bytes = (
            _ENTRY_BYTES
            + len(content)
            + shrinks * len(content) // 2
            + sum(map(len, key))
            + sum(len(name + text) for name, text in headers)
        )
        if size_bytes <= MOST_PAGE_BYTES:
            with self._lock:
                self._pages[key] = _Page(content, headers, shrinks, size_bytes)


def add_caching(app: Flask) -> None:
    """Give answers an ETag, and answer 304 if the browser has the page; register before the security headers."""

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
    """Answer from ``cache`` if it holds the page; register after the checks of every request."""

    @app.before_request
    def kept() -> Response | None:
        found = cache.get(_key(), compressed=accepts_gzip()) if request.method == "GET" else None
        g.kept = found is not None
        return found

    @app.after_request
    def keep(response: Response) -> Response:
        # A page with a token or a message belongs to one visitor.
        own = "csrf_token" in g or session.modified
        if request.method == "GET" and _plain(response) and not own and not g.get("kept", True):
            if response.get_etag()[0] is None:
                response.add_etag(weak=True)
            cache.put(_key(), response, shrinks=worth_compressing(response))
        return response


def _key() -> Key:
    return request.full_path, request.headers.get("Accept", "")


def _plain(response: Response) -> bool:
    whole = response.status_code == 200 and not response.is_streamed and not response.direct_passthrough
    return whole and "no-store" not in response.headers.get("Cache-Control", "")
