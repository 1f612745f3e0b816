"""What the queues of runs, evaluations and analyses share: one worker holds a row, until it ends or goes silent."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import func, select, text

from slamhive.base.clock import Clock
from slamhive.domain.run import RunState
from slamhive.store import AnalysisRecord, AnalysisState, EvaluationState, Lease, Store, Transaction, open_store
from slamhive.store.leases import LeaseQueue
from tests.store.store_samples import SE3, Samples

pytestmark = pytest.mark.quick

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)
LEASE_S = 30.0
LATER = NOW + timedelta(seconds=LEASE_S + 1)


@dataclass(frozen=True)
class Kind:
    """One of the three queues, in the terms that they share."""

    fill: Callable[[Samples, int], list[Any]]
    queue: Callable[[Transaction], LeaseQueue[Any]]
    claim: Callable[[Transaction, Lease], Any]
    """The key of the row that was taken, None if none was free."""
    released: str
    """The state of a row that its worker gave back."""
    attempts_after_release: int


def _fill_evaluations(samples: Samples, count: int) -> list[int]:
    run_ids = [samples.run_in(RunState.SUCCEEDED) for _ in range(count)]
    return samples.store.write(lambda t: t.evaluations.queue(run_ids, SE3, NOW))


def _fill_analyses(samples: Samples, count: int) -> list[str]:
    records = [
        AnalysisRecord(f"{place:032x}", "a", AnalysisState.QUEUED, listed=True, visitor=False, created_at=NOW)
        for place in range(count)
    ]
    for record in records:
        samples.store.write(lambda t, record=record: t.analyses.put(record))  # type: ignore[misc]
    return [record.token for record in records]


def _claim_run(t: Transaction, lease: Lease) -> int | None:
    run = t.queue.claim(lease)
    return None if run is None else run.id


def _claim_evaluation(t: Transaction, lease: Lease) -> int | None:
    return next((record.id for record in t.evaluations.claim(lease, limit=1)), None)


def _claim_analysis(t: Transaction, lease: Lease) -> str | None:
    record = t.analyses.claim(lease)
    return None if record is None else record.token


KINDS = {
    "runs": Kind(lambda s, count: s.queued(count), lambda t: t.queue, _claim_run, RunState.PREPARING, 1),
    "evaluations": Kind(
        _fill_evaluations, lambda t: t.evaluations, _claim_evaluation, EvaluationState.QUEUED, attempts_after_release=1
    ),
    "analyses": Kind(
        _fill_analyses, lambda t: t.analyses, _claim_analysis, AnalysisState.QUEUED, attempts_after_release=0
    ),
}


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> Kind:
    return KINDS[request.param]


def claim(store: Store, kind: Kind, owner: str = "a", now: datetime = NOW) -> Any:
    return store.write(lambda t: kind.claim(t, Lease(owner, now, LEASE_S)))


def row(store: Store, kind: Kind, key: Any) -> Any:
    def read(t: Transaction) -> Any:
        queue = kind.queue(t)
        columns = queue.table.c
        return t.database.execute(
            select(columns.state, columns.attempt, columns.lease_owner, columns.lease_expires_at).where(
                columns[queue.key] == key
            )
        ).one()

    return store.read(read)


def test_a_claim_holds_the_oldest_row_under_a_lease(store: Store, samples: Samples, kind: Kind) -> None:
    first, second = kind.fill(samples, 2)
    assert claim(store, kind) == first
    held = row(store, kind, first)
    assert (held.attempt, held.lease_owner, held.lease_expires_at) == (1, "a", NOW + timedelta(seconds=LEASE_S))
    assert claim(store, kind, "b") == second
    assert claim(store, kind, "c") is None
    assert store.read(lambda t: kind.queue(t).owners()) == {"a", "b"}


def test_a_row_is_free_again_once_its_lease_has_expired(store: Store, samples: Samples, kind: Kind) -> None:
    (key,) = kind.fill(samples, 1)
    claim(store, kind)
    assert claim(store, kind, "b", NOW + timedelta(seconds=LEASE_S)) is None
    assert claim(store, kind, "b", LATER) == key
    assert row(store, kind, key)[1:3] == (2, "b")


def test_a_heartbeat_extends_what_is_held_and_tells_what_is_lost(store: Store, samples: Samples, kind: Kind) -> None:
    kept, lost = kind.fill(samples, 2)
    claim(store, kind)
    claim(store, kind)
    assert store.write(lambda t: kind.queue(t).heartbeat([kept], Lease("a", LATER, LEASE_S))) == {kept}
    assert claim(store, kind, "b", LATER) == lost
    assert store.write(lambda t: kind.queue(t).heartbeat([kept, lost], Lease("a", LATER, LEASE_S))) == {kept}
    assert store.write(lambda t: kind.queue(t).heartbeat([], Lease("a", LATER, LEASE_S))) == set()


def test_only_the_owner_gives_a_row_back(store: Store, samples: Samples, kind: Kind) -> None:
    (key,) = kind.fill(samples, 1)
    claim(store, kind)
    store.write(lambda t: kind.queue(t).release([key], "b"))
    assert claim(store, kind, "b") is None
    store.write(lambda t: kind.queue(t).release([key], "a"))
    assert row(store, kind, key) == (kind.released, kind.attempts_after_release, None, None)
    assert claim(store, kind, "b") == key


def test_all_that_a_dead_worker_holds_is_given_back(store: Store, samples: Samples, kind: Kind) -> None:
    mine, theirs = kind.fill(samples, 2)
    claim(store, kind, "a")
    claim(store, kind, "b")
    store.write(lambda t: kind.queue(t).release_all("a"))
    assert row(store, kind, mine) == (kind.released, 1, None, None)
    assert row(store, kind, theirs).lease_owner == "b"
    assert store.read(lambda t: kind.queue(t).owners()) == {"b"}


@pytest.mark.integration
def test_each_row_goes_to_one_of_many_workers(store: Store, database_url: str, samples: Samples, kind: Kind) -> None:
    wanted = kind.fill(samples, 12)
    start = threading.Barrier(3)

    def work(owner: str) -> list[Any]:
        own = open_store(database_url)
        start.wait()
        taken = []
        while (key := claim(own, kind, owner)) is not None:
            taken.append(key)
        own.close()
        return taken

    with ThreadPoolExecutor(3) as pool:
        taken = [key for keys in pool.map(work, "abc") for key in keys]
    assert sorted(taken) == sorted(wanted)


def test_the_clock_that_was_handed_in_decides_about_leases(store: Store) -> None:
    timed = Store(store.engine, clock=Clock(utc_now=lambda: NOW))
    lease = timed.read(lambda t: t.lease("a", LEASE_S))
    assert lease == Lease("a", NOW, LEASE_S, recorded_at=NOW)


@pytest.mark.mysql
def test_the_clock_of_a_server_decides_about_leases_of_its_workers(mysql_store: Store) -> None:
    def read(t: Transaction) -> tuple[Lease, Lease]:
        t.database.execute(text("SET SESSION timestamp = 1000000000.25"))
        try:
            return t.lease("a", LEASE_S), t.lease("b", 2 * LEASE_S)
        finally:
            t.database.execute(text("SET SESSION timestamp = DEFAULT"))

    lease, longer = mysql_store.read(read)
    assert lease.now == longer.now == datetime(2001, 9, 9, 1, 46, 40, 250000, tzinfo=UTC)
    assert lease.columns["lease_expires_at"] == lease.now + timedelta(seconds=LEASE_S)
    assert lease.at > lease.now, "the worker's own clock is what is recorded"
    assert mysql_store.read(lambda t: t.database.execute(select(func.now())).scalar_one()).year > 2001
