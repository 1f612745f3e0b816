"""Lists: filters, orders, pages, and a number of queries that does not grow with the page."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import event

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.run import FailureReason, RunState
from slamhive.filters.binding import Search
from slamhive.filters.words import matching
from slamhive.store import Lease, RunSort, Store
from slamhive.store.run_listing import SORT_KEYS
from tests.store.store_samples import SE3, WORKER, Samples, result

pytestmark = pytest.mark.integration

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)


def ids(store: Store, wanted: Search | None = None, sort: RunSort | None = None) -> list[int]:
    return [run.id for run in store.read(lambda tx: tx.runs.page(wanted, sort)).records]


def paged(store: Store, sort: RunSort, limit: int) -> list[int]:
    found: list[int] = []
    after = None
    while True:
        page = store.read(lambda tx, key=after: tx.runs.page(sort=sort, after=key, limit=limit))  # type: ignore[misc]
        found += [run.id for run in page.records]
        after = page.next_key
        if after is None:
            return found


def evaluated(store: Store, run_id: int, ate_rmse: float) -> None:
    (evaluation_id,) = store.write(lambda tx: tx.evaluations.queue([run_id], SE3, NOW))
    store.write(lambda tx: tx.evaluations.claim(Lease(WORKER, NOW, 30.0)))
    store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, result(ate_rmse=ate_rmse), NOW))


@pytest.fixture
def mixed(store: Store, samples: Samples) -> dict[str, int]:
    """Runs that differ in everything a list can show."""
    other = samples.configuration({"voxel_size": 0.5}, algorithm="kiss-icp", data="kitti_06")
    runs = {
        "good": samples.run_in(RunState.SUCCEEDED),
        "better": samples.run_in(RunState.SUCCEEDED),
        "failed": samples.run_in(RunState.FAILED, configuration_id=other, executor="docker"),
        "running": samples.run_in(RunState.RUNNING, configuration_id=other),
        "queued": samples.queued()[0],
    }
    store.write(lambda tx: tx.runs.update(runs["good"], poses=50))
    store.write(lambda tx: tx.runs.update(runs["better"], poses=51))
    evaluated(store, runs["good"], ate_rmse=0.2)
    evaluated(store, runs["better"], ate_rmse=0.1)
    store.write(lambda tx: tx.metrics.put(runs["failed"], None, {"cpu.mean": 1.5}))
    return runs


def test_filters(store: Store, samples: Samples, mixed: dict[str, int]) -> None:
    def names(wanted: Search) -> set[str]:
        by_id = {run_id: name for name, run_id in mixed.items()}
        return {by_id[run_id] for run_id in ids(store, wanted)}

    assert names(matching()) == set(mixed)
    assert names(matching(states=(RunState.QUEUED, RunState.RUNNING))) == {"queued", "running"}
    assert names(matching(reasons=(FailureReason.TIMEOUT,))) == {"failed"}
    assert names(matching(algorithms=("kiss-icp",))) == {"failed", "running"}
    assert names(matching(datasets=("room",), executors=("process",))) == {"good", "better", "queued"}
    assert names(matching(executors=("docker",))) == {"failed"}
    assert names(matching(evaluated=True)) == {"good", "better"}
    assert names(matching(evaluated=False, states=(RunState.QUEUED,))) == {"queued"}
    assert names(matching(configuration_id=samples.configuration())) == {"good", "better", "queued"}
    assert names(matching(created_after=NOW)) == set(mixed)
    assert names(matching(created_before=NOW)) == set()
    assert names(matching(algorithms=("' OR 1=1 --",))) == set()


def test_newest_first_and_the_total_counts_all(store: Store, samples: Samples) -> None:
    queued = samples.queued(5)
    page = store.read(lambda tx: tx.runs.page(limit=2))
    assert [run.id for run in page.records] == queued[:-3:-1]
    assert page.total == 5


def test_metrics_sort_and_missing_values_come_last(store: Store, mixed: dict[str, int]) -> None:
    best_first = ids(store, sort=RunSort("ate.rmse", descending=False))
    worst_first = ids(store, sort=RunSort("ate.rmse", descending=True))
    assert best_first[:2] == [mixed["better"], mixed["good"]]
    assert worst_first[:2] == [mixed["good"], mixed["better"]]
    assert set(best_first[2:]) == set(worst_first[2:]) == {mixed["failed"], mixed["running"], mixed["queued"]}
    assert ids(store, sort=RunSort("cpu.mean"))[0] == mixed["failed"]


def test_pages_of_any_size_add_up_to_the_whole_list_in_every_order(store: Store, mixed: dict[str, int]) -> None:
    for key in (*SORT_KEYS, "ate.rmse", "cpu.mean", "rpe.rmse", "nFeatures", "voxel_size"):
        for descending in (True, False):
            sort = RunSort(key, descending=descending)
            whole = ids(store, sort=sort)
            assert sorted(whole) == sorted(mixed.values()), sort
            for limit in (1, 2, 5):
                assert paged(store, sort, limit) == whole, (sort, limit)


def test_a_page_goes_on_where_the_last_ended_while_runs_are_added(store: Store, samples: Samples) -> None:
    queued = samples.queued(4)
    first = store.read(lambda tx: tx.runs.page(limit=2))
    samples.queued(3)
    second = store.read(lambda tx: tx.runs.page(after=first.next_key, limit=2))
    assert [run.id for run in (*first.records, *second.records)] == queued[::-1]


def test_page_keys_that_are_not_ours(store: Store) -> None:
    for key in ("", "x", "!!!", "WzEsMSwxXQ", "W1tdLDFd", "WzEsIngiXQ", "é"):
        with pytest.raises(InvalidInput, match="unknown page key"):
            store.read(lambda tx, after=key: tx.runs.page(after=after))  # type: ignore[misc]


def test_a_page_key_of_another_order(store: Store, samples: Samples) -> None:
    samples.queued(2)
    key = store.read(lambda tx: tx.runs.page(sort=RunSort("algorithm"), limit=1)).next_key
    for other in ("created_at", "priority", "ate.rmse"):
        with pytest.raises(InvalidInput, match="unknown page key"):
            store.read(lambda tx, order=other: tx.runs.page(sort=RunSort(order), after=key))  # type: ignore[misc]


def test_unknown_orders_and_sizes(store: Store) -> None:
    with pytest.raises(NotFound, match=r"unknown sort key 'ate\.rms'; did you mean 'ate\.rmse'"):
        store.read(lambda tx: tx.runs.page(sort=RunSort("ate.rms")))
    with pytest.raises(NotFound, match="unknown sort key 'zzz'; known: ") as caught:
        store.read(lambda tx: tx.runs.page(sort=RunSort("zzz")))
    assert str(caught.value).count(" ate.rmse,") == 1
    for limit in (0, -1, 1001):
        with pytest.raises(InvalidInput, match=f"page size {limit} is not allowed"):
            store.read(lambda tx, size=limit: tx.runs.page(limit=size))  # type: ignore[misc]


def test_a_long_page_takes_no_more_queries_than_a_short_one(store: Store, samples: Samples) -> None:
    for number in range(12):
        samples.queued(configuration_id=samples.configuration({"nFeatures": number}))
    statements: list[str] = []

    def note(*arguments) -> None:
        statements.append(arguments[2])

    event.listen(store.engine, "before_cursor_execute", note)
    counts = []
    for limit in (1, 12):
        statements.clear()
        page = store.read(lambda tx, size=limit: tx.runs.page(limit=size, with_metrics=True))  # type: ignore[misc]
        assert len(page.records) == limit
        counts.append(sum(statement.startswith("SELECT") for statement in statements))
    event.remove(store.engine, "before_cursor_execute", note)
    assert counts == [9, 9]


def test_many_by_id_keep_their_order(store: Store, samples: Samples) -> None:
    first, second, third = samples.queued(3)
    runs = store.read(lambda tx: tx.runs.get_many([third, first, second, first]))
    assert [run.id for run in runs] == [third, first, second, first]
    with pytest.raises(NotFound, match="unknown run 99"):
        store.read(lambda tx: tx.runs.get_many([first, 99]))


def test_created_between(store: Store, samples: Samples) -> None:
    old, new = samples.request(), samples.request()
    (first,) = store.write(lambda tx: tx.runs.add_runs([old], NOW))
    (second,) = store.write(lambda tx: tx.runs.add_runs([new], NOW + timedelta(microseconds=1)))
    assert ids(store, matching(created_after=NOW + timedelta(microseconds=1))) == [second]
    assert ids(store, matching(created_before=NOW + timedelta(microseconds=1))) == [first]
