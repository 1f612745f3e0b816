"""Imported runs: filed as ended, found by their ids, evaluated in bulk."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from slamhive.domain.run import RunState
from slamhive.store import Lease, Store
from slamhive.store.filed_runs import ImportedRun
from tests.store.store_samples import SE3, SIM3, Samples

pytestmark = pytest.mark.integration

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)


def imported(configuration_id: int, number: int) -> ImportedRun:
    uid = f"{number:016x}{number + 7:016x}"
    return ImportedRun(uid, configuration_id, 40 + number, f"imported from {number}.txt", "sha256:" + "a" * 64)


@pytest.fixture
def filed(store: Store, samples: Samples) -> list[int]:
    configuration_id = samples.configuration()
    runs = [imported(configuration_id, number) for number in range(1200)]
    return store.write(lambda t: t.imports.add(runs, NOW))


def test_they_have_ended_and_no_worker_sees_them(store: Store, filed: list[int]) -> None:
    run = store.read(lambda t: t.runs.get(filed[3]))
    assert (run.state, run.executor, run.poses, run.detail) == (
        RunState.SUCCEEDED,
        "imported",
        43,
        "imported from 3.txt",
    )
    (event,) = store.read(lambda t: t.runs.events(filed[3]))
    assert (event.from_state, event.to_state, event.why) == (None, RunState.SUCCEEDED, "imported from 3.txt")
    assert store.write(lambda t: t.queue.claim(Lease("worker", NOW, 30.0))) is None


def test_they_are_found_by_the_beginning_of_their_uid(store: Store, samples: Samples, filed: list[int]) -> None:
    samples.run_in(RunState.SUCCEEDED)
    beginnings = [f"{number:016x}" for number in range(1150, 1250)]
    found = store.read(lambda t: t.imports.known(beginnings))
    assert sorted(found.values()) == filed[1150:]
    assert store.read(lambda t: t.imports.known([])) == {}


def test_filing_them_again_changes_nothing(store: Store, samples: Samples, filed: list[int]) -> None:
    configuration_id = samples.configuration()
    again = [imported(configuration_id, number) for number in range(5)]
    assert store.write(lambda t: t.imports.add(again, NOW)) == filed[:5]
    assert store.read(lambda t: t.runs.counts_by_state())[RunState.SUCCEEDED] == len(filed)


def test_evaluations_of_many_are_queued_once_for_each_protocol(store: Store, filed: list[int]) -> None:
    first = store.write(lambda t: t.evaluations.queue(filed, SE3, NOW))
    assert len(set(first)) == len(filed)
    assert store.write(lambda t: t.evaluations.queue(reversed(filed), SE3, NOW)) == first[::-1]
    assert set(store.write(lambda t: t.evaluations.queue(filed[:3], SIM3, NOW))).isdisjoint(first)
    records = store.read(lambda t: t.evaluations.get_many(first))
    assert [record.run_id for record in records] == filed
    assert store.read(lambda t: t.evaluations.still_open(first)) == set(first)
    assert store.read(lambda t: t.evaluations.unsettled_among(filed)) == filed
