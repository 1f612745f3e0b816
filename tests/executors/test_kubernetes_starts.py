"""Runs that Kubernetes cannot start, starts later or may not start, and what the executor says of rights and nodes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base.errors import Forbidden, Unavailable
from slamhive.executors.base import EngineUnavailable, ImageMissing, StartFailed
from slamhive.executors.kubernetes import executor, run_jobs
from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.spec import Placing, ResourceLimits, RunSpec
from tests.executors.api_server import ApiServer, Document, Trouble
from tests.executors.played_nodes import MakeKubernetes, Nodes, left, spec_of

pytestmark = [pytest.mark.quick, pytest.mark.timeout(60)]


@pytest.fixture
def kubernetes(make_kubernetes: MakeKubernetes) -> KubernetesExecutor:
    """What a worker has. Its API server is in this process, and its nodes are played."""
    return make_kubernetes()


@pytest.fixture
def spec(tmp_path: Path) -> RunSpec:
    return spec_of(tmp_path, "k1")


def test_a_run_waits_for_room_and_is_made_once(kubernetes, server, nodes, spec):
    server.cordon("node1", "node2")
    with pytest.raises(EngineUnavailable, match="waits in Kubernetes: 0/2 nodes are available: no node takes it"):
        kubernetes.start(spec)
    server.cordon("node2", cordoned=False)
    assert kubernetes.start(spec).data["node"] == "node2"
    assert len(server.all("jobs")) == len(nodes.began) == 1


@pytest.mark.parametrize(
    ("changes", "part"),
    [
        ({"limits": ResourceLimits(cpu_cores=5000.0)}, "asks for 5000 cores, but the largest node has 4 cores"),
        ({"limits": ResourceLimits(memory_bytes=10**13)}, "MB of memory, but the largest node has 8590 MB"),
        ({"asks_gpu": True}, "asks for 1 nvidia.com/gpu, but the largest node has 0"),
    ],
)
def test_a_run_that_no_node_can_ever_take(kubernetes, spec, changes, part):
    with pytest.raises(StartFailed, match=f"no node can ever take run 7: it .*{part}"):
        kubernetes.start(replace(spec, **changes))


def test_a_run_whose_nodes_all_have_another_processor(kubernetes, server, spec):
    server.cordon("node1", "node2")
    placing = Placing("Xeon", other_nodes=("node1", "node2"))
    with pytest.raises(StartFailed, match="run 7: no node has Xeon, the CPU model of its experiment"):
        kubernetes.start(replace(spec, placing=placing))


def test_who_may_not_list_nodes_waits_instead(kubernetes, server, spec):
    server.forbidden.add("list nodes")
    with pytest.raises(EngineUnavailable, match="waits in Kubernetes"):
        kubernetes.start(replace(spec, limits=ResourceLimits(cpu_cores=5000.0)))
    with pytest.raises(Unavailable, match="the worker may not list nodes"):
        kubernetes.nodes()


def test_a_suspended_job_has_no_pod_yet(kubernetes, server, spec):
    server.suspends = True
    with pytest.raises(EngineUnavailable, match="its Job is suspended, for example by Kueue"):
        kubernetes.start(spec)


def waits(server: ApiServer, nodes: Nodes, **state: object) -> None:
    """The nodes bring a container no further than to this state."""
    status = {"name": "run", "state": {"waiting": state}}
    nodes.meets = lambda pod: server.status(pod["metadata"]["name"], containerStatuses=[status])


def test_a_missing_image_leaves_nothing(kubernetes, server, nodes, spec):
    waits(server, nodes, reason="ErrImageNeverPull", message="not present")
    with pytest.raises(ImageMissing, match=r"image sha256:abc: node node1 does not have it") as refused:
        kubernetes.start(spec)
    assert "docker save" in str(refused.value.remedy)
    assert left(server) == []


def test_a_container_that_the_node_cannot_start(kubernetes, server, nodes, spec):
    waits(server, nodes, reason="CreateContainerError", message="no such device")
    with pytest.raises(
        StartFailed, match="node node1 cannot start the container: CreateContainerError: no such device"
    ):
        kubernetes.start(spec)


def test_files_that_the_nodes_do_not_share(kubernetes, server, nodes, spec):
    nodes.meets = lambda pod: server.warn(pod["metadata"]["name"], "FailedMount", "is not a directory")
    with pytest.raises(StartFailed, match="does not get its files: FailedMount: is not a directory") as refused:
        kubernetes.start(spec)
    assert "at the same path, or set --claim" in str(refused.value.remedy)


def test_who_may_not_read_events_learns_less(kubernetes, server, nodes, spec):
    server.forbidden.add("list events")
    nodes.meets = lambda pod: server.warn(pod["metadata"]["name"], "FailedMount", "is not a directory")
    with pytest.raises(EngineUnavailable, match="node node1 prepares the pod"):
        kubernetes.start(spec)


def test_a_broken_program_is_named(kubernetes, server, nodes, spec):
    nodes.meets = lambda pod: nodes.end(pod, exit_code=127, error="no such file: /no/such/program")
    with pytest.raises(StartFailed, match=r"run 7 cannot start: .*/no/such/program"):
        kubernetes.start(spec)


def test_a_job_that_fails_without_a_pod(kubernetes, server, nodes, spec):
    failed = {"type": "Failed", "status": "True", "reason": "FailedCreate", "message": "exceeded quota"}

    def refuse(pod: Document) -> None:
        server.remove("pods", pod["metadata"]["name"])
        server.change(
            "jobs", server.one("jobs")["metadata"]["name"], lambda job: job.update(status={"conditions": [failed]})
        )

    nodes.meets = refuse
    with pytest.raises(StartFailed, match="the pod of run 7 did not start: FailedCreate: exceeded quota"):
        kubernetes.start(spec)
    assert len(server.asked("create jobs")) == 3


FORGOTTEN = {"name": "run", "containerID": "containerd://1", "state": {"waiting": {}}}
"""As a kubelet shows a container whose containerd was killed before it started it: for ever."""


@pytest.mark.parametrize("bad", [2, 3])
def test_a_pod_that_its_node_has_forgotten_is_replaced_at_most_twice(kubernetes, server, nodes, spec, monkeypatch, bad):
    monkeypatch.setattr(run_jobs, "CREATED_PATIENCE_S", 0.05)
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 20.0)
    pods: list[str] = []

    def forget(pod: Document) -> None:
        pods.append(pod["metadata"]["uid"])
        if len(pods) <= bad:
            server.status(pod["metadata"]["name"], containerStatuses=[FORGOTTEN])
        else:
            nodes.begin(pod)

    nodes.meets = forget
    if bad == 3:
        with pytest.raises(StartFailed, match="node node1 has made a container of the pod and does not go on"):
            kubernetes.start(spec)
    else:
        assert kubernetes.start(spec).data["node"] == "node1"
        assert len(server.all("pods")) == 1
    assert len(set(pods)) == 3


def test_a_pod_that_cannot_be_deleted_is_named_instead_of_waited_for(kubernetes, server, spec, monkeypatch):
    monkeypatch.setattr(run_jobs, "DELETION_WAIT_S", 0.1)
    monkeypatch.setattr(executor, "KILL_WAIT_S", 0.05)
    handle = kubernetes.start(spec)
    name = server.one("pods")["metadata"]["name"]
    server.change("pods", name, lambda pod: pod["metadata"].update(finalizers=["somebody/wants-it"]))
    with pytest.raises(EngineUnavailable, match="Kubernetes does not delete the pod of k1"):
        kubernetes.remove(handle)
    server.remove("pods", name)
    kubernetes.remove(handle)
    assert left(server) == []


def test_wrong_credentials(make_kubernetes, server, spec, tmp_path, monkeypatch):
    monkeypatch.setenv("KUBECONFIG", str(server.kubeconfig(tmp_path / "expired", token="expired")))
    kubernetes = make_kubernetes()
    said = "the cluster does not accept the credentials of the kubeconfig: they are wrong or have expired"
    assert str(kubernetes.unavailable_because()).startswith(said)
    with pytest.raises(EngineUnavailable, match=said):
        kubernetes.start(spec)


def test_a_missing_right_is_named_with_the_remedy(kubernetes, server, spec):
    server.forbidden |= {"create jobs.batch", "list jobs.batch", "watch pods"}
    assert "the worker lacks the right to list jobs.batch" in str(kubernetes.unavailable_because())
    with pytest.raises(StartFailed, match=r"the worker lacks the right to create jobs.batch") as refused:
        kubernetes.start(spec)
    assert "rights.yaml" in str(refused.value.remedy)
    findings = {finding.name: finding for finding in kubernetes.examine()}
    assert findings["rights"].found == "the worker may not create jobs.batch, list jobs.batch, watch pods"


@pytest.mark.parametrize("status", [403, 422])
def test_a_job_that_the_cluster_does_not_want(kubernetes, server, spec, status):
    server.trouble("create jobs", Trouble(status, "exceeded quota: compute"))
    with pytest.raises(StartFailed, match=rf"creating a Job: Kubernetes refuses it .{status}: exceeded quota: compute"):
        kubernetes.start(spec)


def test_findings(make_kubernetes, server, spec):
    kubernetes = make_kubernetes("--registry=registry.lab/slam")
    found = {finding.name: (finding.found, finding.remedy) for finding in kubernetes.examine()}
    assert found == {
        "cluster": ("v1.36.2, namespace default", None),
        "rights": ("all that are needed", None),
        "nodes": ("2 of 2 take runs", None),
        "storage": (f"nodes need {spec.work.parents[2].resolve()} at the same path", None),
        "images": ("registry registry.lab/slam", None),
    }
    server.cordon("node2")
    assert [(finding.name, finding.found, finding.remedy) for finding in kubernetes.examine_nodes()] == [
        ("node1", "takes runs, 4 cores, 8590 MB of memory", None),
        ("node2", "takes no runs now, 4 cores, 8590 MB of memory", "see kubectl describe node node2"),
    ]


def test_draining_a_node(kubernetes, server):
    kubernetes.drain("node2", True)
    assert [(node.name, node.takes_runs) for node in kubernetes.nodes()] == [("node1", True), ("node2", False)]
    kubernetes.drain("node2", False)
    assert all(node.takes_runs for node in kubernetes.nodes())
    server.forbidden.add("patch nodes")
    with pytest.raises(Forbidden, match="lacks the right to patch nodes"):
        kubernetes.drain("node2", True)


def test_nodes_with_a_label_and_a_gpu(make_kubernetes, server, spec):
    server.change("nodes", "node2", lambda node: node["metadata"]["labels"].update(disk="ssd"))
    kubernetes = make_kubernetes("--node=disk=ssd")
    assert [node.name for node in kubernetes.nodes()] == ["node2"]
    assert kubernetes.start(spec).data["node"] == "node2"
    with pytest.raises(Unavailable, match=r"no node of Kubernetes has nvidia\.com/gpu"):
        kubernetes.check_gpu()
    server.change("nodes", "node2", lambda node: node["status"]["allocatable"].update({"nvidia.com/gpu": "1"}))
    kubernetes.check_gpu()


def test_namespaces_and_contexts_of_the_kubeconfig(make_kubernetes, server, tmp_path, monkeypatch):
    path = server.kubeconfig(tmp_path / "other", namespace="lab")
    monkeypatch.setenv("KUBECONFIG", str(path))
    assert make_kubernetes().examine()[0].found.endswith("namespace lab")
    assert make_kubernetes("--namespace=slam").examine()[0].found.endswith("namespace slam")
    content = json.loads(path.read_text())
    content["contexts"].append({"name": "second", "context": {"cluster": "tests", "user": "me", "namespace": "two"}})
    path.write_text(json.dumps(content))
    assert make_kubernetes("--context=second").examine()[0].found.endswith("namespace two")
    assert "the kubeconfig cannot be used" in str(make_kubernetes("--context=third").unavailable_because())
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    assert "there is no kubeconfig" in str(make_kubernetes().unavailable_because())
