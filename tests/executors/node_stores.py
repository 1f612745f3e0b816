"""A controller with a run, and a line to it that is cut: for tests of the node store."""

from __future__ import annotations

import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from slamhive.executors.node_store.exchange import Offers
from slamhive.executors.node_store.on_node.connection import Connection
from slamhive.executors.node_store.registrations import Offered, Registration, Registrations
from slamhive.executors.node_store.server import NodeServer

OPENED: list[Connection] = []
"""What the tests have opened, to be closed after each."""
LINES: list[Line] = []


@contextmanager
def serving(data: Path, port: int = 0) -> Iterator[NodeServer]:
    """A controller of this data root."""
    server = NodeServer(data, "127.0.0.1", port)
    server.start()
    try:
        yield server
    finally:
        server.close()


@dataclass
class Run:
    """A registered run."""

    registration: Registration
    token: str

    @property
    def work(self) -> Path:
        return self.registration.work

    def connection(self, url: str, token: str | None = None, key: str | None = None) -> Connection:
        OPENED.append(Connection(url, key or self.registration.key, token or self.token, timeout_s=5.0))
        return OPENED[-1]


def register(data: Path, key: str = "run-1", inputs: dict[str, Path] | None = None, **further: object) -> Run:
    """A run that needs ``inputs``; it may send ``state.json``, ``live/path`` and the log ``output``."""
    work = data / "runs" / key / "work"
    work.mkdir(parents=True, exist_ok=True)
    registration = Registration(
        key=key,
        work=work,
        offered={name: offered(data, path) for name, path in (inputs or {}).items()},
        orders={"do": "this"},
        copies={"state.json": work / "state.json", "live/path": work.parent / "result" / "path"},
        logs={"output": work / "output"},
        **further,  # type: ignore[arg-type]
    )
    return Run(registration, Registrations(data).add(registration))


def offered(data: Path, path: Path) -> Offered:
    from slamhive.executors.spec import RunInput  # noqa: PLC0415 - beside its use

    return Offers(data).input(RunInput(path.name, path, f"/slamhive/{path.name}"))


class Line:
    """A proxy between node and controller that counts what the controller sends, and cuts it after so many bytes.

    Args:
        url: The address of the controller.
        cut_after: After how many bytes to cut a connection, one after the other; later ones are left alone.
        tls: Encrypts the side of the node, as a reverse proxy does.
    """

    def __init__(self, url: str, cut_after: list[int], tls: ssl.SSLContext | None = None) -> None:
        self._target = urlsplit(url).hostname, urlsplit(url).port
        self._cuts = list(cut_after)
        self._listener = socket.create_server(("127.0.0.1", 0))
        LINES.append(self)
        self._tls = tls
        self.url = f"http{'s' if tls else ''}://127.0.0.1:{self._listener.getsockname()[1]}"
        self.received = 0
        self.connections = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            if self._tls is not None:
                try:
                    near = self._tls.wrap_socket(near, server_side=True)
                except OSError:  # the node does not trust the certificate
                    continue
            far = socket.create_connection(self._target)
            cut_after = self._cuts.pop(0) if self._cuts else None
            threading.Thread(target=self._pass_on, args=(near, far), daemon=True).start()
            threading.Thread(target=self._pass_back, args=(far, near, cut_after), daemon=True).start()

    @staticmethod
    def _pass_on(near: socket.socket, far: socket.socket) -> None:
        with suppress(OSError):
            while data := near.recv(65536):
                far.sendall(data)
        _end(far)

    def _pass_back(self, far: socket.socket, near: socket.socket, cut_after: int | None) -> None:
        passed = 0
        with suppress(OSError):
            while data := far.recv(65536):
                if cut_after is not None:
                    data = data[: cut_after - passed]
                near.sendall(data)
                passed += len(data)
                self.received += len(data)
                if cut_after is not None and passed >= cut_after:
                    break
        _end(near)
        _end(far)


def _end(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()
