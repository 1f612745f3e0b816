"""Runs on a real Kubernetes whose parts go away, and runs that it cannot or may not start."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.executors.base import EngineUnavailable, ImageMissing, StartFailed
from slamhive.executors.kubernetes import manifest, run_jobs
from slamhive.executors.kubernetes.answers import Document
from slamhive.executors.kubernetes.executor import KubernetesExecutor
from slamhive.executors.kubernetes.manifest import places_of
from slamhive.executors.spec import ResourceLimits
from slamhive.executors.status import Exited, Gone, Running
from tests.executors.conftest import Bench, wait_for_end
from tests.executors.kubernetes_cluster import NODES, KubernetesCluster
from tests.waiting import eventually

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.timeout(600),
    pytest.mark.parametrize("maker", ["kubernetes"], indirect=True),
]

RIGHTS = Path(__file__).resolve().parents[2] / "deploy" / "kubernetes" / "base" / "rights.yaml"
RESULT = "import os, pathlib, sys, time\nresult = pathlib.Path('/slamhive/result')\n"
UNTIL_STOPPED = RESULT + "open(result / 'starts', 'a').write('x')\n(result / 'ready').touch()\ntime.sleep(120)\n"
NAMESPACE = "slamhive"


def pods_of(cluster: KubernetesCluster, bench: Bench, key: str) -> list[Document]:
    found: list[Document] = cluster.read("pods", "-l", manifest.selector(bench.context.installation, key))["items"]
    return found


def started(bench: Bench, limits: ResourceLimits | None = None):
    """A run that goes on until somebody ends it."""
    spec, handle = bench.start(UNTIL_STOPPED, limits)
    bench.wait_for(spec, handle)
    assert isinstance(bench.executor.poll(handle), Running)
    return spec, handle


def lost(bench: Bench, handle) -> str:
    """Why the run was lost."""
    eventually(lambda: not isinstance(bench.executor.poll(handle), Running), "the loss")
    status = bench.executor.poll(handle)
    assert isinstance(status, Gone), status
    return status.why


def starts(bench: Bench, spec, handle) -> str:
    bench.executor.collect(spec, handle)
    return str((bench.result(spec) / "starts").read_text())


def test_a_deleted_pod_is_a_lost_run_and_no_other_takes_its_place(bench, kubernetes_cluster):
    spec, handle = started(bench)
    (pod,) = pods_of(kubernetes_cluster, bench, spec.key)
    kubernetes_cluster.kubectl("delete", "pod", pod["metadata"]["name"], "--wait=false")
    assert "from outside" in lost(bench, handle)
    eventually(lambda: not pods_of(kubernetes_cluster, bench, spec.key), "the end of the pod")
    assert starts(bench, spec, handle) == "x"


def test_a_deleted_job_is_a_lost_run(bench, kubernetes_cluster):
    _, handle = started(bench)
    kubernetes_cluster.kubectl("delete", "job", handle.data["job"], "--wait=false")
    assert "from outside" in lost(bench, handle)


def test_a_pod_that_was_deleted_by_force(bench, kubernetes_cluster):
    spec, handle = started(bench)
    (pod,) = pods_of(kubernetes_cluster, bench, spec.key)
    kubernetes_cluster.kubectl("delete", "pod", pod["metadata"]["name"], "--force", "--grace-period=0", "--wait=false")
    assert "from outside" in lost(bench, handle)


def test_the_api_server_is_killed_while_runs_go_on_and_end(bench, kubernetes_cluster):
    """What a pod has recorded arrives without the API server."""
    script = RESULT + (
        "open(result / 'starts', 'a').write('x')\n"
        "print('goes on', flush=True)\n(result / 'ready').touch()\ntime.sleep(2)\nsys.exit(4)\n"
    )
    spec, handle = bench.start(script)
    for _ in range(3):
        kubernetes_cluster.kill_api_server()
        assert bench.again().start(spec) == handle
        kubernetes_cluster.wait_for_api_server()

    def ended() -> bool:
        try:
            return not isinstance(bench.executor.poll(handle), Running)
        except EngineUnavailable:
            return False

    eventually(ended, "the end of the run")
    assert bench.executor.poll(handle).exit_code == 4
    assert starts(bench, spec, handle) == "x"


def test_a_restarted_worker_follows_a_run_that_went_on_alone(bench):
    _, handle = started(bench)
    other = bench.again()
    assert isinstance(other.poll(handle), Running)
    other.stop(handle, 1.0)
    assert other.poll(handle).exit_code in (137, 143)
    other.close()


def test_a_lost_node_is_a_lost_run(bench, kubernetes_cluster, monkeypatch):
    monkeypatch.setattr(manifest, "NODE_PATIENCE_S", 2)
    spec, handle = started(bench)
    node = handle.data["node"]
    kubernetes_cluster.lose(node)
    try:
        assert f"node {node} is lost" in lost(bench, handle)
        bench.executor.remove(handle)
        assert pods_of(kubernetes_cluster, bench, spec.key) == []
    finally:
        kubernetes_cluster.bring_back(node)


def test_a_run_that_no_node_can_ever_take(bench):
    with pytest.raises(StartFailed, match="asks for 5000 cores, but the largest node has"):
        bench.start(UNTIL_STOPPED, ResourceLimits(cpu_cores=5000.0))
    with pytest.raises(StartFailed, match="MB of memory, but the largest node has"):
        bench.start(UNTIL_STOPPED, ResourceLimits(memory_bytes=10**15))


def test_a_run_that_waits_for_its_turn_starts_later_and_once(bench, kubernetes_cluster, monkeypatch):
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 1.0)
    for node in NODES:
        kubernetes_cluster.kubectl("cordon", node)
    spec = bench.spec(UNTIL_STOPPED)

    def waits_because() -> str:
        with pytest.raises(EngineUnavailable, match="run 1 waits in Kubernetes: ") as refused:
            bench.executor.start(spec)
        return str(refused.value)

    try:
        eventually(lambda: "unschedulable" in waits_because(), "the verdict of the scheduler")
        waits_because()
    finally:
        for node in NODES:
            kubernetes_cluster.kubectl("uncordon", node)
    monkeypatch.undo()
    kubernetes_cluster.use(monkeypatch)
    handle = bench.executor.start(spec)
    bench.handles.append(handle)
    bench.wait_for(spec, handle)
    assert starts(bench, spec, handle) == "x"


def test_discarding_a_run_that_waits(bench, kubernetes_cluster, monkeypatch):
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 0.5)
    for node in NODES:
        kubernetes_cluster.kubectl("cordon", node)
    try:
        spec = bench.spec(UNTIL_STOPPED)
        with pytest.raises(EngineUnavailable):
            bench.executor.start(spec)
        bench.executor.discard(spec)
        assert pods_of(kubernetes_cluster, bench, spec.key) == []
        assert kubernetes_cluster.read("jobs", "-l", manifest.selector(bench.context.installation))["items"] == []
    finally:
        for node in NODES:
            kubernetes_cluster.kubectl("uncordon", node)


def test_a_missing_image_is_named_with_the_remedy_and_leaves_nothing(bench, kubernetes_cluster):
    spec = replace(bench.spec(UNTIL_STOPPED), identity="sha256:" + "0" * 64)
    with pytest.raises(ImageMissing, match=r"image sha256:0000.* node node\d does not have it .*load it there"):
        bench.executor.start(spec)
    assert pods_of(kubernetes_cluster, bench, spec.key) == []


def test_files_that_the_nodes_do_not_share(bench, monkeypatch):
    """Said at once when the pod cannot start, not after hours."""
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 8.0)

    def elsewhere(*arguments):
        return [replace(place, source=Path("/not/shared") / place.source.name) for place in places_of(*arguments)]

    monkeypatch.setattr(run_jobs, "places_of", elsewhere)
    spec = bench.spec(UNTIL_STOPPED)
    with pytest.raises(StartFailed, match=r"does not get its files: FailedMount.*at the same path"):
        bench.executor.start(spec)
    bench.executor.discard(spec)


def test_a_broken_program_is_named(bench):
    spec = replace(bench.spec(UNTIL_STOPPED), command=("/no/such/program",))
    with pytest.raises(StartFailed, match=r"could not be started in its pod: .*/no/such/program"):
        bench.executor.start(spec)
    bench.executor.discard(spec)


def test_jobs_of_runs_that_are_over_are_swept(bench, kubernetes_cluster):
    spec, handle = started(bench)
    assert bench.again().sweep(lambda: {spec.key}) == []
    assert bench.again().sweep(set) == [handle.data["job"]]
    assert pods_of(kubernetes_cluster, bench, spec.key) == []
    assert "from outside" in lost(bench, handle)


def with_token(cluster: KubernetesCluster, folder: Path, token: str) -> Path:
    """A kubeconfig that says who is asking by a token."""
    content = json.loads(cluster.kubeconfig.read_text())
    content["users"][0]["user"] = {"token": token}
    path = folder / "token-kubeconfig"
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def as_user(bench, kubernetes_cluster, tmp_path, monkeypatch) -> Callable[..., KubernetesExecutor]:
    """Makes an executor that has a token and options."""

    def make(token: str, options: str = "") -> KubernetesExecutor:
        monkeypatch.setenv("KUBECONFIG", str(with_token(kubernetes_cluster, tmp_path, token)))
        return KubernetesExecutor(replace(bench.context, data=bench.root, options={"options": options}))

    return make


def test_wrong_credentials(as_user):
    executor = as_user("expired")
    assert "does not accept the credentials" in str(executor.unavailable_because())
    executor.close()


def test_a_missing_right_is_named(bench, as_user, kubernetes_cluster):
    token = kubernetes_cluster.kubectl("create", "token", "default").strip()
    executor = as_user(token)
    assert "lacks the right to list jobs.batch" in str(executor.unavailable_because())
    with pytest.raises(StartFailed, match=r"lacks the right to create jobs.batch"):
        executor.start(bench.spec(UNTIL_STOPPED))
    executor.close()


@pytest.fixture
def namespace(kubernetes_cluster):
    """A namespace with the rights that the project ships, and a claim."""
    kubernetes_cluster.kubectl("create", "namespace", NAMESPACE)
    kubernetes_cluster.kubectl("apply", "-f", str(RIGHTS))
    yield NAMESPACE
    kubernetes_cluster.kubectl("delete", "namespace", NAMESPACE)
    kubernetes_cluster.kubectl("delete", "-f", str(RIGHTS), "--ignore-not-found")


def test_the_rights_that_the_project_ships_are_enough_and_a_claim_holds_the_files(
    bench, as_user, kubernetes_cluster, namespace
):
    storage = {"capacity": {"storage": "1Gi"}, "accessModes": ["ReadWriteMany"], "storageClassName": ""}
    volume = storage | {"hostPath": {"path": str(bench.root)}}
    claim = {
        "accessModes": ["ReadWriteMany"],
        "storageClassName": "",
        "volumeName": "shared",
        "resources": {"requests": {"storage": "1Gi"}},
    }
    for kind, name, spec in (("PersistentVolume", "shared", volume), ("PersistentVolumeClaim", "data", claim)):
        document = {
            "apiVersion": "v1",
            "kind": kind,
            "metadata": {"name": name} | ({} if kind == "PersistentVolume" else {"namespace": namespace}),
            "spec": spec,
        }
        kubernetes_cluster.kubectl("apply", "-f", "-", stdin=json.dumps(document))
    token = kubernetes_cluster.kubectl("create", "token", "slamhive-worker", "-n", namespace).strip()
    executor = as_user(token, f"--namespace={namespace} --claim=data")
    try:
        assert executor.unavailable_because() is None
        assert [finding.remedy for finding in executor.examine()] == [None] * 5
        spec = bench.spec(RESULT + "(result / 'traj.txt').write_text('x')\nprint('hello')\n")
        handle = executor.start(spec)
        assert wait_for_end(executor, handle).exit_code == 0
        executor.collect(spec, handle)
        assert (bench.result(spec) / "traj.txt").read_text() == "x"
        executor.save_log(handle, bench.log(spec))
        assert bench.log(spec).read_text() == "hello\n"
        executor.remove(handle)
        executor.discard(spec)
        assert executor.sweep(set) == []
    finally:
        executor.close()
        kubernetes_cluster.kubectl("delete", "pvc", "data", "-n", namespace)
        kubernetes_cluster.kubectl("delete", "pv", "shared")


def test_findings(bench):
    nodes = bench.executor.examine_nodes()
    assert [(finding.name, finding.remedy) for finding in nodes] == [(name, None) for name in NODES]
    assert "takes runs" in nodes[0].found
    assert "cores" in nodes[0].found
    names = ["cluster", "rights", "nodes", "storage", "images"]
    findings = bench.executor.examine()
    assert [finding.name for finding in findings] == names
    assert findings[2].found == "2 of 2 take runs"
    assert [finding.remedy for finding in findings] == [None] * 5


def test_the_record_names_the_node(bench):
    _, handle = started(bench)
    assert handle.data["node"] in NODES
    assert f"pod on node {handle.data['node']} (" in handle.protections.held_by
    assert isinstance(bench.executor.poll(handle), Running)
    bench.executor.stop(handle, 0.0)
    assert isinstance(bench.executor.poll(handle), Exited)
