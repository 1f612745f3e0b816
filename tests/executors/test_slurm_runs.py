"""Complete runs on a real Slurm whose controller, nodes and workers are killed: each is accounted for."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import pytest

from slamhive.domain.run import RunState
from slamhive.executors.registry import installation_id
from slamhive.executors.slurm import command
from slamhive.executors.slurm.jobs import comment_of
from tests.executors.random_kills import PATIENCE_S, RUNS, RandomKills, check_accounts
from tests.executors.slurm_cluster import NODES, Cluster
from tests.executors.slurm_installation import slurm_installation
from tests.services.installation import Installation
from tests.services.machine import wait_s
from tests.waiting import eventually

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(1500)]

SEED = 20_261_123
SECONDS = (0.2, 0.5, 1.5)
AWAY_S = 2.0
SHARED = "slurm_cluster"


@pytest.fixture
def cluster(request) -> Cluster:
    """The Slurm of a test, by the name of its fixture."""
    found: Cluster = request.getfixturevalue(getattr(request, "param", SHARED))
    return found


@pytest.fixture
def made(request, cluster: Cluster, tmp_path, monkeypatch) -> Iterator[Installation]:
    """An installation whose runs are jobs."""
    image = lambda: request.getfixturevalue("base_image")  # noqa: E731
    with slurm_installation(cluster, image, tmp_path, monkeypatch, worker_slots="4") as made:
        yield made


def check_all(made: Installation, runs: int, most_lost: int) -> None:
    """The accounts are right, and Slurm has nothing left."""
    check_accounts(made, runs, most_lost)
    prefix = comment_of(installation_id(made.machine.data), "")
    assert not [job for job in command.list_jobs() if job.comment.startswith(prefix) and not job.over]


def test_an_experiment_while_a_node_goes_down_and_the_controller_is_killed(made, cluster):
    """Only runs on the node that goes down may be lost."""
    made.submit(RUNS, SECONDS)
    began_s = time.monotonic()
    made.machine.start_worker()
    eventually(lambda: made.hive.runs.counts()[RunState.SUCCEEDED] >= 5, "the first runs")
    cluster.run("scontrol", "update", "nodename=two", "state=down", "reason=test")
    wait_s(AWAY_S)
    cluster.wait_until_saved()
    cluster.kill("slurmctld")
    wait_s(AWAY_S)
    cluster.start_controller()
    cluster.bring_back("two")
    eventually(made.finished, "the end of all runs", PATIENCE_S)
    sys.stdout.write(f"\n{RUNS} runs in {time.monotonic() - began_s:.1f} s\n")
    check_all(made, RUNS, most_lost=4)


@pytest.mark.long
@pytest.mark.parametrize("cluster", [SHARED, "apart_cluster"], indirect=True)
def test_everything_is_killed_at_random_moments(made, cluster):
    """The worker, the controller, the daemons of the nodes, and whole nodes."""
    kills = RandomKills(made, SEED, SECONDS)

    def kill_controller() -> None:
        cluster.kill("slurmctld")
        kills.pause()
        cluster.start_controller()

    def kill_daemon() -> None:
        node = kills.rng.choice(NODES)
        cluster.kill(f"slurmd-{node}")
        cluster.start_node(node)

    def kill_node() -> None:
        node = kills.rng.choice(NODES)
        cluster.kill_node(node)
        cluster.start_node(node)

    parts = {"controller": kill_controller, "daemon of a node": kill_daemon, "node": kill_node}
    kills.kill(parts, cluster.forgive_duplicates)
    killed = kills.killed
    # A controller that has not saved a start ends the job when it is back, see Cluster.wait_until_saved.
    check_all(made, kills.submitted, most_lost=4 * (killed["node"] + killed["controller"]))
