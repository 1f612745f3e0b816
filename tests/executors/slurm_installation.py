"""Installations whose runs are jobs of the Slurm of these tests, on nodes that share storage or do not."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.executors.pod_installation import record_checksum
from tests.executors.slurm_cluster import Cluster, free_ports
from tests.services.docker_base import run_docker
from tests.services.installation import TINY_IMAGE, Installation, installation


@contextmanager
def slurm_installation(
    cluster: Cluster, image: Callable[[], str], folder: Path, monkeypatch: pytest.MonkeyPatch, **settings: str
) -> Iterator[Installation]:
    """The test algorithm as jobs. Where storage is shared, without containers: what can be killed is the same.

    Args:
        cluster: The Slurm.
        image: Makes the image of the algorithm, which only nodes that share nothing need.
        folder: For the installation.
        monkeypatch: Sets its settings.
        settings: Further ones.
    """
    if cluster.apart:
        (port,) = free_ports(1)
        apart = {"shared_storage": "false", "node_address": f"127.0.0.1:{port}", "node_cache": str(cluster.cache)}
        settings = {**apart, **settings}
        assert run_docker("tag", image(), TINY_IMAGE).returncode == 0
    else:
        settings = {"slurm_containers": "none", **settings}
    with installation(folder, monkeypatch, executor="slurm", **settings) as made:  # type: ignore[arg-type]
        if cluster.apart:
            (made.hive.catalogue.project_root / "algorithms" / "tiny" / "Dockerfile").unlink()
            record_checksum(made.machine.data)
        made.build()
        yield made
    if cluster.apart:
        run_docker("rmi", TINY_IMAGE)
