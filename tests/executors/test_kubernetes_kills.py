"""Complete runs on a real Kubernetes whose control plane, nodes and workers are killed: each is accounted for."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from slamhive.executors.kubernetes import manifest
from slamhive.executors.registry import installation_id
from tests.executors.kubernetes_cluster import NODES
from tests.executors.pod_installation import pod_installation
from tests.executors.random_kills import RandomKills, check_accounts
from tests.services.installation import Installation
from tests.waiting import eventually

pytestmark = [pytest.mark.cluster, pytest.mark.long, pytest.mark.timeout(3000)]

SEED = 20_261_124
SECONDS = (1.0, 3.0, 6.0)
SLOTS = 4
CONTROL_PLANE = ("etcd", "kube-scheduler", "kube-controller-manager")


@pytest.fixture(params=["shared", "apart"])
def made(request, kubernetes_cluster, base_image: str, tmp_path, monkeypatch) -> Iterator[Installation]:
    """An installation whose runs are pods, on nodes that share its storage or see no file of it."""
    settings = {"worker_slots": str(SLOTS), "run_cpu_cores": "0.4"}
    apart = request.param == "apart"
    with pod_installation(kubernetes_cluster, base_image, tmp_path, monkeypatch, apart=apart, **settings) as made:
        yield made


def test_everything_is_killed_at_random_moments(made, kubernetes_cluster):
    """The worker, the daemons of control plane and nodes, and whole nodes. Only the end of a node loses runs."""
    kills = RandomKills(made, SEED, SECONDS)

    def killer(daemon: str, *nodes: str) -> Callable[[], None]:
        def kill() -> None:
            node = kills.rng.choice(nodes) if nodes else None
            kubernetes_cluster.kill(daemon, node)
            eventually(lambda: kubernetes_cluster.runs(daemon, node), f"another {daemon}")
            kubernetes_cluster.wait_for_api_server()

        return kill

    def kill_node() -> None:
        node = kills.rng.choice(NODES)
        kubernetes_cluster.lose(node)
        kills.pause()
        kubernetes_cluster.bring_back(node)

    parts = {daemon: killer(daemon) for daemon in ("kube-apiserver", *CONTROL_PLANE)}
    kills.kill(parts | {daemon: killer(daemon, *NODES) for daemon in ("kubelet", "containerd")} | {"node": kill_node})
    check_accounts(made, kills.submitted, most_lost=SLOTS * kills.killed["node"])
    chosen = manifest.selector(installation_id(made.machine.data))
    assert kubernetes_cluster.read("jobs,pods", "-l", chosen)["items"] == []
