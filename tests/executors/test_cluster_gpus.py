"""A real Slurm and a real Kubernetes give out a GPU that does not exist: what they schedule is real."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.algorithm import GivenGpu
from slamhive.executors.base import EngineUnavailable, StartFailed
from slamhive.executors.kubernetes import run_jobs
from slamhive.executors.registry import open_executor
from slamhive.executors.slurm import executor as slurm_executor
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import RunHandle
from tests.executors.conftest import Bench, wait_for_end
from tests.executors.kubernetes_cluster import NODES, KubernetesCluster
from tests.executors.test_contract import RESULT
from tests.services.installation import installation
from tests.waiting import eventually

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(600)]

UNTIL_STOPPED = RESULT + (
    "(result / 'ready').write_text(os.environ.get('CUDA_VISIBLE_DEVICES', 'none'))\ntime.sleep(120)\n"
)
RESOURCE = "nvidia.com/gpu"


def wants_gpu(bench: Bench) -> RunSpec:
    return replace(bench.spec(UNTIL_STOPPED), asks_gpu=True)


def started(bench: Bench, spec: RunSpec) -> RunHandle:
    """The handle, as soon as the engine has a place for the run."""
    handles: list[RunHandle] = []

    def start() -> bool:
        try:
            handles.append(bench.executor.start(spec))
        except EngineUnavailable:
            return False
        return True

    eventually(start, "the start")
    bench.handles.extend(handles)
    bench.wait_for(spec, handles[0])
    return handles[0]


def check_turns(bench: Bench, waiting: str) -> tuple[RunHandle, RunHandle]:
    """Of two runs that ask for the only GPU, one waits; a run that asks for none does not."""
    first, second = wants_gpu(bench), wants_gpu(bench)
    handle = started(bench, first)
    for _ in range(2):
        with pytest.raises(EngineUnavailable, match=waiting):
            bench.executor.start(second)
    without = bench.spec(UNTIL_STOPPED)
    assert started(bench, without).gpu is None
    bench.executor.stop(handle, 0.0)
    wait_for_end(bench.executor, handle)
    return handle, started(bench, second)


@pytest.mark.parametrize("maker", ["slurm", "slurm-none"], indirect=True)
def test_slurm_gives_a_gpu_to_one_run_at_a_time_and_the_run_knows_which(bench, monkeypatch):
    monkeypatch.setattr(slurm_executor, "START_WAIT_S", 3.0)
    bench.executor.check_gpu()
    for handle in check_turns(bench, "waits in Slurm"):
        assert handle.gpu == GivenGpu("one", "0")
    ready = [bench.root / key / "result" / "ready" for key in (entry.data["key"] for entry in bench.handles)]
    assert [path.read_text() for path in ready] == ["0", "none", "0"]


@pytest.mark.parametrize("maker", ["slurm-none"], indirect=True)
def test_a_kind_of_gpu_that_slurm_does_not_have(bench):
    other = open_executor("slurm", replace(bench.context, options={**bench.context.options, "gpu": "gpu:a100:1"}))
    with pytest.raises(Unavailable, match="no node of Slurm has the gres gpu:a100:1"):
        other.check_gpu()
    with pytest.raises(StartFailed, match="sbatch refuses"):
        other.start(wants_gpu(bench))
    other.close()


def runs_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, need: str, gpu: str) -> list[dict[str, Any]]:
    """The records of two runs, at the same time if they can be, of a package with this need of a GPU.

    Each with what was measured of its GPU, as ``gpu.csv``.
    """
    settings = {"worker_slots": "2", "slurm_containers": "none", "slurm_gpu": gpu}
    with installation(tmp_path, monkeypatch, executor="slurm", **settings) as made:  # type: ignore[arg-type]
        (package,) = (tmp_path / "project").glob("algorithms/tiny/algorithm.yaml")
        package.write_text(f"{package.read_text()}gpu: {need}\n")
        made.submit(2, (1.0,))
        made.hive.worker().run(until_idle=True)
        folders = [made.hive.runs.folder(run.id) for run in made.hive.runs.page().records]
        return [
            {**folder.read_record(), "gpu.csv": folder.gpu.read_text() if folder.gpu.exists() else None}
            for folder in folders
        ]


def test_the_record_of_a_run_names_its_gpu(slurm_cluster, tmp_path, monkeypatch):
    records = runs_of(tmp_path, monkeypatch, "required", "gpu:fake:1")
    assert [record["state"] for record in records] == ["succeeded"] * 2
    assert [(record["gpu"]["node"], record["gpu"]["number"]) for record in records] == [("one", "0")] * 2
    why = "# not measured: nobody knows the UUID of GPU 0 of one\n"
    assert [record["gpu.csv"] for record in records] == [why] * 2


def test_who_can_use_a_gpu_runs_without_where_there_is_none(slurm_cluster, tmp_path, monkeypatch):
    records = runs_of(tmp_path, monkeypatch, "optional", "gpu:a100:1")
    found = [(record["state"], record.get("gpu"), record["gpu.csv"]) for record in records]
    assert found == [("succeeded", None, None)] * 2


def test_who_requires_a_gpu_is_refused_where_there_is_none(slurm_cluster, tmp_path, monkeypatch):
    with pytest.raises(InvalidInput, match="tiny requires a GPU: no node of Slurm has the gres gpu:a100:1"):
        runs_of(tmp_path, monkeypatch, "required", "gpu:a100:1")


@pytest.fixture
def fitted(kubernetes_cluster: KubernetesCluster) -> Iterator[KubernetesCluster]:
    """The first node says that it has a GPU, as a device plugin would."""

    def patch(operation: dict[str, str]) -> None:
        path = f"/status/%s/{RESOURCE.replace('/', '~1')}"
        changes = json.dumps([operation | {"path": path % where} for where in ("capacity", "allocatable")])
        kubernetes_cluster.kubectl("patch", "node", NODES[0], "--subresource=status", "--type=json", "-p", changes)

    patch({"op": "add", "value": "1"})
    yield kubernetes_cluster
    patch({"op": "remove"})


@pytest.mark.parametrize("maker", ["kubernetes"], indirect=True)
def test_kubernetes_gives_a_gpu_to_one_run_at_a_time(bench, fitted, monkeypatch):
    monkeypatch.setattr(run_jobs, "START_WAIT_S", 5.0)
    bench.executor.check_gpu()
    for handle in check_turns(bench, rf"waits in Kubernetes: .*Insufficient {RESOURCE}"):
        assert handle.gpu == GivenGpu(NODES[0])  # no device plugin has said which


@pytest.mark.parametrize("maker", ["kubernetes"], indirect=True)
def test_a_kubernetes_without_gpus(bench):
    with pytest.raises(Unavailable, match=f"no node of Kubernetes has {RESOURCE}"):
        bench.executor.check_gpu()
    with pytest.raises(StartFailed, match=f"asks for 1 {RESOURCE}, but the largest node has 0"):
        bench.executor.start(wants_gpu(bench))
