"""An API server of Kubernetes that goes away, falls behind, breaks off or says nothing: no run is lost for that."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from slamhive.executors.base import EngineUnavailable
from slamhive.executors.kubernetes import cluster, run_jobs
from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Gone, Running
from tests.executors.api_server import Trouble
from tests.executors.played_nodes import MakeKubernetes, lost, spec_of
from tests.waiting import eventually

pytestmark = [pytest.mark.quick, pytest.mark.timeout(60)]


@pytest.fixture
def kubernetes(make_kubernetes: MakeKubernetes) -> KubernetesExecutor:
    """What a worker has. Its API server is in this process, and its nodes are played."""
    return make_kubernetes()


@pytest.fixture
def spec(tmp_path: Path) -> RunSpec:
    return spec_of(tmp_path, "k1")


class Pauses(threading.Event):
    """Notes how long somebody would wait for it, and lets him wait a moment only."""

    def __init__(self) -> None:
        super().__init__()
        self.asked_s: list[float | None] = []

    def wait(self, timeout: float | None = None) -> bool:
        self.asked_s.append(timeout)
        return super().wait(0.001)


def test_an_end_that_the_pod_has_recorded_arrives_without_the_api_server(kubernetes, server, nodes, spec):
    handle = kubernetes.start(spec)
    nodes.end(server.one("pods"), exit_code=5)
    server.stop()
    assert kubernetes.poll(handle).exit_code == 5


def test_a_run_is_never_lost_for_want_of_an_answer(kubernetes, server, spec, monkeypatch):
    handle = kubernetes.start(spec)
    assert isinstance(kubernetes.poll(handle), Running)
    server.stop()
    assert isinstance(kubernetes.poll(handle), Running), "that was confirmed a moment ago"
    with monkeypatch.context() as later:
        later.setattr(run_jobs, "TRUSTED_S", 0.0)
        with pytest.raises(EngineUnavailable):
            kubernetes.poll(handle)
    with pytest.raises(EngineUnavailable, match="the API server does not answer"):
        kubernetes.sweep(set)
    assert "does not answer" in str(kubernetes.unavailable_because())
    lists = len(server.asked("list pods"))
    server.start()
    eventually(lambda: len(server.asked("list pods")) > lists, "the next list")
    assert isinstance(kubernetes.poll(handle), Running)


def test_a_pod_that_went_while_the_api_server_was_away_is_found_by_the_next_list(kubernetes, server, spec):
    handle = kubernetes.start(spec)
    assert isinstance(kubernetes.poll(handle), Running)
    server.stop()
    server.remove_with_owner("pods", server.one("pods")["metadata"]["name"])
    server.compact()
    server.start()

    def gone() -> bool:
        try:
            return isinstance(kubernetes.poll(handle), Gone)
        except EngineUnavailable:
            return False

    eventually(gone, "the loss")


@pytest.mark.parametrize("by_event", [False, True])
def test_a_watch_whose_version_has_expired_begins_with_a_list(kubernetes, server, spec, monkeypatch, by_event):
    """At once, after code 410 or an event that says so. What happened in between is in the list."""
    server.expires_by_event = by_event
    pauses = Pauses()
    monkeypatch.setattr(kubernetes._watch, "_stopping", pauses)
    monkeypatch.setattr(run_jobs, "WATCH_S", 0.2)
    handle = kubernetes.start(spec)
    assert isinstance(kubernetes.poll(handle), Running)
    lists = len(server.asked("list pods"))
    server.remove("pods", server.one("pods")["metadata"]["name"], silently=True)
    server.compact()
    assert lost(kubernetes, handle) == "the pod was deleted from outside"
    assert len(server.asked("list pods")) > lists
    assert pauses.asked_s == []


@pytest.mark.parametrize(
    "trouble",
    [
        Trouble(raw=b'{"type": "MODIFIED", "object": {"met'),
        Trouble(raw=b'{"type": "MODIFIED", "obj\n'),
        Trouble(raw=b'{"type": "ERROR", "object": {"code": 500, "message": "etcd"}}\n'),
        Trouble(),
        Trouble(500, "etcd"),
    ],
)
def test_a_watch_that_breaks_is_followed_by_a_list_and_loses_nothing(kubernetes, server, nodes, spec, trouble):
    server.trouble("watch pods", *[trouble] * 3)
    handle = kubernetes.start(spec)
    assert isinstance(kubernetes.poll(handle), Running)
    lists = len(server.asked("list pods"))
    eventually(lambda: len(server.asked("watch pods")) >= 4, "the watch that holds")
    assert len(server.asked("list pods")) >= lists + 2
    assert isinstance(kubernetes.poll(handle), Running)
    assert nodes.began == ["node1"]


def test_an_api_server_in_trouble_is_asked_less_and_less_often_until_it_answers(kubernetes, server, spec, monkeypatch):
    monkeypatch.setattr(run_jobs, "_SHORTEST_PAUSE_S", 0.5)
    monkeypatch.setattr(run_jobs, "WATCH_S", 0.1)
    pauses = Pauses()
    monkeypatch.setattr(kubernetes._watch, "_stopping", pauses)
    handle = kubernetes.start(spec)
    server.trouble("list pods", *[Trouble(429, "slow down")] * 7)
    with pytest.raises(EngineUnavailable, match=r"answers later \(429: slow down"):
        kubernetes.poll(handle)
    eventually(lambda: len(server.asked("watch pods")) >= 2, "a watch that holds")
    assert pauses.asked_s == [0.5, 1.0, 2.0, 4.0, 8.0, 15.0, 15.0]
    server.trouble("watch pods", Trouble())
    eventually(lambda: len(pauses.asked_s) == 8, "the next pause")
    assert pauses.asked_s[-1] == 0.5
    assert isinstance(kubernetes.poll(handle), Running)


def test_an_api_server_that_is_behind_is_not_believed_when_it_says_that_a_pod_is_gone(kubernetes, server, spec):
    """The watch may go to another API server than the question that follows."""
    handle = kubernetes.start(spec)
    assert isinstance(kubernetes.poll(handle), Running)
    server.announce("DELETED", server.one("pods"))
    eventually(lambda: kubernetes._watch.of_run(spec.key) is None, "the event")
    assert isinstance(kubernetes.poll(handle), Running)


def test_an_api_server_that_takes_requests_and_never_answers(kubernetes, server, spec, monkeypatch):
    monkeypatch.setitem(cluster._RAW, "_request_timeout", (1.0, 0.1))
    answers = threading.Event()
    monkeypatch.setattr(server, "handle", lambda *_: answers.wait() and {})
    with pytest.raises(EngineUnavailable, match=r"creating a Job: the API server does not answer \(ReadTimeoutError"):
        kubernetes.start(spec)
    answers.set()
