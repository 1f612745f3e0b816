"""The life of a run on Kubernetes: from its Job to its end, adopted, stopped, and lost with its pod, Job or node.

The executor asks an API server in this process by the official client. What a real scheduler, kubelet and container
runtime do is tested where their programs are, see CONTRIBUTING.md.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import pytest

from slamhive.executors.base import EngineUnavailable
from slamhive.executors.host_counters import HostReading
from slamhive.executors.kubernetes import executor, manifest
from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.kubernetes.pod_files import LOG_FOLDER, STOP_FILE, USAGE_FILE, write_json
from slamhive.executors.kubernetes.supervisor import HOST_KEY
from slamhive.executors.process.exit_file import CappedLog
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited, Gone, Running
from slamhive.run_folder.host_columns import COLUMNS
from tests.executors.api_server import Document, Trouble
from tests.executors.played_nodes import MakeKubernetes, Nodes, left, lost, spec_of
from tests.waiting import eventually

pytestmark = [pytest.mark.quick, pytest.mark.timeout(60)]


@pytest.fixture
def kubernetes(make_kubernetes: MakeKubernetes) -> KubernetesExecutor:
    """What a worker has. Its API server is in this process, and its nodes are played."""
    return make_kubernetes()


@pytest.fixture
def spec(tmp_path: Path) -> RunSpec:
    return spec_of(tmp_path, "k1")


def second(number: int) -> datetime:
    return datetime.fromtimestamp(number, UTC)


def test_a_run_from_its_job_to_its_end(kubernetes, server, nodes, spec, tmp_path):
    assert kubernetes.unavailable_because() is None
    handle = kubernetes.start(spec)
    assert (handle.data["node"], handle.data["started_at"]) == ("node1", "1970-01-01T00:00:10+00:00")
    assert "pod on node node1 (Xeon, 4 cores)" in handle.protections.held_by
    assert kubernetes.poll(handle) == Running()
    output = nodes.folder(server.one("pods")).parent / "outputs" / "result"
    (output / "alive").write_text("1")
    kubernetes.refresh(spec, handle)
    assert (spec.outputs[0].destination / "alive").read_text() == "1"
    nodes.end(server.one("pods"), exit_code=3)
    assert kubernetes.poll(handle).exit_code == 3
    kubernetes.collect(spec, handle)
    kubernetes.remove(handle)
    kubernetes.remove(handle)
    assert left(server) == []
    assert not spec.work.exists()
    assert isinstance(kubernetes.poll(handle), Gone)


def test_what_the_supervisor_measures_and_logs_reaches_the_worker(kubernetes, server, nodes, spec, tmp_path):
    handle = kubernetes.start(spec)
    folder = nodes.folder(server.one("pods"))
    counted = {"cpu.stat": "usage_usec 2500000\n", "memory.current": "1000", "memory.stat": "file 250\nshmem 50"}
    reading = HostReading((1.0, *[None] * (len(COLUMNS) - 1)), {"steal": "not counted"})
    content = {"own_cpu_s": 0.5, "own_bytes": 100, "files": counted, HOST_KEY: reading.content}
    write_json(folder / USAGE_FILE, content)
    source = kubernetes.usage_source(handle)
    assert source is not None
    assert source.read() == (2.0, 700)
    assert source.totals() == {}
    assert kubernetes.host_reading(handle) == reading
    assert kubernetes.hidden_bytes(handle) == 0
    log = CappedLog(folder / LOG_FOLDER, 1000)
    log.write(b"hello\n")
    log.close()
    kubernetes.save_log(handle, tmp_path / "log")
    assert (tmp_path / "log").read_text() == "hello\n"
    nodes.end(server.one("pods"))
    assert source.read() is None
    assert kubernetes.usage_source(handle) is None


def test_many_looks_at_a_run_are_one_list_and_one_watch(kubernetes, server, spec):
    handle = kubernetes.start(spec)
    kubernetes.poll(handle)
    eventually(lambda: server.asked("watch pods"), "the watch")
    before = len(server.requests)
    for _ in range(50):
        assert isinstance(kubernetes.poll(handle), Running)
    assert len(server.requests) == before


def test_a_restarted_worker_adopts_its_runs_and_makes_no_second_job(kubernetes, make_kubernetes, server, nodes, spec):
    handle = kubernetes.start(spec)
    kubernetes.close()
    other = make_kubernetes()
    assert other.start(spec) == handle
    assert isinstance(other.poll(handle), Running)
    assert nodes.began == ["node1"]
    assert len(server.all("jobs")) == 1


def test_a_pod_that_waits_is_found_again_by_the_next_worker(kubernetes, make_kubernetes, server, nodes, spec):
    nodes.idle = True
    with pytest.raises(EngineUnavailable, match="run 7 waits in Kubernetes: node node1 prepares the pod"):
        kubernetes.start(spec)
    other = make_kubernetes()
    with pytest.raises(EngineUnavailable, match="waits in Kubernetes"):
        other.start(spec)
    nodes.begin(server.one("pods"))
    assert other.start(spec).data["node"] == "node1"
    assert server.asked("create jobs")
    assert len(server.all("jobs")) == 1


@pytest.mark.parametrize("answer", [Trouble(done=True), Trouble(), Trouble(503, "etcd leader changed")])
def test_a_job_whose_creation_was_not_answered_is_made_once(kubernetes, server, nodes, spec, answer):
    """It may have been created, or not: the next start finds out."""
    server.trouble("create jobs", answer)
    with pytest.raises(EngineUnavailable, match=r"creating a Job: the API server (does not answer|answers later)"):
        kubernetes.start(spec)
    assert len(server.all("jobs")) == answer.done
    kubernetes.start(spec)
    assert len(server.all("jobs")) == len(nodes.began) == 1


def test_jobs_of_runs_that_are_over_are_swept_but_not_those_of_others(
    kubernetes, make_kubernetes, server, spec, tmp_path
):
    other = make_kubernetes(installation="elsewhere")
    kept, foreign = spec_of(tmp_path, "k2"), spec_of(tmp_path, "k3")
    handle = kubernetes.start(spec)
    kubernetes.start(kept)
    other.start(foreign)
    assert kubernetes.sweep(lambda: {"k1", "k2"}) == []
    assert kubernetes.sweep(lambda: {"k2"}) == [handle.data["job"]]
    names = [manifest.job_name("home", "k2"), manifest.job_name("elsewhere", "k3")]
    assert sorted(entry["metadata"]["name"] for entry in server.all("jobs")) == sorted(names)
    assert len(server.all("pods")) == 2


def test_a_job_that_names_no_run_is_swept_with_its_pod(kubernetes, server, nodes, spec):
    """As one that somebody has copied."""
    kubernetes.start(spec)
    nodes.idle = True
    copy = server.one("jobs")
    copy["metadata"] |= {"name": "copied", "annotations": {}}
    copy["spec"]["template"]["metadata"]["labels"][manifest.KEY_LABEL] = "k9"
    server.handle("create", "jobs", "", copy, {})
    swept = kubernetes.sweep(set)
    assert sorted(swept) == sorted(["copied", manifest.job_name("home", "k1")])
    assert left(server) == []


@contextmanager
def played(nodes: Nodes, pod: Document, **how: object) -> Iterator[None]:
    """Meanwhile a supervisor ends when it is asked to."""

    def end() -> None:
        eventually((nodes.folder(pod) / STOP_FILE).exists, "the request")
        nodes.end(pod, **how)

    thread = threading.Thread(target=end)
    thread.start()
    yield
    thread.join()


def test_the_supervisor_ends_a_run_that_is_stopped(kubernetes, server, nodes, spec):
    handle, pod = kubernetes.start(spec), server.one("pods")
    with played(nodes, pod, exit_code=143):
        kubernetes.stop(handle, 1.5)
    assert (nodes.folder(pod) / STOP_FILE).read_text() == "1.5"
    assert kubernetes.poll(handle).exit_code == 143
    assert len(server.all("jobs")) == 1, "its end is recorded, so nothing has to be deleted"


def test_a_run_that_does_not_end_is_deleted(kubernetes, server, spec, monkeypatch):
    monkeypatch.setattr(executor, "KILL_WAIT_S", 0.1)
    kubernetes.stop(kubernetes.start(spec), 0.0)
    assert left(server) == []


def test_discarding_what_was_started_and_what_was_not(kubernetes, server, nodes, spec, tmp_path):
    nodes.idle = True
    with pytest.raises(EngineUnavailable):
        kubernetes.start(spec)
    late = server.one("pods")
    kubernetes.discard(spec)
    assert left(server) == []
    with pytest.raises(FileNotFoundError):
        nodes.begin(late)
    kubernetes.discard(spec_of(tmp_path, "k2"))


@pytest.mark.parametrize("resource", ["pods", "jobs"])
def test_who_deletes_a_pod_or_job_from_outside_loses_the_run(kubernetes, server, nodes, spec, resource):
    handle = kubernetes.start(spec)
    assert isinstance(kubernetes.poll(handle), Running)
    server.remove_with_owner(resource, server.one(resource)["metadata"]["name"])
    assert lost(kubernetes, handle) == "the pod was deleted from outside"
    assert nodes.began == ["node1"]


def test_a_lost_node_loses_its_runs_alone_and_its_pod_is_deleted_by_force(kubernetes, server, spec, tmp_path):
    handle, other = kubernetes.start(spec), spec_of(tmp_path, "k2")
    server.cordon("node1")
    kept = kubernetes.start(other)
    assert (handle.data["node"], kept.data["node"]) == ("node1", "node2")
    assert isinstance(kubernetes.poll(handle), Running)
    server.lose("node1")
    assert lost(kubernetes, handle) == "node node1 is lost: Taint manager: deleting due to NoExecute taint"
    assert isinstance(kubernetes.poll(kept), Running)
    kubernetes.remove(handle)
    assert [pod["spec"]["nodeName"] for pod in server.all("pods")] == ["node2"]


def test_an_end_from_outside_has_the_reason_of_kubernetes_if_it_knows_one(kubernetes, server, nodes, spec):
    handle, pod = kubernetes.start(spec), server.one("pods")
    nodes.end(pod, ended_from_outside=True, exit_code=143)
    assert "the pod was ended from outside" in lost(kubernetes, handle)
    message = {
        "type": "DisruptionTarget",
        "status": "True",
        "reason": "TerminationByKubelet",
        "message": "low on memory",
    }
    server.status(pod["metadata"]["name"], conditions=[message])
    assert lost(kubernetes, handle) == "the pod was evicted: low on memory"
    server.stop()
    assert "the pod was ended from outside" in lost(kubernetes, handle)


def test_a_pod_that_ran_out_of_memory_with_its_supervisor(kubernetes, server, spec):
    handle, pod = kubernetes.start(spec), server.one("pods")
    ended = {"name": "run", "state": {"terminated": {"reason": "OOMKilled", "exitCode": 137}}}
    server.status(pod["metadata"]["name"], phase="Failed", containerStatuses=[ended])
    eventually(lambda: isinstance(kubernetes.poll(handle), Exited), "the end")
    assert kubernetes.poll(handle) == Exited(137, out_of_memory=True)


def test_what_was_recorded_while_kubernetes_was_asked_counts(kubernetes, server, nodes, spec, monkeypatch):
    handle, pod = kubernetes.start(spec), server.one("pods")
    ask = kubernetes._jobs.pod

    def slowly(key: str) -> Document | None:
        found: Document | None = ask(key)
        nodes.record(pod, exit_code=4)
        return found

    server.remove_with_owner("pods", pod["metadata"]["name"])
    monkeypatch.setattr(kubernetes._jobs, "pod", slowly)
    assert kubernetes.poll(handle) == Exited(4, started_at=second(10), ended_at=second(11))
