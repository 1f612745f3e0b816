"""Evaluations and figures, and what they must leave alone."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.domain.protocol import TrajectoryKind
from slamhive.domain.run import RunState
from slamhive.evaluation.job import Artefacts
from slamhive.store import EvaluationState, Lease, LeaseLost, Store
from tests.store.store_samples import SE3, SIM3, WORKER, Samples, result

pytestmark = pytest.mark.quick

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)
LATER = NOW + timedelta(seconds=31)


def queue(store: Store, run_id: int, protocol=SE3) -> int:
    return store.write(lambda tx: tx.evaluations.queue([run_id], protocol, NOW))[0]


def claim(store: Store, owner: str = WORKER, now: datetime = NOW, limit: int = 100):
    return store.write(lambda tx: tx.evaluations.claim(Lease(owner, now, 30.0), limit))


def evaluate(store: Store, run_id: int, outcome, protocol=SE3) -> int:
    evaluation_id = queue(store, run_id, protocol)
    claim(store)
    store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, outcome, NOW))
    return evaluation_id


def test_success_stores_figures_and_the_protocol_they_were_taken_with(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.SUCCEEDED)
    store.write(lambda tx: tx.metrics.put(run_id, None, {"cpu.mean": 1.5}))
    evaluation_id = evaluate(store, run_id, result(ate_rmse=0.07, rpe_rmse=0.01))
    run = store.read(lambda tx: tx.runs.get(run_id, with_metrics=True))
    assert run.metrics == {"cpu.mean": 1.5, "ate.rmse": 0.07, "rpe.rmse": 0.01}
    assert run.protocol is not None
    assert (run.protocol.fingerprint, run.protocol.label) == (SE3.fingerprint, SE3.label)
    record = store.read(lambda tx: tx.evaluations.get(evaluation_id))
    assert (record.state, record.protocol, record.engine) == (EvaluationState.SUCCEEDED, SE3, "evo 1.31")
    assert (record.started_at, record.ended_at, record.lease_owner, record.attempt) == (NOW, NOW, None, 1)


def test_a_failed_evaluation_leaves_the_run_and_older_figures_alone(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.SUCCEEDED)
    evaluate(store, run_id, result(ate_rmse=0.07))
    before = store.read(lambda tx: tx.runs.get(run_id, with_metrics=True))
    events = store.read(lambda tx: tx.runs.events(run_id))
    for protocol in (SE3, SIM3):
        evaluate(store, run_id, result(protocol, reason="the ground truth does not overlap"), protocol)
    assert store.read(lambda tx: tx.runs.get(run_id, with_metrics=True)) == before
    assert store.read(lambda tx: tx.runs.events(run_id)) == events
    history = store.read(lambda tx: tx.evaluations.for_run(run_id))
    assert [record.state for record in history] == ["succeeded", "failed", "failed"]
    assert history[1].reason == "the ground truth does not overlap"


def test_another_protocol_is_shown_only_once_it_is_chosen_and_both_sets_are_kept(
    store: Store, samples: Samples
) -> None:
    run_id = samples.run_in(RunState.SUCCEEDED)
    evaluate(store, run_id, result(ate_rmse=0.07))
    evaluate(store, run_id, result(SIM3, ate_rmse=0.05), SIM3)
    assert store.read(lambda tx: tx.metrics.for_runs([run_id])) == {run_id: {"ate.rmse": 0.07}}
    store.write(lambda tx: tx.evaluations.use([run_id], SIM3.fingerprint))
    assert store.read(lambda tx: tx.metrics.for_runs([run_id])) == {run_id: {"ate.rmse": 0.05}}
    assert store.read(lambda tx: tx.metrics.by_protocol(run_id)) == {
        SE3.fingerprint: {"ate.rmse": 0.07},
        SIM3.fingerprint: {"ate.rmse": 0.05},
    }


def test_another_trajectory_is_shown_only_of_a_run_that_was_submitted_with_it(store: Store, samples: Samples) -> None:
    live = replace(SE3, trajectory=TrajectoryKind.LIVE)
    for asked, shown in ((live, live.fingerprint), (None, None)):
        run_id = samples.run_in(RunState.SUCCEEDED, protocol=asked)
        evaluate(store, run_id, result(live, ate_rmse=0.05), live)
        run = store.read(lambda tx, number=run_id: tx.runs.get(number, with_metrics=True))  # type: ignore[misc]
        assert (None if run.protocol is None else run.protocol.fingerprint) == shown


def test_a_protocol_without_figures_cannot_be_chosen(store: Store, samples: Samples) -> None:
    done, other = samples.run_in(RunState.SUCCEEDED), samples.run_in(RunState.SUCCEEDED)
    evaluate(store, done, result(ate_rmse=0.07))
    evaluate(store, done, result(SIM3, ate_rmse=0.05), SIM3)
    evaluate(store, other, result(ate_rmse=0.09))
    with pytest.raises(Conflict, match=f"run {other} has no metrics under protocol"):
        store.write(lambda tx: tx.evaluations.use([done, other], SIM3.fingerprint))
    assert store.read(lambda tx: tx.metrics.for_runs([done])) == {done: {"ate.rmse": 0.07}}
    with pytest.raises(NotFound, match="unknown protocol 'measured'"):
        store.write(lambda tx: tx.evaluations.use([done], "measured"))
    assert store.read(lambda tx: tx.evaluations.protocols()) == [(SE3, 2), (SIM3, 1)]


def test_evaluating_again_replaces_the_figures_of_that_protocol(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.SUCCEEDED)
    evaluate(store, run_id, result(ate_rmse=0.07, rpe_rmse=0.01))
    evaluate(store, run_id, result(ate_rmse=0.08))
    assert store.read(lambda tx: tx.metrics.for_runs([run_id])) == {run_id: {"ate.rmse": 0.08}}


def test_one_that_waits_or_works_is_not_doubled(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.SUCCEEDED)
    evaluation_id = queue(store, run_id)
    assert queue(store, run_id) == evaluation_id
    claim(store)
    assert queue(store, run_id) == evaluation_id
    assert queue(store, run_id, SIM3) != evaluation_id


def test_only_runs_that_succeeded(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.FAILED)
    with pytest.raises(Conflict, match=f"run {run_id} is failed; only a run that succeeded"):
        queue(store, run_id)
    with pytest.raises(NotFound, match="unknown run 99"):
        queue(store, 99)


def test_claims_take_the_oldest_first_and_each_once(store: Store, samples: Samples) -> None:
    run_ids = [samples.run_in(RunState.SUCCEEDED) for _ in range(3)]
    ids = store.write(lambda tx: tx.evaluations.queue(run_ids, SE3, NOW, Artefacts.PLOTS))
    first = claim(store, limit=2)
    assert [record.id for record in first] == ids[:2]
    assert {record.artefacts for record in first} == {Artefacts.PLOTS}
    assert [record.id for record in claim(store, "worker-2")] == ids[2:]
    assert claim(store) == []
    assert store.read(lambda tx: tx.evaluations.counts_by_state())[EvaluationState.RUNNING] == 3


def test_a_silent_workers_evaluation_is_taken_over(store: Store, samples: Samples) -> None:
    evaluation_id = queue(store, samples.run_in(RunState.SUCCEEDED))
    claim(store)
    assert store.write(lambda tx: tx.evaluations.heartbeat([evaluation_id], Lease(WORKER, NOW, 30.0))) == {
        evaluation_id
    }
    assert claim(store, "worker-2") == []
    (record,) = claim(store, "worker-2", LATER)
    assert (record.id, record.attempt, record.lease_owner) == (evaluation_id, 2, "worker-2")
    with pytest.raises(LeaseLost, match="held by worker-2"):
        store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, result(ate_rmse=1.0), LATER))
    assert store.write(lambda tx: tx.evaluations.heartbeat([evaluation_id], Lease(WORKER, NOW, 30.0))) == set()


def test_a_released_evaluation_is_queued_again(store: Store, samples: Samples) -> None:
    evaluation_id = queue(store, samples.run_in(RunState.SUCCEEDED))
    claim(store)
    store.write(lambda tx: tx.evaluations.release([evaluation_id], WORKER))
    assert store.read(lambda tx: tx.evaluations.get(evaluation_id)).state is EvaluationState.QUEUED
    assert [record.id for record in claim(store, "worker-2")] == [evaluation_id]


def test_finishing_twice_is_fine(store: Store, samples: Samples) -> None:
    run_id = samples.run_in(RunState.SUCCEEDED)
    evaluation_id = evaluate(store, run_id, result(ate_rmse=0.07))
    store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, result(ate_rmse=0.07), NOW))
    with pytest.raises(LeaseLost):
        store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, result(ate_rmse=9.0), LATER))
    with pytest.raises(NotFound):
        store.write(lambda tx: tx.evaluations.finish(99, WORKER, result(), NOW))
    assert store.read(lambda tx: tx.metrics.for_runs([run_id])) == {run_id: {"ate.rmse": 0.07}}


def test_unevaluated_are_those_without_a_result_or_a_turn_to_come(store: Store, samples: Samples) -> None:
    done, broken, waiting, untouched = (samples.run_in(RunState.SUCCEEDED) for _ in range(4))
    samples.run_in(RunState.FAILED)
    evaluate(store, done, result(ate_rmse=0.1))
    evaluate(store, broken, result(reason="no overlap"))
    queue(store, waiting)
    assert store.read(lambda tx: tx.evaluations.unevaluated_run_ids()) == [broken, untouched]


def test_figures_are_merged_by_key(store: Store, samples: Samples) -> None:
    (run_id,) = samples.queued()
    store.write(lambda tx: tx.metrics.put(run_id, None, {"cpu.mean": 1.0, "ram.max": 5e8}))
    store.write(lambda tx: tx.metrics.put(run_id, None, {"cpu.mean": 2.0, "never.seen.before": -1e-300}))
    assert store.read(lambda tx: tx.metrics.by_protocol(run_id)) == {
        None: {"cpu.mean": 2.0, "ram.max": 5e8, "never.seen.before": -1e-300}
    }


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_missing_figure_is_no_number(store: Store, samples: Samples, value: float) -> None:
    (run_id,) = samples.queued()
    with pytest.raises(InvalidInput, match=f"metric cpu.mean of run {run_id} is {value}"):
        store.write(lambda tx: tx.metrics.put(run_id, None, {"ram.max": 1.0, "cpu.mean": value}))
    assert store.read(lambda tx: tx.metrics.by_protocol(run_id)) == {}


def test_figures_need_a_known_protocol(store: Store, samples: Samples) -> None:
    (run_id,) = samples.queued()
    with pytest.raises(NotFound, match="unknown protocol 'abc'"):
        store.write(lambda tx: tx.metrics.put(run_id, "abc", {"ate.rmse": 1.0}))
    assert store.read(lambda tx: tx.metrics.for_runs([run_id, 99])) == {run_id: {}, 99: {}}
