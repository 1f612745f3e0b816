"""Complete runs on a real Kubernetes whose nodes see no file of the worker."""

from __future__ import annotations

import json
import shutil
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import slamhive
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import VariantStep
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import DisturbanceKind
from slamhive.executors.kubernetes import manifest
from slamhive.executors.node_store.exchange import results_archive
from slamhive.executors.node_store.registrations import Registrations
from slamhive.executors.registry import installation_id
from slamhive.services.hive import Hive
from tests.burning import busy_machine
from tests.executors.kubernetes_cluster import NODES, KubernetesCluster
from tests.executors.pod_installation import pod_installation
from tests.services.docker_base import run_docker
from tests.services.installation import Installation
from tests.services.recorded_track import make_recorded_track
from tests.services.working import started_times
from tests.waiting import eventually

MAKER_PACKAGES = (
    *("numpy*", "cv2*", "opencv*", "rosbags*", "pydantic*", "annotated_types*", "typing_*", "yaml", "_yaml", "ruamel*"),
    *("_ruamel*", "lz4*", "zstandard*", "apsw*", "backports*"),
)
"""What making a variant imports."""

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(900)]


@pytest.fixture
def made(kubernetes_cluster: KubernetesCluster, base_image: str, tmp_path, monkeypatch) -> Iterator[Installation]:
    """An installation whose runs are pods on nodes that see nothing of it."""
    with pod_installation(
        kubernetes_cluster, base_image, tmp_path, monkeypatch, apart=True, run_cpu_cores="0.4"
    ) as made:
        yield made


def submit(hive: Hive, seconds: float = 0.2, **fields) -> int:
    (run,) = hive.runs.submit(Submission("tiny", "track", {"seconds": seconds}, **fields))
    return run.id


def pods(cluster: KubernetesCluster, made: Installation, kinds: str = "pods") -> list[dict[str, Any]]:
    chosen = manifest.selector(installation_id(made.machine.data))
    found: list[dict[str, Any]] = cluster.read(kinds, "-l", chosen)["items"]
    return found


def exists_in(cluster: KubernetesCluster, pod: dict[str, Any], script: str) -> bool:
    """What a script prints in the container of the run."""
    name = pod["metadata"]["name"]
    return cluster.kubectl("exec", name, "-c", "run", "--", "python3", "-c", script).strip() == "True"


def items_of(cluster: KubernetesCluster) -> dict[str, list[str]]:
    """The items in the cache of each node."""
    found = {node: sorted(cluster.cache_of(node).glob("sha256/*/*")) for node in NODES}
    return {node: [path.name for path in paths if len(path.name) == 64] for node, paths in found.items()}


def nothing_left(cluster: KubernetesCluster, made: Installation) -> None:
    """Neither in the cluster, nor in the data root."""
    assert pods(cluster, made, "jobs,pods,secrets") == []
    assert Registrations(made.machine.data).keys() == set()


def test_runs_and_their_evaluation(made, kubernetes_cluster):
    runs = [submit(made.hive, 2.0), submit(made.hive, 2.0, seed=1)]
    with busy_machine():
        made.hive.worker().run(until_idle=True)
    for run_id in runs:
        run = made.hive.runs.get(run_id)
        assert (run.state, run.poses) == (RunState.SUCCEEDED, 30), run.detail
        assert run.metrics["ate.rmse"] is not None
        assert run.metrics["cpu.mean"] > 0
        assert run.disturbance is not None
        assert DisturbanceKind.OTHERS in [reason.kind for reason in run.disturbance.reasons], run.disturbance.content
        folder = made.hive.runs.folder(run_id)
        assert "tiny says hello" in folder.log.read_text()
        assert not folder.work.exists()
        assert started_times(made.hive, run_id) == 1
    used = {made.hive.runs.folder(run_id).read_record()["handle"]["data"]["node"] for run_id in runs}
    caches = items_of(kubernetes_cluster)
    assert {node for node, items in caches.items() if items} == used
    nothing_left(kubernetes_cluster, made)


def test_a_run_sees_neither_the_ticket_nor_the_cache_and_has_no_rights(made, kubernetes_cluster):
    """Asked in the pod itself, by a process beside the algorithm."""
    submit(made.hive, 60.0, evaluate=False)
    worker = made.machine.start_worker()
    eventually(lambda: made.hive.runs.counts()[RunState.RUNNING] == 1, "the run")
    (pod,) = pods(kubernetes_cluster, made)
    name = pod["metadata"]["name"]

    def inside(container: str, script: str) -> str:
        command = ("exec", name, "-c", container, "--", "python3", "-c", script)
        return str(kubernetes_cluster.kubectl(*command)).strip()

    def exists(container: str, path: object) -> bool:
        return inside(container, f"import os; print(os.path.lexists({str(path)!r}))") == "True"

    for path in ("/run/slamhive-courier", "/run/slamhive-work", kubernetes_cluster.cache, made.machine.data):
        assert not exists("run", path), path
    assert exists("courier", "/run/slamhive-courier/ticket.json")
    script = (
        "import os; print([1 for pid in os.listdir('/proc') if pid.isdigit() and int(pid) != os.getpid() "
        "for line in [open('/proc/' + pid + '/cmdline').read()] if 'pyz' in line and 'report' in line])"
    )
    assert inside("run", script) == "[]"
    ask = (
        "import urllib.request as u, urllib.error as e\n"
        f"request = u.Request('{kubernetes_cluster.url}/v1/runs/x/result', headers={{'Authorization': 'Bearer x'}})\n"
        "try:\n    u.urlopen(request, timeout=10)\nexcept e.HTTPError as error:\n    print(error.code)"
    )
    assert inside("run", ask) == "401", "a pod has one network: the address is open to the run, without a token"
    made.machine.kill_worker(worker)


def test_results_arrive_though_the_worker_was_away_when_the_run_ended(made, kubernetes_cluster):
    run_id = submit(made.hive, 4.0, evaluate=False)
    worker = made.machine.start_worker()
    eventually(lambda: made.hive.runs.get(run_id).state is RunState.RUNNING, "the run")
    made.machine.kill_worker(worker)

    def ended_in_its_pod() -> bool:
        (pod,) = pods(kubernetes_cluster, made)
        script = "import os; print(os.path.exists('/run/slamhive/exit.json'))"
        try:
            return exists_in(kubernetes_cluster, pod, script)
        except AssertionError:  # as the run ends, its supervisor kills whatever else is in the container
            return False

    eventually(ended_in_its_pod, "the end of the algorithm")
    assert made.hive.runs.get(run_id).state is RunState.RUNNING
    assert results_archive(made.hive.runs.folder(run_id).work) is None
    made.machine.work_to_the_end()
    run = made.hive.runs.get(run_id)
    assert (run.state, run.poses) == (RunState.SUCCEEDED, 30), run.detail
    assert started_times(made.hive, run_id) == 1
    nothing_left(kubernetes_cluster, made)


@pytest.fixture
def maker_image(base_image: str, kubernetes_cluster: KubernetesCluster, tmp_path: Path) -> Iterator[str]:
    """An image with SLAM Hive as it is here, on both nodes."""
    packages = Path(np.__file__).parents[1]
    context = tmp_path / "image"
    (context / "packages").mkdir(parents=True)
    shutil.copytree(Path(slamhive.__file__).parent, context / "slamhive", ignore=shutil.ignore_patterns("__pycache__"))
    for path in (path for pattern in MAKER_PACKAGES for path in packages.glob(pattern)):
        copy = shutil.copytree if path.is_dir() else shutil.copyfile
        copy(path, context / "packages" / path.name)
    (context / "Dockerfile").write_text(
        f"FROM {base_image}\nCOPY . /opt/hive/\nENV PYTHONPATH=/opt/hive:/opt/hive/packages PYTHONDONTWRITEBYTECODE=1\n"
    )
    name = "slam-hive-test:maker"
    built = run_docker("build", "--tag", name, str(context))
    assert built.returncode == 0, built.stderr
    kubernetes_cluster.load(name)
    yield name
    run_docker("rmi", name)


def test_a_variant_is_made_on_the_node_that_needs_it(
    maker_image, kubernetes_cluster: KubernetesCluster, base_image: str, tmp_path, monkeypatch
):
    """Once for the runs of a node, from the recording, with the bytes that the controller would make."""
    settings = {"run_cpu_cores": "0.4", "kubernetes_options": f"--image={maker_image}"}
    with pod_installation(kubernetes_cluster, base_image, tmp_path, monkeypatch, apart=True, **settings) as made:
        hive, steps = made.hive, (VariantStep("rate", ("lidar",), {"every": 2}),)
        shutil.rmtree(hive.settings.data / "datasets" / "track")
        make_recorded_track(hive.settings.data)
        runs = [submit(hive, seed=seed, variant=steps, evaluate=False) for seed in (1, 2, 3)]
        hive.worker().run(until_idle=True)
        for run_id in runs:
            assert hive.runs.get(run_id).state is RunState.SUCCEEDED, hive.runs.get(run_id).detail
        assert hive.variants.entries() == ()
        said = [hive.runs.record(run_id)["dataset"] for run_id in runs]
        folders = [path for node in NODES for path in kubernetes_cluster.cache_of(node).glob("sha256/*/*/made.json")]
        assert 1 <= len(folders) <= len(NODES)
        with hive.variants.hold(hive.catalogue.dataset("track"), steps, lambda _done, _words: None) as used:
            assert said == [{**said[0], "variant": used.key, "variant_checksum": used.dataset.checksum}] * 3
            for folder in folders:
                assert folder.with_name("track.bag").read_bytes() == used.dataset.bag_path.read_bytes()
                assert not folder.with_name("groundtruth.txt").exists()
        nothing_left(kubernetes_cluster, made)


def test_a_deleted_pod_is_a_lost_run_and_is_not_started_twice(made, kubernetes_cluster):
    run_id = submit(made.hive, 60.0, evaluate=False)
    made.machine.start_worker(until_idle=True)
    eventually(lambda: made.hive.runs.get(run_id).state is RunState.RUNNING, "the run")
    (pod,) = pods(kubernetes_cluster, made)
    kubernetes_cluster.kubectl("delete", "pod", pod["metadata"]["name"], "--grace-period=0", "--force")
    eventually(lambda: made.hive.runs.get(run_id).state.ended, "the end")
    run = made.hive.runs.get(run_id)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.LOST), run.detail
    eventually(lambda: not made.machine.works(), "the end of the worker")
    nothing_left(kubernetes_cluster, made)


def test_another_token_is_refused(made, kubernetes_cluster):
    run_id = submit(made.hive, 60.0, evaluate=False)
    worker = made.machine.start_worker()
    eventually(lambda: made.hive.runs.get(run_id).state is RunState.RUNNING, "the run")
    (secret,) = pods(kubernetes_cluster, made, "secrets")
    assert set(secret["data"]) == {"ticket.json", "courier.pyz", "supervisor.pyz"}
    (registration,) = made.machine.data.glob("node-runs/*.json")
    key = json.loads(registration.read_text())["key"]
    request = urllib.request.Request(
        f"http://127.0.0.1:{kubernetes_cluster.port}/v1/runs/{key}/state/exit.json",
        data=b"{}",
        method="PUT",
        headers={"Authorization": "Bearer wrong"},
    )
    with pytest.raises(urllib.error.HTTPError, match="401"):
        urllib.request.urlopen(request, timeout=10)
    made.hive.runs.cancel(run_id)
    eventually(lambda: made.hive.runs.get(run_id).state.ended, "the end")
    assert made.hive.runs.get(run_id).state is RunState.CANCELLED
    made.machine.kill_worker(worker)
    nothing_left(kubernetes_cluster, made)


def test_a_cache_without_room_is_the_reason(made, kubernetes_cluster, monkeypatch):
    monkeypatch.setenv("SLAMHIVE_NODE_CACHE_BYTES", "1000")
    run_id = submit(made.hive, evaluate=False)
    made.machine.work_to_the_end()
    run = made.hive.runs.get(run_id)
    assert (run.state, run.reason) == (RunState.FAILED, FailureReason.START_ERROR), run.detail
    assert "has no room for" in (run.detail or "")
    nothing_left(kubernetes_cluster, made)
