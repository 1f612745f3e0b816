"""Complete runs on a real Slurm and a real Kubernetes whose nodes have other work: what disturbed a run is known."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from slamhive.domain.trust import DisturbanceKind
from slamhive.executors.host_counters import NOT_MEASURED
from slamhive.run_folder.profiling import read_host_load
from tests.burning import busy_machine
from tests.executors.pod_installation import pod_installation
from tests.services.installation import Installation, installation

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(900)]

SECONDS = 4.0


@pytest.fixture(params=["slurm", "kubernetes"])
def made(request, tmp_path, monkeypatch) -> Iterator[Installation]:
    """An installation whose runs are jobs, or pods."""
    if request.param == "slurm":
        request.getfixturevalue("slurm_cluster")
        with installation(tmp_path, monkeypatch, executor="slurm", slurm_containers="none") as made:
            made.build()
            yield made
        return
    cluster, image = request.getfixturevalue("kubernetes_cluster"), request.getfixturevalue("base_image")
    with pod_installation(cluster, image, tmp_path, monkeypatch) as made:
        yield made


def test_a_run_beside_other_work_is_disturbed_and_repeated(made):
    asked = Submission("tiny", "track", {"seconds": SECONDS}, evaluate=False, repeat_disturbed=1)
    made.hive.runs.submit(asked)
    with busy_machine():
        made.hive.worker().run(until_idle=True)
    runs = made.hive.runs.page().records
    assert len(runs) == 2, "the run and its repeat"
    for run in runs:
        assert run.state is RunState.SUCCEEDED, run.detail
        assert run.disturbance is not None
        assert DisturbanceKind.OTHERS in [reason.kind for reason in run.disturbance.reasons], run.disturbance.content
        folder = made.hive.runs.folder(run.id)
        load = read_host_load(folder.host)
        assert load.covered_s > 0.5 * SECONDS
        assert load.cores == (1 if run.executor == "slurm" else os.cpu_count()), "Slurm gives a job cores of its own"
        others_cores = load.mean("others_cores")
        assert others_cores is not None
        assert others_cores > 0.4 * load.cores
        # Were the run's own CPU time counted as others', the sum would exceed what the node has.
        assert others_cores + run.metrics["cpu.mean"] < 1.15 * load.cores
        assert folder.energy.read_text() == f"{NOT_MEASURED}the run was on another machine than the worker\n"
