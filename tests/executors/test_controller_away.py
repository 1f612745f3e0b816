"""The controller is away for long, on nodes that share nothing with it: runs go on, and their results arrive later.

``SLAMHIVE_AWAY_S=3600 make test TIERS=long`` keeps it away for an hour.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.run import RunState
from tests.executors.pod_installation import pod_installation
from tests.executors.random_kills import check_accounts
from tests.executors.slurm_installation import slurm_installation
from tests.services.installation import Installation
from tests.services.machine import wait_s
from tests.waiting import eventually

AWAY_S = float(os.environ.get("SLAMHIVE_AWAY_S", "20"))
PARTS_OF_IT = (0.1, 0.3, 0.6, 1.05)
"""How long the first runs take: most end while the controller is away."""
SHORT_S = 2.0
RUNS = 12
SLOTS = 8
"""Some runs wait in the engine when the controller goes away, and the last ones have not been submitted."""
CORES = {"slurm": "1", "kubernetes": "0.4"}
"""Four runs at a time on two nodes."""

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(600 + int(6 * AWAY_S))]


@pytest.fixture(params=["slurm", "kubernetes"])
def made(request, tmp_path, monkeypatch) -> Iterator[Installation]:
    settings = {"worker_slots": str(SLOTS), "run_cpu_cores": CORES[request.param]}
    if request.param == "slurm":
        cluster = request.getfixturevalue("apart_cluster")
        image = lambda: request.getfixturevalue("base_image")  # noqa: E731
        with slurm_installation(cluster, image, tmp_path, monkeypatch, **settings) as made:
            yield made
    else:
        cluster, image = request.getfixturevalue("kubernetes_cluster"), request.getfixturevalue("base_image")
        with pod_installation(cluster, image, tmp_path, monkeypatch, apart=True, **settings) as made:
            yield made


def allow_long_runs(made: Installation) -> None:
    """The algorithm of the tests takes at most 60 s."""
    package = made.hive.catalogue.project_root / "algorithms" / "tiny" / "algorithm.yaml"
    package.write_text(package.read_text().replace("maximum: 60", f"maximum: {2 * AWAY_S:.0f}"))


def test_runs_go_on_and_their_results_arrive(made):
    allow_long_runs(made)
    for number in range(RUNS):
        parameters = {"seconds": AWAY_S * PARTS_OF_IT[number] if number < len(PARTS_OF_IT) else SHORT_S}
        made.hive.runs.submit(Submission("tiny", "track", parameters, seed=number, timeout_s=3600 + int(2 * AWAY_S)))
    worker = made.machine.start_worker()
    eventually(lambda: made.hive.runs.counts()[RunState.RUNNING] >= 3, "the first runs", 240.0)
    wait_s(3.0)
    made.machine.kill_worker(worker)
    before = made.hive.runs.counts()
    wait_s(AWAY_S)
    assert made.hive.runs.counts() == before
    made.machine.start_worker()
    eventually(made.finished, "the end of all runs", 600 + 4 * AWAY_S)
    sys.stdout.write(f"\naway for {AWAY_S:.0f} s with {dict(before)}; then {dict(made.hive.runs.counts())}\n")
    check_accounts(made, RUNS, most_lost=0)
