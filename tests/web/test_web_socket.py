"""What comes in through the socket and is no HTTP: the server answers or hangs up, and goes on serving."""

from __future__ import annotations

import errno
import random
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from slamhive.web.serve import WebServer
from tests.fuzzing import mutated
from tests.web import web_world as world

pytestmark = pytest.mark.integration

TIMEOUT_S = 20
HOST = b"Host: 127.0.0.1\r\n"
WHOLE = (
    b"POST /api/v1/runs HTTP/1.1\r\n"
    + HOST
    + b"X-SLAM-Hive: 1\r\nContent-Type: application/json\r\nContent-Length: 2\r\n\r\n{}"
)
BROKEN = {
    "nothing": b"\r\n\r\n",
    "no HTTP": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
    "no version": b"GET /\r\n\r\n",
    "another version": b"GET / HTTP/9.9\r\n" + HOST + b"\r\n",
    "no address": b"GET HTTP/1.1\r\n" + HOST + b"\r\n",
    "spaces": b"GET / / / HTTP/1.1\r\n" + HOST + b"\r\n",
    "no host": b"GET / HTTP/1.1\r\n\r\n",
    "two hosts": b"GET / HTTP/1.1\r\n" + HOST + b"Host: evil.example\r\n\r\n",
    "a host that is none": b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n",
    "an absolute address": b"GET http://[::1/ HTTP/1.1\r\n" + HOST + b"\r\n",
    "bytes in the address": b"GET /\xff\xfe\x00 HTTP/1.1\r\n" + HOST + b"\r\n",
    "a line feed in the address": b"GET /%0d%0aSet-Cookie:x HTTP/1.1\r\n" + HOST + b"\r\n",
    "a header without a colon": b"GET / HTTP/1.1\r\n" + HOST + b"nonsense\r\n\r\n",
    "a header with a bare line feed": b"GET / HTTP/1.1\r\n" + HOST + b"A: b\nC: d\r\n\r\n",
    "a header with NUL": b"GET / HTTP/1.1\r\n" + HOST + b"A: \x00\r\n\r\n",
    "a header of 300 kB": b"GET / HTTP/1.1\r\n" + HOST + b"A: " + b"x" * 300_000 + b"\r\n\r\n",
    "an address of 300 kB": b"GET /" + b"x" * 300_000 + b" HTTP/1.1\r\n" + HOST + b"\r\n",
    "a length that is none": b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: x\r\n\r\n",
    "a negative length": b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: -5\r\n\r\n",
    "two lengths": b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: 1\r\nContent-Length: 2\r\n\r\nab",
    "a length of 4,420 digits": b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: " + b"9" * 4420 + b"\r\n\r\n",
    "a body that is too long": b"POST / HTTP/1.1\r\n" + HOST + b"Content-Length: 99999999999\r\n\r\n",
    "length and chunks": b"POST / HTTP/1.1\r\n"
    + HOST
    + b"Content-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    "chunks that are none": b"POST / HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: chunked\r\n\r\nzz\r\nabc\r\n0\r\n\r\n",
    "a huge chunk": b"POST / HTTP/1.1\r\n"
    + HOST
    + b"Transfer-Encoding: chunked\r\n\r\nffffffffffffffff\r\nabc\r\n0\r\n\r\n",
    "another encoding": b"POST / HTTP/1.1\r\n" + HOST + b"Transfer-Encoding: gzip\r\n\r\nabc",
    "a second request inside": WHOLE + b"GET /\x00 HTTP/1.1\r\n\r\n",
}


@pytest.fixture(scope="module")
def port(filled: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """A server of an empty installation, in this process, and the port it listens on."""
    hive = world.make_hive(tmp_path_factory.mktemp("socket"), empty=True)
    server = WebServer(hive, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run)
    thread.start()
    yield int(server.url.rpartition(":")[2])
    server.close()
    thread.join(TIMEOUT_S)
    assert not thread.is_alive()
    hive.close()


def answer_to(port: int, data: bytes, address: str = "127.0.0.1") -> bytes:
    """All that the server says to these bytes, up to the end of the connection; empty if it hangs up."""
    with socket.create_connection(("127.0.0.1", port), TIMEOUT_S, (address, 0)) as connection:
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            found = b""
            while block := connection.recv(65_536):
                found += block
        except OSError as error:
            if not isinstance(error, ConnectionError) and error.errno != errno.ENOTCONN:
                raise
            return b""
        return found


def check(port: int, data: bytes, caplog: pytest.LogCaptureFixture) -> int:
    """The status of the first answer, 0 if there is none; fails unless it is one in words."""
    answer = answer_to(port, data)
    head, _, body = answer.partition(b"\r\n\r\n")
    status = int(head.split()[1]) if head else 0
    assert status == 0 or 200 <= status < 500 or status == 501, (data[:300], answer[:500])
    assert b"Traceback" not in answer
    assert status < 400 or body.strip(), data[:300]
    assert [entry.getMessage() for entry in caplog.records if entry.levelname == "ERROR"] == [], data[:300]
    return status


def is_served(port: int, address: str = "127.0.0.1") -> bool:
    answer = answer_to(port, b"GET /healthz HTTP/1.1\r\n" + HOST + b"Connection: close\r\n\r\n", address)
    return answer.startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize("name", BROKEN)
def test_broken_requests_are_refused_and_the_server_goes_on(port: int, name: str, caplog: pytest.LogCaptureFixture):
    check(port, BROKEN[name], caplog)
    assert is_served(port)


@pytest.mark.parametrize("seed", range(2))
def test_mutated_requests_are_refused_and_the_server_goes_on(port: int, seed: int, caplog: pytest.LogCaptureFixture):
    draw = random.Random(seed)
    statuses = [check(port, mutated(WHOLE, draw), caplog) for _ in range(300)]
    assert is_served(port)
    assert 400 in statuses


def test_250_idle_connections_and_50_slow_heads_shut_out_nobody(port: int):
    with ExitStack() as open_ones:
        for number in range(300):
            client = socket.create_connection(("127.0.0.1", port), TIMEOUT_S, (f"127.0.0.{1 + number % 4}", 0))
            open_ones.enter_context(client)
            if number % 6 == 0:
                client.sendall(b"GET / HTTP/1.1\r\nHo")
            if number % 50 == 0:
                began = time.monotonic()
                assert is_served(port)
                assert time.monotonic() - began < 1
        for address in ("127.0.0.1", "127.0.0.200"):
            began = time.monotonic()
            assert is_served(port, address)
            assert time.monotonic() - began < 1


def test_a_request_with_two_lengths_ends_its_connection(port: int):
    answer = answer_to(port, BROKEN["length and chunks"] + b"GET /healthz HTTP/1.1\r\n" + HOST + b"\r\n")
    assert answer.startswith(b"HTTP/1.1 400")
    assert answer.count(b"HTTP/1.1 ") == 1
