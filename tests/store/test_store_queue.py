"""Claims, leases, heartbeats: one run, one worker."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from slamhive.domain.placement import run_affinity
from slamhive.domain.run import FailureReason, RunState
from slamhive.store import Lease, Store, open_store
from tests.store.store_samples import WORKER, Samples

pytestmark = pytest.mark.quick

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)
LEASE_S = 30.0
LATER = NOW + timedelta(seconds=LEASE_S + 1)


def claim(store: Store, owner: str = WORKER, now: datetime = NOW):
    return store.write(lambda tx: tx.queue.claim(Lease(owner, now, LEASE_S)))


def test_claims_go_by_priority_and_then_by_age(store: Store, samples: Samples) -> None:
    first, second = samples.queued(2)
    (urgent,) = samples.queued(priority=5)
    assert [claim(store).id for _ in range(3)] == [urgent, first, second]
    assert claim(store) is None


def claim_near(store: Store, near: str, **options: Any) -> int | None:
    run = store.write(lambda tx: tx.queue.claim(Lease(WORKER, NOW, LEASE_S), near=near, **options))
    return None if run is None else run.id


def test_runs_on_the_same_data_go_together_the_same_package_first(store: Store, samples: Samples) -> None:
    near, alike, elsewhere = (run_affinity(*of) for of in (("room", (), "a"), ("room", (), "b"), ("kitti", (), "a")))
    order = [elsewhere, alike, near, elsewhere, alike, near]
    ids = [samples.queued(affinity=affinity)[0] for affinity in order]
    wanted = [ids[2], ids[5], ids[1], ids[4], ids[0], ids[3]]
    assert [claim_near(store, near) for _ in ids] == wanted
    assert claim_near(store, near) is None


def test_affinity_never_goes_before_priority(store: Store, samples: Samples) -> None:
    near = run_affinity("room", (), "a")
    (alike,) = samples.queued(affinity=near)
    (urgent,) = samples.queued(affinity=run_affinity("kitti", (), "a"), priority=1)
    assert [claim_near(store, near) for _ in range(2)] == [urgent, alike]


def test_without_a_run_before_the_oldest_goes_first(store: Store, samples: Samples) -> None:
    ids = [samples.queued(affinity=run_affinity(data, (), "a"))[0] for data in ("kitti", "room", "kitti")]
    assert [claim_near(store, "") for _ in ids] == ids


def test_a_held_run_is_never_claimed(store: Store, samples: Samples) -> None:
    near = run_affinity("room", (), "a")
    (held,) = samples.queued(affinity=near, priority=9, held=True)
    assert claim_near(store, near) is None
    assert not store.read(lambda tx: tx.queue.waits())
    (free,) = samples.queued(affinity=run_affinity("kitti", (), "a"))
    assert store.read(lambda tx: tx.queue.waits())
    assert [claim_near(store, near), claim_near(store, near)] == [free, None]
    assert store.read(lambda tx: tx.runs.get(held)).state is RunState.QUEUED


def test_only_runs_that_may_start_before_a_new_one_count_as_ahead_of_it(store: Store, samples: Samples) -> None:
    samples.queued(3, held=True)
    samples.queued(2)
    samples.queued(priority=-1)
    (urgent,) = samples.queued(priority=5)
    assert store.read(lambda tx: list(map(tx.queue.ahead_of, (-1, 0, 1, 5, 6)))) == [4, 3, 1, 1, 0]
    assert claim(store).id == urgent
    assert store.read(lambda tx: tx.queue.ahead_of(0)) == 2, "a run that was taken is not ahead of anything"


def test_runs_of_an_executor_that_is_away_stay_where_they_are(store: Store, samples: Samples) -> None:
    samples.queued(executor="docker", priority=5)
    (here,) = samples.queued(executor="process")
    assert [claim_near(store, "", away=("docker",)) for _ in range(2)] == [here, None]


def test_failures_count_against_a_configuration_since_the_run_was_asked_for(store: Store, samples: Samples) -> None:
    def fail(reason: FailureReason, at: datetime, **fields: Any) -> None:
        (run_id,) = samples.queued(**fields)
        claim(store)
        store.write(lambda tx: tx.runs.move(run_id, RunState.FAILED, why="test", now=at, reason=reason))

    def count() -> int:
        return store.read(lambda tx: tx.queue.failures_since_asked(tx.runs.get(asked)))

    (asked,) = samples.queued(priority=-9)
    fail(FailureReason.TIMEOUT, NOW - timedelta(seconds=1))
    fail(FailureReason.TIMEOUT, NOW, configuration_id=samples.configuration({"nFeatures": 1}))
    for reason in (FailureReason.LOST, FailureReason.CONFIGURATION_FAILED):
        fail(reason, LATER)
    assert count() == 0
    fail(FailureReason.LOST_TRACKING, NOW)
    fail(FailureReason.NONZERO_EXIT, LATER)
    assert count() == 2


def test_a_claim_starts_preparing_under_a_lease(store: Store, samples: Samples) -> None:
    (run_id,) = samples.queued()
    run = claim(store)
    assert (run.id, run.state, run.attempt, run.lease_owner) == (run_id, RunState.PREPARING, 1, WORKER)
    assert run.lease_expires_at == NOW + timedelta(seconds=LEASE_S)
    moves = [(event.from_state, event.to_state) for event in store.read(lambda tx: tx.runs.events(run_id))]
    assert moves == [(None, RunState.QUEUED), (RunState.QUEUED, RunState.PREPARING)]


@pytest.mark.parametrize("state", [state for state in RunState if state.active])
def test_a_silent_workers_run_is_adopted_in_its_state(store: Store, samples: Samples, state: RunState) -> None:
    run_id = samples.run_in(state)
    assert claim(store, "worker-2") is None, "the lease still holds"
    run = claim(store, "worker-2", LATER)
    assert (run.id, run.state, run.attempt, run.lease_owner) == (run_id, state, 2, "worker-2")


def test_an_orphan_goes_before_the_queue(store: Store, samples: Samples) -> None:
    orphan = samples.run_in(RunState.RUNNING)
    samples.queued(priority=9)
    assert claim(store, "worker-2", LATER).id == orphan


@pytest.mark.parametrize("state", [state for state in RunState if state.ended])
def test_what_has_ended_is_never_claimed(store: Store, samples: Samples, state: RunState) -> None:
    samples.run_in(state)
    assert claim(store, "worker-2", LATER) is None


def test_a_worker_bound_to_some_runs_takes_no_others(store: Store, samples: Samples) -> None:
    first, second, third = samples.queued(3)
    claimed = [
        store.write(lambda tx: tx.queue.claim(Lease(WORKER, NOW, LEASE_S), only=(third, second))) for _ in range(3)
    ]
    assert [None if run is None else run.id for run in claimed] == [second, third, None]
    assert store.write(lambda tx: tx.queue.claim(Lease("worker-2", LATER, LEASE_S), only=())) is None
    assert claim(store, "worker-2", LATER).id == second, "an orphan goes first"
    assert store.read(lambda tx: tx.runs.get(first)).state is RunState.QUEUED


def test_a_released_run_is_free_at_once(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.RUNNING)
    store.write(lambda tx: tx.queue.release([run_id], "somebody else"))
    assert claim(store, "worker-2") is None
    store.write(lambda tx: tx.queue.release([run_id], WORKER))
    assert claim(store, "worker-2").state is RunState.RUNNING


def test_heartbeats_extend_what_is_held_and_tell_what_is_lost(store: Store, samples: Samples) -> None:
    first, second = samples.queued(2)
    for _ in range(2):
        claim(store)
    assert store.write(lambda tx: tx.queue.heartbeat([first], Lease(WORKER, LATER, LEASE_S))) == {first}
    assert claim(store, "worker-2", LATER).id == second
    assert store.write(lambda tx: tx.queue.heartbeat([first, second], Lease(WORKER, LATER, LEASE_S))) == {first}
    assert store.write(lambda tx: tx.queue.heartbeat([], Lease(WORKER, LATER, LEASE_S))) == set()


def test_the_worker_sees_which_runs_shall_end(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.RUNNING)
    assert store.read(lambda tx: tx.queue.cancel_requested([run_id])) == set()
    store.write(lambda tx: tx.runs.request_cancel(run_id, NOW))
    assert store.read(lambda tx: tx.queue.cancel_requested([run_id])) == {run_id}


@pytest.mark.integration
def test_many_workers_never_get_the_same_run(database_url: str, samples: Samples) -> None:
    wanted = set(samples.queued(24))
    start = threading.Barrier(4)

    def work(number: int) -> list[int]:
        own = open_store(database_url)
        start.wait()
        taken = []
        while (run := claim(own, f"worker-{number}")) is not None:
            taken.append(run.id)
        own.close()
        return taken

    with ThreadPoolExecutor(4) as pool:
        taken = [run_id for ids in pool.map(work, range(4)) for run_id in ids]
    assert sorted(taken) == sorted(wanted)


def test_many_workers_adopt_an_orphan_once(database_url: str, samples: Samples) -> None:
    orphan = samples.run_in(RunState.RUNNING)
    start = threading.Barrier(4)

    def work(number: int) -> int | None:
        own = open_store(database_url)
        start.wait()
        run = claim(own, f"worker-{number + 2}", LATER)
        own.close()
        return None if run is None else run.id

    with ThreadPoolExecutor(4) as pool:
        assert [run_id for run_id in pool.map(work, range(4)) if run_id is not None] == [orphan]
