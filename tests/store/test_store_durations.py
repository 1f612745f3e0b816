"""What the time left of an experiment is estimated from: builds, and what workers do now."""

from __future__ import annotations

from datetime import timedelta

import pytest
from sqlalchemy import text

from slamhive.domain.run import Host, RunState
from slamhive.store import AlgorithmVersion, Lease, Store
from slamhive.store.durations import MachineRuns, Measured
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
    assert store.read(lambda tx: tx.durations.build()) is None
    versions = [
        store.write(lambda tx, n=number: tx.versions.put(PACKAGE, AlgorithmVersion(f"sha256:{n}", "h", "1"), NOW))[0]  # type: ignore[misc]
        for number in range(3)
    ]
    for version, prepared_s in ((versions[0], 90.0), (versions[0], 500.0), (versions[1], 70.0), (versions[2], 0.5)):
        start(store, samples, experiment, prepared_s, version)
    assert store.read(lambda tx: tx.durations.build()) == Measured(2, 80.0, 200**0.5)


SET_DISTURBED = text("UPDATE runs SET disturbed_by = :found WHERE id = :run_id")


def ended_on(store: Store, samples: Samples, host: Host, disturbed_by: str | None, state: RunState) -> None:
    """Add a run that ended on a machine; ``disturbed_by`` is None if nobody judged it."""
    run_id = samples.run_in(state)
    host_id = store.write(lambda tx: tx.catalogue.put_host(host))
    store.write(lambda tx: tx.runs.update(run_id, host_id=host_id))
    store.write(lambda tx: tx.database.execute(SET_DISTURBED, {"found": disturbed_by, "run_id": run_id}))


def test_runs_are_counted_by_processor(store: Store, samples: Samples) -> None:
    old, new = (Host("Xeon", 4, 1, kernel, "Debian") for kernel in ("5", "6"))
    other = Host("EPYC", 4, 1, "6", "Debian")
    ended_on(store, samples, old, "", RunState.SUCCEEDED)
    ended_on(store, samples, new, "steal", RunState.FAILED)
    ended_on(store, samples, old, None, RunState.SUCCEEDED)
    ended_on(store, samples, other, None, RunState.SUCCEEDED)
    ended_on(store, samples, other, None, RunState.CANCELLED)
    since = NOW - timedelta(hours=1)
    assert store.read(lambda tx: tx.durations.by_machine(since)) == [
        MachineRuns("Xeon", 4, runs=3, judged=2, disturbed=1),
        MachineRuns("EPYC", 4, runs=1, judged=0, disturbed=0),
    ]
    assert store.read(lambda tx: tx.durations.by_machine(NOW + timedelta(days=1))) == []
    samples.queued(2)
    samples.queued(executor="docker")
    assert store.read(lambda tx: tx.durations.queued()) == {"process": 2, "docker": 1}
