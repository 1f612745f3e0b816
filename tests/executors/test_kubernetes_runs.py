"""Complete runs on a real Kubernetes: an experiment, and workers and API servers that are killed."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.executors.kubernetes import manifest
from slamhive.executors.registry import installation_id
from slamhive.services.hive import Hive, open_hive
from slamhive.store import RunRecord
from tests.executors.kubernetes_cluster import KubernetesCluster
from tests.services.docker_base import run_docker
from tests.services.installation import TINY_IMAGE
from tests.services.killed_worker import check_whole, kill_at_each_step
from tests.services.tiny_project import environment, make_dataset, make_project
from tests.services.working import started_times, working
from tests.waiting import eventually

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(3000)]

DEPLOYMENT = Path(__file__).resolve().parents[2] / "deploy" / "kubernetes"
RUNS = 40
BETWEEN_KILLS_S = 20.0


@pytest.fixture
def hive(kubernetes_cluster, base_image: str, tmp_path, monkeypatch) -> Iterator[Hive]:
    """An installation whose runs are pods. As images made for the published SLAM Hive, its image holds no scripts."""
    project, data = make_project(tmp_path / "project"), tmp_path / "data"
    (project / "algorithms" / "tiny" / "Dockerfile").unlink()
    make_dataset(data)
    kubernetes_cluster.use(monkeypatch)
    settings = environment(project, data, executor="kubernetes", worker_slots="2", run_cpu_cores="0.4")
    for key, value in settings.items():
        monkeypatch.setenv(key, value)
    assert run_docker("tag", base_image, TINY_IMAGE).returncode == 0
    opened = open_hive()
    yield opened
    opened.close()
    run_docker("rmi", TINY_IMAGE)


def submit(hive: Hive, count: int = 1, **fields) -> list[int]:
    parameters = fields.pop("parameters", {"seconds": 0.05})
    asked = [Submission("tiny", "track", parameters, seed=seed, **fields) for seed in range(count)]
    return [hive.runs.submit(submission)[0].id for submission in asked]


def left(cluster: KubernetesCluster, hive: Hive) -> list[str]:
    """Jobs and pods of this installation."""
    chosen = manifest.selector(installation_id(hive.settings.data))
    return [entry["metadata"]["name"] for entry in cluster.read("jobs,pods", "-l", chosen)["items"]]


def test_a_run_and_its_evaluation(hive, kubernetes_cluster):
    (run_id,) = submit(hive, parameters={"seconds": 1.5, "behaviour": "lost"})
    hive.worker().run(until_idle=True)
    run = hive.runs.get(run_id)
    assert (run.state, run.poses, run.executor) == (RunState.SUCCEEDED, 30, "kubernetes"), run.detail
    assert run.metrics["ate.rmse"] is not None
    assert run.metrics["cpu.mean"] > 0
    folder = hive.runs.folder(run_id)
    assert "tiny says hello" in folder.log.read_text()
    assert len(folder.profiling.read_text().splitlines()) > 5
    assert not folder.work.exists()
    assert "pod on node" in str(folder.read_record()["protections"])
    assert left(kubernetes_cluster, hive) == []


@pytest.mark.parametrize(("behaviour", "reason"), [("crash", "nonzero_exit"), ("hungry", "out_of_memory")])
def test_failures_have_their_reason(hive, behaviour, reason):
    (run_id,) = submit(hive, parameters={"behaviour": behaviour, "seconds": 5.0}, evaluate=False, memory_mb=100)
    hive.worker().run(until_idle=True)
    run = hive.runs.get(run_id)
    assert (run.state, str(run.reason)) == (RunState.FAILED, reason), run.detail


def test_a_run_is_cancelled(hive, kubernetes_cluster):
    (run_id,) = submit(hive, parameters={"seconds": 50})
    with working(hive):
        eventually(lambda: hive.runs.get(run_id).state is RunState.RUNNING, "the run")
        eventually(lambda: "tiny says hello" in hive.runs.log(run_id), "the log")
        hive.runs.cancel(run_id)
        eventually(lambda: hive.runs.get(run_id).state.ended, "the end")
    assert hive.runs.get(run_id).state is RunState.CANCELLED
    assert left(kubernetes_cluster, hive) == []


def test_an_experiment_while_api_servers_are_killed(hive, kubernetes_cluster):
    """Nothing is lost and nothing is executed twice."""
    runs = submit(hive, RUNS, parameters={"seconds": 0.5}, evaluate=False)
    kills = 0
    with working(hive):
        while any(not hive.runs.get(run_id).state.ended for run_id in runs):
            kubernetes_cluster.kill_api_server()
            kills += 1
            kubernetes_cluster.wait_for_api_server()
            threading.Event().wait(BETWEEN_KILLS_S)  # the scheduler, too, has to find it again
    assert kills > 2
    states = {run_id: hive.runs.get(run_id) for run_id in runs}
    assert {run.state for run in states.values()} == {RunState.SUCCEEDED}, [run.detail for run in states.values()]
    assert [started_times(hive, run_id) for run_id in runs] == [1] * RUNS
    assert left(kubernetes_cluster, hive) == []


def test_killed_at_any_step_the_run_ends_once_and_well(hive, kubernetes_cluster):
    def check(run: RunRecord, when: str) -> None:
        check_whole(hive, run, when)
        assert left(kubernetes_cluster, hive) == [], when

    asked = Submission("tiny", "track", {"seconds": 0.05})
    kill_at_each_step(hive, asked, lambda count: range(2, count + 1, 2), check)


@pytest.mark.parametrize("apart", [False, True])
def test_the_api_server_accepts_the_deployment(kubernetes_cluster, tmp_path, apart):
    """Nothing is made: that the parts find each other is unverified."""
    folder = shutil.copytree(DEPLOYMENT, tmp_path / "kubernetes")
    if apart:
        with (folder / "kustomization.yaml").open("a") as stream:
            stream.write("components:\n  - apart\n")
    (folder / "secrets.env").write_text("MYSQL_PASSWORD=one\nSLAMHIVE_SECRET_KEY=two\n")
    made = kubernetes_cluster.kubectl("kustomize", str(folder))
    # The namespace is not made either, so that another one has to stand for it.
    elsewhere = made.replace("namespace: slamhive\n", "namespace: default\n")
    accepted = kubernetes_cluster.kubectl("apply", "--dry-run=server", "-f", "-", stdin=elsewhere)
    assert accepted.count("created (server dry run)") == made.count("\nkind: ")
