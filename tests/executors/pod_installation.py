"""Installations whose runs are pods of the Kubernetes of these tests, on nodes that share storage or do not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from slamhive.executors.node_store.on_node.cache import sha256_of
from tests.executors.kubernetes_cluster import KubernetesCluster
from tests.services.docker_base import run_docker
from tests.services.installation import TINY_IMAGE, Installation, installation


@contextmanager
def pod_installation(
    cluster: KubernetesCluster,
    image: str,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    *,
    apart: bool = False,
    **settings: str,
) -> Iterator[Installation]:
    """The test algorithm in ``image``. With ``apart``, nodes see no file of the installation."""
    cluster.use(monkeypatch)
    if apart:
        cluster.separate_caches()
        cluster.hide(folder)
        address = {"node_address": f"127.0.0.1:{cluster.port}", "node_url": cluster.url}
        settings = {"shared_storage": "false", "node_cache": str(cluster.cache), **address, **settings}
    assert run_docker("tag", image, TINY_IMAGE).returncode == 0
    with installation(folder, monkeypatch, executor="kubernetes", **settings) as made:  # type: ignore[arg-type]
        record_checksum(made.machine.data)
        made.build()
        yield made
    run_docker("rmi", TINY_IMAGE)


def record_checksum(data: Path) -> None:
    """Nodes check what they get: so the dataset has to say what its recording really holds."""
    (recording,) = data.glob("datasets/*/*.bag")
    (described,) = data.glob("datasets/*/dataset.yaml")
    described.write_text(described.read_text().replace("0" * 64, sha256_of(recording)))
