"""HTTP caching: browsers keep unchanged answers, and a view-only server keeps its pages for some seconds."""

from __future__ import annotations

import gzip
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any

from cachetools import LRUCache, TTLCache
from flask import Flask, Response, g, request, session
from werkzeug.datastructures import Headers
from werkzeug.http import parse_accept_header, parse_etags, remove_entity_headers

from slamhive.base.clock import monotonic_s

if TYPE_CHECKING:
    from _typeshed.wsgi import StartResponse, WSGIApplication, WSGIEnvironment

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
        if _KEEP in request.environ or not worth_compressing(response):
            return response
        response.vary.add("Accept-Encoding")
        if not accepts_gzip(request.headers.get("Accept-Encoding", "")):
            return response
        response.direct_passthrough = False
        tag, _ = response.get_etag()
        content = response.get_data()
        if request.endpoint in _FILES and tag is not None:
            response.close()
            _send_as_gzip(response, files.get((request.path, tag), content))
        else:
            _send_as_gzip(response, gzip.compress(content, _PAGE_LEVEL, mtime=0))
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


def accepts_gzip(said: str) -> bool:
    """True if ``said``, the header Accept-Encoding of whoever asks, allows gzip."""
    return "gzip" in said and (";" not in said or bool(parse_accept_header(said)["gzip"]))


def _send_as_gzip(response: Response, compressed: bytes) -> None:
    response.set_data(compressed)
    response.content_encoding = "gzip"


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
Key = tuple[str, ...]
_KEEP = "slamhive.keep"
"""In the environment of a request: its answer is the same for all, and is packed and compared by :class:`KeptPages`."""


@dataclass(frozen=True, slots=True)
class _Packed:
    """One encoding of a page: what is sent, and the headers of a page and of 304."""

    content: bytes
    headers: list[tuple[str, str]]
    unchanged: list[tuple[str, str]]


class KeptPage:
    """A page, complete with all headers.

    Args:
        content: Its bytes.
        headers: Its headers, with an ETag.
        shrinks: Whether compressing is worth it. The page is compressed once, when somebody has asked.
    """

    def __init__(self, content: bytes, headers: list[tuple[str, str]], *, shrinks: bool = False) -> None:
        self.content = content
        self.size_bytes = (
            len(content) + shrinks * len(content) // 2 + sum(len(name) + len(text) for name, text in headers)
        )
        self._shrinks = shrinks
        self._packed: dict[bool, _Packed] = {}
        self._headers = headers
        self._tag = Headers(headers).get("ETag", "").removeprefix("W/").strip('"')

    def answer(self, environ: WSGIEnvironment, start: StartResponse) -> list[bytes]:
        """Answer as a WSGI application: the page, or 304 if the browser has it."""
        small = self._shrinks and accepts_gzip(environ.get("HTTP_ACCEPT_ENCODING", ""))
        packed = self._packed.get(small) or self._pack(small=small)
        known = environ.get("HTTP_IF_NONE_MATCH")
        if known and parse_etags(known).contains_weak(self._tag):
            start("304 NOT MODIFIED", list(packed.unchanged))
            return []
        start("200 OK", list(packed.headers))
        return [packed.content]

    def _pack(self, *, small: bool) -> _Packed:
        content, headers = self.content, Headers(self._headers)
        if small:
            content = gzip.compress(content, _PAGE_LEVEL, mtime=0)
            headers["Content-Encoding"] = "gzip"
        headers["Content-Length"] = str(len(content))
        unchanged = list(headers)
        remove_entity_headers(unchanged)
        packed = self._packed[small] = _Packed(content, list(headers), unchanged)
        return packed


class PageCache:
    """Pages of view-only mode, where all visitors see the same.

    Args:
        kept_s: How long a page is kept; changes of the data appear that much later.
        clock: Monotonic seconds.
    """

    def __init__(self, kept_s: float = KEPT_S, clock: Callable[[], float] = monotonic_s) -> None:
        self._lock = threading.Lock()
        self._pages: TTLCache[Key, tuple[KeptPage, int]] = TTLCache(MOST_KEPT_BYTES, kept_s, clock, itemgetter(1))

    def get(self, key: Key) -> KeptPage | None:
        """The page, if it is kept and young enough."""
        with self._lock:
            found = self._pages.get(key)
        return None if found is None else found[0]

    def put(self, key: Key, page: KeptPage) -> None:
        """Keep a page; it replaces those that were used least recently if there are too many bytes."""
        size_bytes = _ENTRY_BYTES + page.size_bytes + sum(map(len, key))  # an address may be longer than its page
        if size_bytes <= MOST_PAGE_BYTES:
            with self._lock:
                self._pages[key] = page, size_bytes


class KeptPages:
    """The application with its kept pages in front: a request for one of them reaches neither Flask nor the database.

    Whatever decides about a page is part of its key, also the host, which the application has to accept first.
    """

    def __init__(self, app: WSGIApplication, cache: PageCache) -> None:
        self._app = app
        self._cache = cache

    def __call__(self, environ: WSGIEnvironment, start: StartResponse) -> Iterable[bytes]:
        """Answer a request."""
        if environ["REQUEST_METHOD"] != "GET" or environ.get("CONTENT_LENGTH", "") not in {"", "0"}:
            return self._app(environ, start)
        key = tuple(environ.get(name, "") for name in _DECISIVE)
        page = self._cache.get(key)
        if page is None:
            headers: list[tuple[str, str]] = []

            def begin(status: str, found: list[tuple[str, str]], exc_info: Any = None) -> Callable[[bytes], object]:
                if not status.startswith("200"):  # what failed after the page was made
                    environ.pop(_KEEP, None)
                if _KEEP not in environ:
                    return start(status, found, exc_info)
                headers.extend(found)
                return lambda _written: None  # Flask gives its answers as pieces, and writes nothing itself

            pieces = self._app(environ, begin)
            if _KEEP not in environ:
                return pieces
            page = KeptPage(b"".join(pieces), headers, shrinks=environ[_KEEP])
            getattr(pieces, "close", lambda: None)()
            if not any(name == "Set-Cookie" for name, _ in headers):
                self._cache.put(key, page)
        return page.answer(environ, start)


_DECISIVE = ("wsgi.url_scheme", "HTTP_HOST", "SCRIPT_NAME", "PATH_INFO", "QUERY_STRING", "HTTP_ACCEPT")


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
            if _KEEP not in request.environ:
                response.make_conditional(request)
        return response


def keep_pages(app: Flask, cache: PageCache) -> None:
    """Answer from ``cache`` if it holds the page; register after the checks of every request."""
    app.wsgi_app = KeptPages(app.wsgi_app, cache)  # type: ignore[assignment, method-assign]

    @app.before_request
    def pass_checks() -> None:
        g.checked = True

    @app.after_request
    def keep(response: Response) -> Response:
        # A page with a token or a message belongs to one visitor.
        own = "csrf_token" in g or session.modified
        if request.method == "GET" and _plain(response) and not own and "checked" in g:
            shrinks = request.environ[_KEEP] = worth_compressing(response)
            if shrinks:
                response.vary.add("Accept-Encoding")
            tag, _ = response.get_etag()
            if tag is None:
                response.add_etag(weak=True)
            elif shrinks:
                response.set_etag(tag, weak=True)  # its two encodings have the same content, and not the same bytes
        return response


def _plain(response: Response) -> bool:
    whole = response.status_code == 200 and not response.is_streamed and not response.direct_passthrough
    return whole and "no-store" not in response.headers.get("Cache-Control", "")
