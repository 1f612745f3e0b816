"""Runs on nodes of Kubernetes that share no storage: each pod has a ticket in a Secret, and a courier that uses it.

The API server is in this process, and so is the server of the node store. The couriers are real.
"""

from __future__ import annotations

import base64
import json
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.executors.base import EngineUnavailable, NodeAccess, StartFailed
from slamhive.executors.kubernetes import run_jobs
from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.kubernetes.pod_files import (
    DELIVERED_FILE,
    OLD_TICKET_EXIT,
    PRIVATE_FOLDER,
    READY_FILE,
    REFUSED_EXIT,
    STARTED_FILE,
    STOP_FILE,
    write_json,
)
from slamhive.executors.node_store.registrations import Registrations
from slamhive.executors.process.exit_file import reserve, write_exit
from slamhive.executors.spec import RunInput, RunSpec
from slamhive.executors.status import Exited, Running
from tests.executors.api_server import ApiServer, Document, Trouble
from tests.executors.couriers import start_courier
from tests.executors.node_stores import serving
from tests.executors.played_nodes import STARTED, WELL, MakeKubernetes, left, lost, spec_of
from tests.waiting import eventually

pytestmark = [pytest.mark.quick, pytest.mark.timeout(60)]


@pytest.fixture
def make(make_kubernetes: MakeKubernetes, tmp_path: Path) -> Iterator[MakeKubernetes]:
    """Makes executors for nodes that see nothing of the data root."""
    with serving(tmp_path) as served:
        yield lambda: make_kubernetes(nodes=NodeAccess(served.url, str(tmp_path / "cache"), 10**9))


@pytest.fixture
def kubernetes(make: MakeKubernetes) -> KubernetesExecutor:
    return make()


@pytest.fixture
def spec(tmp_path: Path) -> RunSpec:
    (tmp_path / "a.bag").write_bytes(b"recording")
    recording = RunInput("recording", tmp_path / "a.bag", "/slamhive/dataset/a.bag")
    return replace(spec_of(tmp_path, "k1"), inputs=(recording,))


def ticket_of(server: ApiServer, pod: Document) -> Document:
    """What is in the Secret that a pod mounts, which must be there."""
    (name,) = [volume["secret"]["secretName"] for volume in pod["spec"]["volumes"] if "secret" in volume]
    (secret,) = [entry for entry in server.all("secrets") if entry["metadata"]["name"] == name]
    return dict(secret["data"])


class Pods:
    """What pods do on nodes that share nothing: their couriers are processes, their supervisors are played."""

    def __init__(self, server: ApiServer, folder: Path) -> None:
        self._server = server
        self._folder = folder
        self.couriers: list[subprocess.Popen[bytes]] = []
        self._threads: list[threading.Thread] = []

    def folder_of(self, pod: Document) -> Path:
        return self._folder / str(pod["metadata"]["uid"])

    def begin(self, pod: Document) -> None:
        """Start the courier; the supervisor follows when the data is there."""
        folder, node = self.folder_of(pod), pod["spec"]["nodeName"]
        programs = folder.with_name(f"{folder.name}-programs")
        secret = ticket_of(self._server, pod)
        self.couriers.append(start_courier(secret, programs, folder, node, pod["metadata"]["uid"]))

        def supervise() -> None:
            eventually((folder / PRIVATE_FOLDER / READY_FILE).exists, "the data")
            write_json(folder / "pod" / STARTED_FILE, {**STARTED, "node": node})

        self._threads.append(threading.Thread(target=supervise))
        self._threads[-1].start()

    def end(self, pod: Document, **how: object) -> None:
        reserve(self.folder_of(pod) / "pod")
        write_exit(self.folder_of(pod) / "pod", {**WELL, **how})

    def close(self) -> None:
        for thread in self._threads:
            thread.join()
        for courier in self.couriers:
            courier.kill()
            courier.wait()


@pytest.fixture
def pods(server, nodes, tmp_path, monkeypatch) -> Iterator[Pods]:
    made = Pods(server, tmp_path)
    nodes.meets = made.begin
    yield made
    made.close()


@pytest.fixture
def patient(kubernetes: KubernetesExecutor, monkeypatch: pytest.MonkeyPatch) -> KubernetesExecutor:
    """Waits until a courier has brought the data."""
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 40.0)
    return kubernetes


def test_a_run_gets_its_data_and_its_results_arrive(patient, server, pods, spec, tmp_path):
    handle = patient.start(spec)
    assert handle.data["node"] == "node1"
    pod, secret = server.one("pods"), server.one("secrets")
    assert secret["immutable"]
    assert set(secret["data"]) == {"ticket.json", "courier.pyz", "supervisor.pyz"}
    token = json.loads(base64.b64decode(secret["data"]["ticket.json"]))["token"]
    assert token not in json.dumps([server.all("jobs"), server.all("pods")])
    assert isinstance(patient.poll(handle), Running)
    assert Registrations(tmp_path).keys() == {"k1"}
    folder = pods.folder_of(pod)
    (folder / "outputs" / "result" / "traj.txt").write_text("poses")
    (folder / "outputs" / "result" / "alive").write_text("yes")
    eventually((spec.outputs[0].destination / "alive").exists, "the live file")
    pods.end(pod, exit_code=4)
    eventually((folder / "pod" / DELIVERED_FILE).exists, "the delivery")
    server.remove_with_owner("pods", pod["metadata"]["name"])
    ended = patient.poll(handle)
    assert isinstance(ended, Exited)
    assert ended.exit_code == 4
    patient.collect(spec, handle)
    assert (spec.outputs[0].destination / "traj.txt").read_text() == "poses"
    patient.remove(handle)
    assert left(server) == []
    assert Registrations(tmp_path).keys() == set()


@pytest.mark.integration
def test_a_restarted_worker_adopts_the_run_with_the_ticket_that_it_has(patient, make, server, pods, spec):
    handle, secrets = patient.start(spec), server.all("secrets")
    patient.close()
    other = make()
    assert other.start(spec) == handle
    assert server.all("secrets") == secrets
    assert len(pods.couriers) == len(server.all("jobs")) == 1
    thread = threading.Thread(target=other.stop, args=(handle, 1.5))
    thread.start()
    stop = pods.folder_of(server.one("pods")) / "pod" / STOP_FILE
    eventually(stop.exists, "the request to stop")
    assert stop.read_text() == "1.5"
    pods.end(server.one("pods"), exit_code=143)
    thread.join()
    assert other.poll(handle).exit_code == 143


def test_a_pod_that_is_lost_before_it_delivers_loses_the_run(patient, server, pods, spec):
    handle = patient.start(spec)
    pods.couriers[0].kill()
    server.remove_with_owner("pods", server.one("pods")["metadata"]["name"])
    assert lost(patient, handle) == "the pod was deleted from outside"
    patient.collect(spec, handle)
    assert list(spec.outputs[0].destination.iterdir()) == []


def refused_by_its_courier(server: ApiServer, pod: Document, code: int) -> None:
    """The init container of a pod ends with this code, and the pod with it."""
    ended = {"exitCode": code, "reason": "Error", "message": "no run that goes on has this name and token"}
    server.status(
        pod["metadata"]["name"],
        phase="Failed",
        initContainerStatuses=[{"name": "fetch", "state": {"terminated": ended}}],
        containerStatuses=[{"name": "run", "state": {"waiting": {"reason": "PodInitializing"}}}],
    )


def test_a_pod_with_an_old_ticket_is_replaced_by_one_with_a_secret_of_another_name(patient, server, nodes, pods, spec):
    names: list[str] = []

    def meet(pod: Document) -> None:
        names.append(server.one("secrets")["metadata"]["name"])
        if len(names) == 1:
            refused_by_its_courier(server, pod, OLD_TICKET_EXIT)
        else:
            pods.begin(pod)

    nodes.meets = meet
    assert patient.start(spec).data["node"] == "node1"
    assert len(set(names)) == 2
    assert server.one("secrets")["metadata"]["name"] == names[1]
    assert len(server.all("jobs")) == len(server.all("pods")) == 1


def test_data_that_every_pod_would_be_refused_is_asked_for_once(patient, server, nodes, spec):
    nodes.meets = lambda pod: refused_by_its_courier(server, pod, REFUSED_EXIT)
    with pytest.raises(StartFailed, match="node node1 could not get the data of the run: no run that goes on"):
        patient.start(spec)
    assert len(server.asked("create jobs")) == 1
    patient.discard(spec)
    assert left(server) == []


def test_who_may_not_make_secrets_makes_no_job(kubernetes, server, spec):
    server.forbidden.add("create secrets")
    with pytest.raises(StartFailed, match="the worker lacks the right to create secrets"):
        kubernetes.start(spec)
    assert left(server) == []
    rights = {finding.name: finding.found for finding in kubernetes.examine()}["rights"]
    assert rights == "the worker may not create secrets"


@pytest.mark.parametrize("request_", ["create secrets", "create jobs"])
@pytest.mark.parametrize("done", [False, True])
def test_after_an_answer_that_was_lost_there_is_one_job_and_the_secret_that_it_needs(
    kubernetes, server, nodes, spec, request_, done
):
    nodes.idle = True
    server.trouble(request_, Trouble(done=done))
    with pytest.raises(EngineUnavailable, match="the API server does not answer"):
        kubernetes.start(spec)
    with pytest.raises(EngineUnavailable, match="waits in Kubernetes: node node1 prepares the pod"):
        kubernetes.start(spec)
    assert len(server.all("jobs")) == len(server.all("secrets")) == 1
    assert "ticket.json" in ticket_of(server, server.one("pods"))


def test_a_run_that_no_pod_has_claimed_is_discarded_with_its_ticket(kubernetes, server, nodes, spec, tmp_path):
    nodes.idle = True
    with pytest.raises(EngineUnavailable):
        kubernetes.start(spec)
    assert Registrations(tmp_path).keys() == {"k1"}
    kubernetes.discard(spec)
    assert left(server) == []
    assert Registrations(tmp_path).keys() == set()


def test_tickets_of_runs_that_are_over_are_swept(kubernetes, server, nodes, spec, tmp_path):
    nodes.idle = True
    with pytest.raises(EngineUnavailable):
        kubernetes.start(spec)
    assert kubernetes.sweep(lambda: {"k1"}) == []
    assert len(server.all("secrets")) == 1
    kubernetes.sweep(set)
    assert left(server) == []
    assert Registrations(tmp_path).keys() == set()


def test_a_claim_and_nodes_that_share_nothing_exclude_each_other(make_kubernetes):
    kubernetes = make_kubernetes("--claim=data", nodes=NodeAccess("http://127.0.0.1:1", "/var/lib/slamhive", 10**9))
    assert "KUBERNETES_OPTIONS has --claim, but SHARED_STORAGE is false" in str(kubernetes.unavailable_because())
