"""The HTTP server for nodes' requests to the controller. Each request names a run and carries the token of that run.

``POST claim``, ``GET items/<SHA-256>``, ``PUT cache``, ``GET wanted``, ``PUT`` and ``DELETE state/<place>``, and
``GET`` and ``PUT result``, all below ``/v1/runs/<key>/``. Pages are served elsewhere, by threads of their own.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path
from typing import Any

from slamhive.base.clock import utc_now
from slamhive.base.errors import Unavailable
from slamhive.base.http_server import HttpServer, ServerLimits, listen
from slamhive.base.settings import Settings
from slamhive.executors.node_store.controller import NodeCaches, listening_address
from slamhive.executors.node_store.exchange import Arrivals, NotTaken, claimed_by, wanted
from slamhive.executors.node_store.on_node.connection import FROM_HEADER, OVER, SHA256_HEADER, TOTAL_HEADER
from slamhive.executors.node_store.on_node.results import MOST_BODY_BYTES
from slamhive.executors.node_store.on_node.run import ARCHITECTURE
from slamhive.executors.node_store.registrations import Registration, Registrations

logger = logging.getLogger(__name__)

THREADS = 8
MOST_CONNECTIONS = 1000
"""Each run keeps two or three open."""
_ROOT = "/v1/runs/"
_JSON = "application/json"
_LONGEST_WORD = 200
_PIECE_BYTES = 1 << 18

StartResponse = Callable[[str, list[tuple[str, str]]], Any]


class NodeService:
    """The WSGI application.

    Args:
        data: The data root.
    """

    def __init__(self, data: Path) -> None:
        self._registrations = Registrations(data)
        self._arrivals = Arrivals()
        self._caches = NodeCaches(data)

    def __call__(self, environ: dict[str, Any], start_response: StartResponse) -> Iterable[bytes]:
        """Answer one request."""
        try:
            registration, place = self._authorised(environ)
            if place.startswith("items/") and environ["REQUEST_METHOD"] == "GET":
                return _send_item(registration, place.partition("/")[2], environ, start_response)
            content = self._answer(registration, place, environ)
            status = HTTPStatus.OK
        except NotTaken as problem:
            status, content = problem.status, {"error": problem.message, **problem.more}
        except Unavailable as problem:
            logger.warning("a node waits: %s", problem)
            status, content = HTTPStatus.SERVICE_UNAVAILABLE, {"error": str(problem)}
        body = json.dumps(content).encode()
        headers = [("Content-Type", _JSON), ("Content-Length", str(len(body))), ("Cache-Control", "no-store")]
        start_response(f"{status.value} {status.phrase}", headers)
        return [body]

    def _authorised(self, environ: dict[str, Any]) -> tuple[Registration, str]:
        """The run of the request, and what of it is asked for. Raises NotTaken."""
        path = environ.get("PATH_INFO", "").encode("latin-1").decode(errors="replace")
        key, _, place = path.removeprefix(_ROOT).partition("/")
        scheme, _, token = environ.get("HTTP_AUTHORIZATION", "").partition(" ")
        found = None
        if path.startswith(_ROOT) and scheme.lower() == "bearer":
            found = self._registrations.find(key, token.strip())
        if found is None and self._registrations.was_for(key, token.strip()):
            raise NotTaken(HTTPStatus.GONE, "the run is over", **{OVER: True})
        if found is None:
            raise NotTaken(HTTPStatus.UNAUTHORIZED, "no run that goes on has this name and token")
        return found, place

    def _answer(self, registration: Registration, place: str, environ: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a request, except for an item. Raises NotTaken."""
        method, (kind, _, rest) = environ["REQUEST_METHOD"], place.partition("/")
        answers: dict[tuple[str, str], Callable[[], dict[str, Any]]] = {
            ("POST", "claim"): lambda: self._claim(registration, environ),
            ("GET", "wanted"): lambda: self._heard(registration),
            ("GET", "result"): lambda: self._arrivals.results(registration),
        }
        if (method, place) in answers:
            return answers[method, place]()
        if (method, place) == ("PUT", "cache"):
            said, node = _json_body(environ), (claimed_by(registration.work) or {}).get("node")
            self._caches.note(str(node or ""), said.get("used_bytes"), said.get("limit_bytes"))
            return {}
        if (method, place) == ("PUT", "result"):
            announced = _number(environ, TOTAL_HEADER), _header(environ, SHA256_HEADER)
            return self._arrivals.put_results(registration, _number(environ, FROM_HEADER), announced, _body(environ))
        if (method, kind) == ("PUT", "state"):
            self._arrivals.put_copy(registration, rest, _number(environ, FROM_HEADER), _body(environ))
            return self._heard(registration)
        if (method, kind) == ("DELETE", "state"):
            self._arrivals.remove_copy(registration, rest)
            return self._heard(registration)
        raise NotTaken(HTTPStatus.BAD_REQUEST, f"nothing answers to {method} {place[:80]!r}")

    def _claim(self, registration: Registration, environ: dict[str, Any]) -> dict[str, Any]:
        said, now_s = _json_body(environ), utc_now().timestamp()
        holder = _word(said.get("holder"))
        if not holder:
            raise NotTaken(HTTPStatus.BAD_REQUEST, "a claim names its holder")
        noted = {name: _word(said.get(name)) for name in ("node", ARCHITECTURE, "node_time_s")}
        self._arrivals.claim(registration, holder, {**noted, "received_s": now_s})
        return {**registration.answer, "time_s": now_s}

    @staticmethod
    def _heard(registration: Registration) -> dict[str, Any]:
        return {"wanted": wanted(registration)}


class NodeServer:
    """Serves nodes in threads of its own until it is closed. Raises Unavailable, InvalidInput, see ``listen``."""

    def __init__(self, data: Path, host: str, port: int) -> None:
        self._server = HttpServer(
            NodeService(data),
            listen(host, port, "port in NODE_ADDRESS"),
            ServerLimits(MOST_CONNECTIONS, MOST_CONNECTIONS, idle_s=300),
            threads=THREADS,
            max_request_body_size=2 * MOST_BODY_BYTES,
        )
        self.url = self._server.url
        self._thread = threading.Thread(target=self._server.run, name="nodes", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        logger.info("nodes are served at %s", self.url)

    def close(self) -> None:
        """End it. Nodes try again until there is another one."""
        self._server.close()
        self._thread.join()


@contextmanager
def serving_nodes(settings: Settings) -> Iterator[None]:
    """Serve nodes during the block, if the settings say where. Raises Unavailable, InvalidInput."""
    address = listening_address(settings)
    if address is None:
        yield
        return
    server = NodeServer(settings.data.resolve(), *address)
    server.start()
    try:
        yield
    finally:
        server.close()


def _send_item(
    registration: Registration, sha256: str, environ: dict[str, Any], start_response: StartResponse
) -> Iterable[bytes]:
    """A file, or the rest of it that ``Range`` asks for. Raises NotTaken."""
    offered = registration.item(sha256)
    if offered is None:
        raise NotTaken(HTTPStatus.BAD_REQUEST, "the run needs no such item")
    try:
        stream = offered.path.open("rb")
    except OSError as error:
        raise Unavailable(f"{offered.path} cannot be read: {error.strerror}") from None
    size_bytes = stream.seek(0, 2)
    if size_bytes != offered.item.size_bytes:
        stream.close()
        recorded = offered.item.size_bytes
        words = f"{offered.item.words} has {size_bytes} bytes on the controller, but {recorded} are recorded"
        raise NotTaken(HTTPStatus.CONFLICT, words)
    # At 0 unless the request has ``bytes=N-``, and its first part is of this item.
    unit, _, asked = environ.get("HTTP_RANGE", "").partition("=")
    text, dash, end = asked.partition("-")
    same = environ.get("HTTP_IF_RANGE", f'"{sha256}"') == f'"{sha256}"'
    begin = int(text) if unit.strip() == "bytes" and dash and not end and same and _is_number(text) else 0
    if begin > size_bytes or (begin == size_bytes and begin):
        stream.close()
        raise NotTaken(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, f"the item has {size_bytes} bytes")
    stream.seek(begin)
    headers = [
        ("Content-Type", "application/octet-stream"),
        ("Content-Length", str(size_bytes - begin)),
        ("ETag", f'"{sha256}"'),
        ("Accept-Ranges", "bytes"),
    ]
    if begin:
        headers.append(("Content-Range", f"bytes {begin}-{size_bytes - 1}/{size_bytes}"))
    start_response("206 Partial Content" if begin else "200 OK", headers)
    answer: Iterable[bytes] = environ["wsgi.file_wrapper"](stream, _PIECE_BYTES)
    return answer


def _body(environ: dict[str, Any]) -> bytes:
    length = environ.get("CONTENT_LENGTH") or "0"
    if not _is_number(length) or int(length) > MOST_BODY_BYTES:
        raise NotTaken(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"a piece has at most {MOST_BODY_BYTES} bytes")
    content: bytes = environ["wsgi.input"].read(int(length))
    if len(content) != int(length):
        raise NotTaken(HTTPStatus.BAD_REQUEST, "the request was cut")
    return content


def _json_body(environ: dict[str, Any]) -> dict[str, Any]:
    try:
        content = json.loads(_body(environ))
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise NotTaken(HTTPStatus.BAD_REQUEST, "the request holds no JSON object")
    return content


def _header(environ: dict[str, Any], name: str) -> str:
    found: str = environ.get("HTTP_" + name.upper().replace("-", "_"), "")
    return found


def _number(environ: dict[str, Any], name: str) -> int:
    found = _header(environ, name) or "0"
    if not _is_number(found):
        raise NotTaken(HTTPStatus.BAD_REQUEST, f"{name} is no number: {found[:40]!r}")
    return int(found)


def _is_number(text: str) -> bool:
    return text.isascii() and text.isdecimal() and len(text) <= 16


def _word(found: object) -> str:
    """Printable text of bounded length."""
    text = "" if found is None else str(found)
    return "".join(character for character in text if character.isprintable())[:_LONGEST_WORD]
