"""A web server on 127.0.0.1 that gives files, and misbehaves as a test asks."""

from __future__ import annotations

import hashlib
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Behaviour = Callable[["Request"], bool]
"""Answers a request and returns True, or leaves it to the server and returns False."""


@dataclass
class Request:
    """One request: ``number`` counts those for the same path from 1."""

    path: str
    number: int
    headers: dict[str, str]
    handler: BaseHTTPRequestHandler
    server: FileServer

    @property
    def is_probe(self) -> bool:
        return self.headers.get("Range") == "bytes=0-0"

    def answer(self, code: int, body: bytes = b"", /, **headers: str) -> bool:
        self.handler.send_response(code)
        for name, value in headers.items():
            self.handler.send_header(name.replace("_", "-"), value)
        self.handler.send_header("Content-Length", headers.get("Content_Length", str(len(body))))
        self.handler.end_headers()
        self.handler.wfile.write(body)
        return True

    def send_part(self, share: float) -> None:
        """Begin the right answer, but send only a share of its body and hang up."""
        code, body, headers = self.server.right_answer(self)
        self.handler.send_response(code)
        for name, value in headers.items():
            self.handler.send_header(name, value)
        self.handler.end_headers()
        self.handler.wfile.write(body[: int(share * len(body))])
        self.handler.wfile.flush()
        self.handler.close_connection = True
        self.handler.connection.shutdown(socket.SHUT_RDWR)


@dataclass
class FileServer:
    """Files by path, behaviours by path, and the requests that came."""

    address: str = ""
    files: dict[str, bytes] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    behaviours: dict[str, Behaviour] = field(default_factory=dict)
    requests: list[Request] = field(default_factory=list)
    released: threading.Event = field(default_factory=threading.Event)

    def add(self, path: str, content: bytes, behaviour: Behaviour | None = None) -> str:
        """Offer ``content``; returns its address."""
        self.files[path] = content
        if behaviour is not None:
            self.behaviours[path] = behaviour
        return f"{self.address}{path}"

    def version(self, path: str) -> str:
        return self.versions.get(path, f'"{hashlib.md5(self.files[path]).hexdigest()}"')

    def asked(self, path: str) -> list[Request]:
        return [request for request in self.requests if request.path == path]

    def right_answer(self, request: Request, *, ranges: bool = True) -> tuple[int, bytes, dict[str, str]]:
        content, version = self.files[request.path], self.version(request.path)
        headers = {"ETag": version} if version else {}
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", request.headers.get("Range", ""))
        fits = request.headers.get("If-Range", version) == version
        if asked is None or not ranges or not fits:
            return 200, content, {**headers, "Content-Length": str(len(content))}
        start, end = int(asked[1]), min(int(asked[2]) + 1, len(content))
        if start >= len(content):
            return 416, b"", {"Content-Range": f"bytes */{len(content)}", "Content-Length": "0"}
        body = content[start:end]
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{len(content)}"
        return 206, body, {**headers, "Content-Length": str(len(body))}


def without_ranges(request: Request) -> bool:
    code, body, headers = request.server.right_answer(request, ranges=False)
    return request.answer(code, body, **{name.replace("-", "_"): value for name, value in headers.items()})


@contextmanager
def serving() -> Iterator[FileServer]:
    """A server on a free port of 127.0.0.1."""
    files = FileServer()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            number = 1 + len(files.asked(self.path))
            request = Request(self.path, number, dict(self.headers), self, files)
            files.requests.append(request)
            behaviour = files.behaviours.get(self.path)
            try:
                if behaviour is not None and behaviour(request):
                    return
                if self.path not in files.files:
                    request.answer(404)
                    return
                code, body, headers = files.right_answer(request)
                request.answer(code, body, **{name.replace("-", "_"): value for name, value in headers.items()})
            except (BrokenPipeError, ConnectionResetError):
                self.close_connection = True

        def log_message(self, *_: Any) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    files.address = f"http://127.0.0.1:{server.server_address[1]}"
    try:
        yield files
    finally:
        files.released.set()
        server.shutdown()
        server.server_close()
        thread.join()
