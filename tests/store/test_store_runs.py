"""Adding, moving, cancelling and rebuilding runs."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta, timezone

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.domain.run import LEGAL_MOVES, FailureReason, Host, RunEvent, RunState
from slamhive.store import AlgorithmVersion, LeaseLost, RunFields, Store
from tests.store.store_samples import SIM3, WORKER, Samples

pytestmark = pytest.mark.quick

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)
LATER = NOW + timedelta(seconds=7)


def test_a_request_comes_back_as_it_was_made(store: Store, samples: Samples) -> None:
    request = samples.request(
        samples.configuration({"nFeatures": 2000, "scale": 1.2}),
        executor="docker",
        seed=2**40,
        priority=-3,
        evaluate=True,
        cpu_cores=1.5,
        memory_mb=2048,
        timeout_s=105.25,
        protocol=SIM3,
    )
    (run_id,) = store.write(lambda tx: tx.runs.add_runs([request], NOW))
    run = store.read(lambda tx: tx.runs.get(run_id))
    assert (run.uid, run.executor, run.seed, run.priority, run.evaluate) == (request.uid, "docker", 2**40, -3, True)
    assert (run.cpu_cores, run.memory_mb, run.timeout_s, run.protocol_override) == (1.5, 2048, 105.25, SIM3)
    assert (run.algorithm, run.package, run.dataset) == ("orb-slam3-stereo", "orb-slam3", "room")
    assert run.parameters == {"nFeatures": 2000, "scale": 1.2}
    assert (run.state, run.created_at, run.attempt) == (RunState.QUEUED, NOW, 0)
    missing = (run.reason, run.started_at, run.ended_at, run.exit_code, run.poses, run.protocol, run.host, run.metrics)
    assert missing == (None,) * 8


@pytest.mark.integration
def test_adding_the_same_uids_again_adds_nothing(store: Store, samples: Samples) -> None:
    requests = [samples.request() for _ in range(3)]
    first = store.write(lambda tx: tx.runs.add_runs(requests[:2], NOW))
    again = store.write(lambda tx: tx.runs.add_runs(requests[::-1], NOW))
    assert again[1:] == first[::-1]
    assert store.read(lambda tx: tx.runs.counts_by_state())[RunState.QUEUED] == 3


def test_a_retry_names_its_origin(store: Store, samples: Samples) -> None:
    failed = samples.run_in(RunState.FAILED)
    (retry,) = samples.queued(retry_of=failed)
    assert store.read(lambda tx: tx.runs.get(retry)).retry_of == failed
    assert store.read(lambda tx: tx.runs.events(retry))[0].why == f"retry of run {failed}"


def test_ids_are_not_used_twice(store: Store, samples: Samples) -> None:
    ids = samples.queued(2)
    with store.engine.begin() as connection:
        connection.exec_driver_sql("DELETE FROM run_events")
        connection.exec_driver_sql("DELETE FROM runs")
    assert samples.queued()[0] > max(ids)


@pytest.mark.parametrize("state", list(RunState))
def test_exactly_the_legal_moves_are_possible(store: Store, samples: Samples, state: RunState) -> None:
    run_id = samples.run_in(state)
    before = store.read(lambda tx: tx.runs.events(run_id))
    for target in RunState:
        if target in LEGAL_MOVES[state]:
            continue
        with pytest.raises(Conflict, match=f"run {run_id} is {state}, it cannot become {target}"):
            store.write(lambda tx, to=target: tx.runs.move(run_id, to, why="test", now=LATER))  # type: ignore[misc]
    assert store.read(lambda tx: tx.runs.events(run_id)) == before


def test_a_run_through_its_whole_life(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.STARTING)
    handle = {"executor": "docker", "data": {"container": "abc"}}
    store.write(lambda tx: tx.runs.update(run_id, WORKER, handle=handle))
    store.write(lambda tx: tx.runs.move(run_id, RunState.RUNNING, why="started", now=NOW, owner=WORKER))
    store.write(
        lambda tx: tx.runs.move(run_id, RunState.COLLECTING, why="exited", now=LATER, owner=WORKER, exit_code=0)
    )
    came_from = store.write(
        lambda tx: tx.runs.move(run_id, RunState.SUCCEEDED, why="51 poses", now=LATER, owner=WORKER, poses=51)
    )
    run = store.read(lambda tx: tx.runs.get(run_id))
    assert came_from is RunState.COLLECTING
    assert (run.state, run.exit_code, run.poses, run.handle) == (RunState.SUCCEEDED, 0, 51, handle)
    assert (run.started_at, run.ended_at) == (NOW, LATER)
    assert (run.lease_owner, run.lease_expires_at) == (None, None)
    events = store.read(lambda tx: tx.runs.events(run_id))
    assert [event.to_state for event in events] == [
        RunState.QUEUED,
        RunState.PREPARING,
        RunState.STARTING,
        RunState.RUNNING,
        RunState.COLLECTING,
        RunState.SUCCEEDED,
    ]
    assert events[-1] == RunEvent(LATER, RunState.COLLECTING, RunState.SUCCEEDED, "51 poses")


def test_a_failure_needs_a_reason_and_keeps_the_beginning_of_a_long_detail(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.RUNNING)
    with pytest.raises(InvalidInput, match="cannot fail without a reason"):
        store.write(lambda tx: tx.runs.move(run_id, RunState.FAILED, why="?", now=NOW))
    detail = "<b>'quoted'\n" + "ü" * 20_000
    fields = RunFields(reason=FailureReason.TIMEOUT, detail=detail)
    store.write(lambda tx: tx.runs.move(run_id, RunState.FAILED, why="w" * 900, now=NOW, **fields))
    run = store.read(lambda tx: tx.runs.get(run_id))
    assert run.reason is FailureReason.TIMEOUT
    assert run.detail is not None
    assert run.detail.startswith("<b>'quoted'\n")
    assert len(run.detail) == 10_000
    assert len(store.read(lambda tx: tx.runs.events(run_id))[-1].why) == 500


def test_back_to_the_queue_gives_up_lease_and_handle(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.PREPARING)
    store.write(lambda tx: tx.runs.update(run_id, handle={"executor": "docker", "data": {}}))
    store.write(lambda tx: tx.runs.move(run_id, RunState.QUEUED, why="engine away", now=NOW, owner=WORKER))
    run = store.read(lambda tx: tx.runs.get(run_id))
    assert (run.state, run.lease_owner, run.handle) == (RunState.QUEUED, None, None)


def test_the_same_move_twice_is_one_move(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.STARTING)
    for _ in range(2):
        store.write(lambda tx: tx.runs.move(run_id, RunState.RUNNING, why="started", now=LATER, owner=WORKER))
    assert len(store.read(lambda tx: tx.runs.events(run_id))) == 4


def test_only_the_holder_may_move_or_write(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.RUNNING)
    with pytest.raises(LeaseLost, match=f"run {run_id} is held by {WORKER}, not by worker-2"):
        store.write(lambda tx: tx.runs.move(run_id, RunState.COLLECTING, why="x", now=NOW, owner="worker-2"))
    with pytest.raises(LeaseLost):
        store.write(lambda tx: tx.runs.update(run_id, "worker-2", exit_code=1))
    run = store.read(lambda tx: tx.runs.get(run_id))
    assert (run.state, run.exit_code) == (RunState.RUNNING, None)


def test_an_error_in_a_transaction_leaves_nothing(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.RUNNING)

    def half(tx) -> None:
        tx.runs.move(run_id, RunState.COLLECTING, why="x", now=NOW)
        raise Conflict("stop")

    with pytest.raises(Conflict, match="stop"):
        store.write(half)
    assert store.read(lambda tx: tx.runs.get(run_id)).state is RunState.RUNNING
    assert len(store.read(lambda tx: tx.runs.events(run_id))) == 4


def test_cancel(store: Store, samples: Samples) -> None:
    running = samples.run_in(RunState.RUNNING)
    (queued,) = samples.queued()
    assert store.write(lambda tx: tx.runs.request_cancel(queued, NOW)) is RunState.CANCELLED
    assert store.write(lambda tx: tx.runs.request_cancel(queued, NOW)) is RunState.CANCELLED, "a repetition is fine"
    assert store.write(lambda tx: tx.runs.request_cancel(running, NOW)) is RunState.RUNNING
    assert store.read(lambda tx: tx.runs.get(queued)).ended_at == NOW
    assert store.read(lambda tx: tx.runs.get(running)).cancel_requested
    with pytest.raises(Conflict, match=f"run {queued} has ended already, it is cancelled"):
        store.write(lambda tx: tx.runs.request_cancel(queued, LATER))


def test_unknown_runs(store: Store) -> None:
    for work in (
        lambda tx: tx.runs.get(7),
        lambda tx: tx.runs.move(7, RunState.CANCELLED, why="x", now=NOW),
        lambda tx: tx.runs.update(7, exit_code=0),
        lambda tx: tx.runs.request_cancel(7, NOW),
    ):
        with pytest.raises(NotFound, match="unknown run 7"):
            store.write(work)
    assert store.read(lambda tx: tx.runs.events(7)) == []


def test_version_host_and_checksum_are_part_of_the_record(store: Store, samples: Samples) -> None:
    (run_id,) = samples.queued()
    host = Host("AMD EPYC 7B13", 2, 25_000_000_000, "6.1.0", "Debian 12")
    version = AlgorithmVersion("sha256:" + "a" * 64, "sha256:" + "b" * 64, "1.0")

    def work(tx) -> None:
        version_id, number = tx.versions.put("orb-slam3", version, NOW)
        assert tx.versions.put("orb-slam3", version, LATER) == (version_id, number)
        host_id = tx.catalogue.put_host(host)
        assert tx.catalogue.put_host(host) == host_id
        fields = RunFields(algorithm_version_id=version_id, host_id=host_id, dataset_checksum="sha256:" + "c" * 64)
        tx.runs.update(run_id, **fields)

    store.write(work)
    run = store.read(lambda tx: tx.runs.get(run_id))
    assert run.version_label == "orb-slam3@1"
    assert (run.version, run.host, run.dataset_checksum) == (replace(version, number=1), host, "sha256:" + "c" * 64)


def test_times_of_any_zone_come_back_in_utc_and_naive_ones_are_refused(store: Store, samples: Samples) -> None:
    moment = datetime(2026, 5, 4, 12, 0, 0, 1, tzinfo=timezone(timedelta(hours=8)))
    request = samples.request()
    (run_id,) = store.write(lambda tx: tx.runs.add_runs([request], moment))
    found = store.read(lambda tx: tx.runs.get(run_id)).created_at
    assert (found, found.tzinfo) == (moment, UTC)
    with pytest.raises(Exception, match="has no time zone"):
        store.write(lambda tx: tx.runs.update(run_id, started_at=moment.replace(tzinfo=None)))
