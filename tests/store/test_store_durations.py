"""What the time left of an experiment is estimated from: builds, and what workers do now."""

from __future__ import annotations

from datetime import timedelta

import pytest

from slamhive.domain.run import RunState
from slamhive.store import AlgorithmVersion, Lease, Store
from tests.store.conftest import NOW
from tests.store.store_samples import WORKER, Samples

pytestmark = pytest.mark.quick

PACKAGE = "orb-slam3"


def start(store: Store, samples: Samples, experiment_id: int, prepared_s: float, version_id: int | None) -> int:
    """A run that a worker prepared for so long."""
    (run_id,) = samples.queued(experiment_id=experiment_id, cell=1)
    claimed = store.write(lambda tx: tx.queue.claim_queued(Lease(WORKER, NOW, 30.0)))
    assert claimed is not None
    at = NOW + timedelta(seconds=prepared_s)
    store.write(lambda tx: tx.runs.move(run_id, RunState.STARTING, why="x", now=at, algorithm_version_id=version_id))
    return run_id


def test_a_package_is_unbuilt_until_it_has_a_version(store: Store, samples: Samples, experiment: int) -> None:
    assert store.read(lambda tx: tx.durations.unbuilt(experiment)) == []
    (run_id,) = samples.queued(experiment_id=experiment, cell=1)
    assert store.read(lambda tx: tx.durations.unbuilt(experiment)) == [PACKAGE]
    store.write(lambda tx: tx.queue.claim_queued(Lease(WORKER, NOW, 30.0)))
    (active,) = store.read(lambda tx: tx.durations.active(experiment))
    assert (active.id, active.claimed_at, active.state, active.package) == (run_id, NOW, RunState.PREPARING, PACKAGE)
    store.write(lambda tx: tx.versions.put(PACKAGE, AlgorithmVersion("sha256:1", "h", "1"), NOW))
    assert store.read(lambda tx: tx.durations.unbuilt(experiment)) == []
    assert store.read(lambda tx: tx.durations.built()) == {PACKAGE}


def test_a_build_took_what_the_first_run_of_a_version_waited(store: Store, samples: Samples, experiment: int) -> None:
    assert store.read(lambda tx: tx.durations.build_s()) is None
    versions = [
        store.write(lambda tx, n=number: tx.versions.put(PACKAGE, AlgorithmVersion(f"sha256:{n}", "h", "1"), NOW))[0]  # type: ignore[misc]
        for number in range(3)
    ]
    for version, prepared_s in ((versions[0], 90.0), (versions[0], 500.0), (versions[1], 70.0), (versions[2], 0.5)):
        start(store, samples, experiment, prepared_s, version)
    assert store.read(lambda tx: tx.durations.build_s()) == 80.0
