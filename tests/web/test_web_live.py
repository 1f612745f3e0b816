"""Live updates and the server that carries them."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError, Unavailable
from slamhive.domain.accounts import Viewer
from slamhive.domain.run import RunState
from slamhive.services.hive import Hive
from slamhive.services.runs.service import RunService
from slamhive.web.live import KEEPALIVE_S, LiveHub, LiveStream, with_version
from slamhive.web.serve import THREADS, WebServer
from tests.waiting import PATIENCE_S, eventually
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.integration


PROMPT_S = 0.8 * KEEPALIVE_S
"""Whoever is not told that the server ends notices it only when the next sign of life is due."""


def next_state(events: Iterator[str]) -> dict[str, Any]:
    for event in events:
        if event.startswith("event: state"):
            state: dict[str, Any] = json.loads(event.partition("data: ")[2])
            return state
    raise AssertionError("the stream ended")


@pytest.fixture
def hub(shown: Web) -> Iterator[LiveHub]:
    hub = LiveHub(shown.hive, most_streams=2, interval_s=0.02)
    yield hub
    hub.close()


def poller_runs() -> bool:
    return any(thread.name == "slamhive-live" for thread in threading.enumerate())


def test_a_stream_tells_what_goes_on(hub: LiveHub, shown: Web):
    stream = hub.open()
    state = next_state(stream.events())
    assert state["counts"]["succeeded"] == 2
    assert state["unevaluated"] == 1
    assert state["active"][0]["memory"] == "699 MB"
    stream.close()


def test_the_poller_works_only_while_somebody_listens(hub: LiveHub):
    stream = hub.open()
    next_state(stream.events())
    assert poller_runs()
    stream.close()
    stream.close()
    assert hub.open_streams == 0
    eventually(lambda: not poller_runs())
    again = hub.open()
    assert next_state(again.events())["version"]
    again.close()


def test_streams_are_limited(hub: LiveHub):
    streams = [hub.open(), hub.open()]
    with pytest.raises(Unavailable, match="too many"):
        hub.open()
    streams[0].close()
    hub.open().close()
    streams[1].close()


def test_closing_the_hub_ends_streams_at_once(hub: LiveHub):
    stream = hub.open()
    ended = threading.Event()

    def read() -> None:
        for _ in stream.events():
            pass
        ended.set()

    threading.Thread(target=read, daemon=True).start()
    hub.close()
    assert ended.wait(PROMPT_S)
    with pytest.raises(Unavailable):
        hub.open()


def test_a_database_that_is_away_does_not_end_the_stream(hub: LiveHub, monkeypatch: pytest.MonkeyPatch):
    answers = iter([Unavailable("the database is away")])
    real = RunService.counts

    def counts(runs: RunService) -> Any:
        for error in answers:
            raise error
        return real(runs)

    monkeypatch.setattr(RunService, "counts", counts)
    stream = hub.open()
    assert next_state(stream.events())["counts"]
    stream.close()


class Reader:
    """Reads a stream in a thread, and keeps what it said."""

    def __init__(self, stream: LiveStream) -> None:
        self.events: list[str] = []
        self._stream = stream
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        for event in self._stream.events():
            self.events.append(event)

    def states(self) -> list[str]:
        return [event for event in self.events if event.startswith("event: state")]

    def close(self, hub: LiveHub) -> None:
        hub.close()
        self._thread.join(PATIENCE_S)
        self._stream.close()


def test_a_stream_whose_viewer_cannot_be_looked_up_waits_beside_an_older_one(
    hub: LiveHub, shown: Web, monkeypatch: pytest.MonkeyPatch
):
    real = RunService.counts
    newcomer = Viewer("newcomer")
    away = threading.Event()
    away.set()

    def counts(runs: RunService) -> Any:
        if away.is_set() and shown.hive.store.viewer == newcomer:
            raise Unavailable("the database is away")
        return real(runs)

    monkeypatch.setattr(RunService, "counts", counts)
    older = Reader(hub.open())
    eventually(lambda: len(older.states()) > 2)
    with shown.hive.store.seen_by(newcomer):
        newer = Reader(hub.open())
    had = len(older.states())
    eventually(lambda: len(older.states()) > had + 5)  # the trouble of one viewer holds up no other
    assert newer.events == ["retry: 3000\n\n"]
    away.clear()
    eventually(lambda: len(newer.states()) > 2)
    older.close(hub)
    newer.close(hub)


def test_streams_wait_while_the_database_is_away_and_go_on_after_it(
    hub: LiveHub, shown: Web, monkeypatch: pytest.MonkeyPatch
):
    real = RunService.counts
    away = threading.Event()
    asked = 0

    def counts(runs: RunService) -> Any:
        nonlocal asked
        if away.is_set():
            asked += 1
            raise Unavailable("the database is away")
        return real(runs)

    monkeypatch.setattr(RunService, "counts", counts)
    older = Reader(hub.open())
    eventually(lambda: len(older.states()) > 2)
    away.set()
    eventually(lambda: asked > 1)
    with shown.hive.store.seen_by(Viewer("newcomer")):
        newer = Reader(hub.open())
    had = len(older.events)
    eventually(lambda: asked > 20)
    assert len(older.events) == had
    assert newer.events == ["retry: 3000\n\n"]
    away.clear()
    eventually(lambda: newer.states() and len(older.states()) > had)
    older.close(hub)
    newer.close(hub)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_broken_poller_ends_its_streams_and_the_next_one_starts_another(
    hub: LiveHub, monkeypatch: pytest.MonkeyPatch
):
    def broken(runs: RunService) -> Any:
        raise RuntimeError("a mistake in the program")

    with monkeypatch.context() as breaking:
        breaking.setattr(RunService, "counts", broken)
        stream = hub.open()
        assert not any(event.startswith("event") for event in stream.events())
        stream.close()
    eventually(lambda: not poller_runs())
    again = hub.open()
    assert next_state(again.events())["counts"]
    again.close()


@pytest.mark.parametrize(
    "text", ["[" * 4000, f'{{"fraction": {"9" * 401}}}', '{"fraction": NaN}', '"x"', '{"fraction": {}}']
)
def test_hostile_progress_leaves_pages_and_streams_alone(web: Web, text: str):
    web.hive.runs.folder(web.runs["running"]).progress.write_text(text)
    for page in ("/", f"/runs/{web.runs['running']}"):
        assert web.client.get(page).status_code == 200
    assert LiveHub(web.hive).latest()["active"][0]["percent"] is None


def test_the_version_changes_with_states_and_not_with_progress():
    run: dict[str, Any] = {"id": 1, "state": "running", "percent": 10.0}
    state = {"counts": {"queued": 1}, "unevaluated": 0, "worker": True, "active": [run]}
    version = with_version(state)["version"]
    assert with_version({**state, "active": [{**run, "percent": 20.0}]})["version"] == version
    assert with_version({**state, "active": [{**run, "state": "collecting"}]})["version"] != version
    assert with_version({**state, "counts": {"queued": 2}})["version"] != version


def test_the_version_changes_when_an_evaluation_is_queued_and_when_it_ends(web: Web):
    versions = [LiveHub(web.hive).latest()["version"]]
    run_id = web.runs["bare"]
    web.hive.evaluations.queue([run_id])
    versions.append(LiveHub(web.hive).latest()["version"])
    world.evaluate_run(web.hive, run_id, 0.02)
    versions.append(LiveHub(web.hive).latest()["version"])
    assert len(set(versions)) == 3


def test_a_request_for_headers_only_leaves_no_stream_open(shown: Web):
    shown.client.head("/events").close()
    assert shown.app.extensions["slamhive-live"].open_streams == 0


def test_a_page_beyond_the_limit_is_told_to_poll(shown: Web, monkeypatch: pytest.MonkeyPatch):
    def full(hub: LiveHub) -> LiveStream:
        raise Unavailable("too many live pages are open")

    monkeypatch.setattr(LiveHub, "open", full)
    assert shown.client.get("/events").status_code == 204


@contextmanager
def serving(hive: Hive) -> Iterator[tuple[WebServer, int, threading.Thread]]:
    server = WebServer(hive, "127.0.0.1", 0)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    yield server, int(server.url.rpartition(":")[2]), thread
    server.close()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


@pytest.mark.integration
def test_the_server_streams_and_ends_in_time(web: Web):
    with serving(web.hive) as (server, port, thread):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        connection.request("GET", "/events")
        answer = connection.getresponse()
        assert answer.headers["Content-Type"].startswith("text/event-stream")
        lines = iter(answer.readline, b"")
        first = json.loads(next(line for line in lines if line.startswith(b"data: "))[6:])
        world.advance(web.hive, web.runs["queued"], RunState.PREPARING)
        news = (json.loads(line[6:]) for line in lines if line.startswith(b"data: "))
        assert next(state for state in news if state["version"] != first["version"])["counts"]["preparing"] == 1
        began = time.monotonic()
        server.close()
        thread.join(PATIENCE_S)
        assert time.monotonic() - began < PROMPT_S
        connection.close()


@pytest.mark.integration
def test_pages_answer_while_all_streams_are_taken_and_left(web: Web):
    with serving(web.hive) as (_, port, _thread):
        connections = [http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S) for _ in range(THREADS)]
        for connection in connections:
            connection.request("GET", "/events")
        answers = [connection.getresponse() for connection in connections]
        statuses = [answer.status for answer in answers]
        assert sorted(set(statuses)) == [200, 204]
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        page.request("GET", "/healthz")
        assert page.getresponse().status == 200
        for connection in [*connections, page]:
            connection.close()
        for answer in answers:
            answer.close()


@pytest.mark.integration
def test_a_huge_body_is_refused_before_it_is_sent(shown: Web):
    with serving(shown.hive) as (_, port, _thread):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        connection.putrequest("POST", "/analyses")
        connection.putheader("Content-Length", str(10**9))
        connection.endheaders(b"x")
        assert connection.getresponse().status == 413
        connection.close()


def test_a_port_that_is_taken_is_said_in_one_line(shown: Web):
    with (
        serving(shown.hive) as (_, port, _thread),
        pytest.raises(Unavailable, match=f"port {port} .* in use; .*--p"),
    ):
        WebServer(shown.hive, "127.0.0.1", port)


@pytest.mark.parametrize(("host", "port"), [("192.0.2.1", 0), ("no such host", 0), ("127.0.0.1", 70000)])
def test_an_address_that_is_not_ours_is_said_in_one_line(shown: Web, host: str, port: int):
    with pytest.raises(InvalidInput, match=r"cannot bind|is not valid") as caught:
        WebServer(shown.hive, host, port)
    assert isinstance(caught.value, SlamHiveError)
