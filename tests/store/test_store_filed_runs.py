"""Runs filed as their folders tell them, many at once."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import event

from slamhive.base.errors import Conflict
from slamhive.domain.protocol import Protocol
from slamhive.domain.run import FailureReason, RunEvent, RunState
from slamhive.domain.verdict import FROM_REPEATS
from slamhive.evaluation.job import Artefacts
from slamhive.store import EvaluationState, RunFields, RunSnapshot, Store
from slamhive.store.filed_runs import FiledRun
from slamhive.store.records import EndedEvaluation, EvaluationRecord
from tests.store.store_samples import SE3, SIM3, Samples

pytestmark = pytest.mark.quick

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)
LATER = NOW + timedelta(seconds=7)
EVENTS = (
    RunEvent(NOW, None, RunState.QUEUED, "submitted"),
    RunEvent(LATER, RunState.RUNNING, RunState.FAILED, "x"),
)


def ended(protocol: Protocol = SE3, state: EvaluationState = EvaluationState.SUCCEEDED) -> EndedEvaluation:
    return EndedEvaluation(protocol, state, None, Artefacts.FILES, "evo 1.31", NOW, None, LATER, attempt=1)


def succeeded(samples: Samples, number: int, figure: float = 0.07) -> FiledRun:
    snapshot = RunSnapshot(number, samples.request(), RunState.SUCCEEDED, NOW, RunFields(poses=3), events=EVENTS)
    figures = {SE3.fingerprint: {"ate.rmse": figure}, SIM3.fingerprint: {"ate.rmse": figure / 2}}
    return FiledRun(snapshot, {"cpu.mean": 1.5}, [ended(), ended(SIM3)], figures, SE3.fingerprint)


def file(store: Store, *runs: FiledRun) -> None:
    store.write(lambda tx: tx.filed_runs.file(runs))


def history(store: Store, number: int) -> tuple[list[EvaluationRecord], list[RunEvent]]:
    return store.read(lambda tx: (tx.evaluations.for_run(number), tx.runs.events(number)))


def test_a_run_is_rebuilt_from_its_folder(store: Store, samples: Samples) -> None:
    fields = RunFields(reason=FailureReason.TIMEOUT, started_at=NOW, ended_at=LATER, exit_code=137)
    snapshot = RunSnapshot(41, samples.request(), RunState.FAILED, NOW, fields, attempt=2, events=EVENTS)
    for _ in range(2):
        file(store, FiledRun(snapshot))
    run = store.read(lambda tx: tx.runs.get(41))
    assert (run.state, run.reason, run.exit_code, run.attempt) == (RunState.FAILED, FailureReason.TIMEOUT, 137, 2)
    assert store.read(lambda tx: tx.runs.events(41)) == list(EVENTS)
    assert samples.queued() == [42]


def test_a_number_or_uid_of_another_run_is_refused_and_nothing_is_filed(store: Store, samples: Samples) -> None:
    first, second = succeeded(samples, 41), succeeded(samples, 42)
    file(store, first)
    number = replace(first, snapshot=replace(first.snapshot, request=samples.request()))
    uid = replace(first, snapshot=replace(first.snapshot, id=43))
    for clashing in (number, uid):
        with pytest.raises(Conflict, match="clashes with run 41"):
            file(store, second, clashing)
    with pytest.raises(Conflict, match="clashes with"):
        file(store, second, replace(second, snapshot=replace(second.snapshot, id=43)))
    assert store.read(lambda tx: tx.runs.counts_by_state())[RunState.SUCCEEDED] == 1


def test_what_is_filed_again_is_made_equal_and_not_doubled(store: Store, samples: Samples) -> None:
    runs = [succeeded(samples, number) for number in (1, 2, 3)]
    file(store, *runs)
    changed = replace(
        runs[1],
        measured={"cpu.mean": 2.5},
        figures={SE3.fingerprint: {"rpe.rmse": 0.5}, SIM3.fingerprint: {"ate.rmse": 0.03}},
        current=SIM3.fingerprint,
    )
    file(store, runs[0], changed)
    found = store.read(lambda tx: tx.runs.get_many([1, 2, 3], with_metrics=True))
    filed = [{key: value for key, value in (run.metrics or {}).items() if key not in FROM_REPEATS} for run in found]
    whole = {"cpu.mean": 1.5, "ate.rmse": 0.07}
    assert filed == [whole, {"cpu.mean": 2.5, "ate.rmse": 0.03}, whole]
    assert [run.protocol.fingerprint for run in found if run.protocol] == [
        protocol.fingerprint for protocol in (SE3, SIM3, SE3)
    ]
    assert store.read(lambda tx: tx.metrics.by_protocol(2))[SE3.fingerprint] == {"rpe.rmse": 0.5}
    for number in (1, 2, 3):
        evaluations, moves = history(store, number)
        assert [(entry.protocol, entry.ended_at) for entry in evaluations] == [(SE3, LATER), (SIM3, LATER)]
        assert moves == list(EVENTS)


def test_figures_that_a_folder_does_not_tell_of_stay(store: Store, samples: Samples) -> None:
    run = succeeded(samples, 5)
    file(store, run)
    file(store, FiledRun(run.snapshot, {"ram.max": 1.0}))
    found = store.read(lambda tx: tx.runs.get(5, with_metrics=True))
    assert found.metrics == {"cpu.mean": 1.5, "ram.max": 1.0, "ate.rmse": 0.07}


@pytest.mark.integration
def test_many_runs_take_as_many_statements_as_few(store: Store, samples: Samples) -> None:
    statements: list[str] = []

    def note(_connection: object, _cursor: object, statement: str, *_rest: object) -> None:
        statements.append(statement)

    counts = []
    runs = [succeeded(samples, number) for number in range(1, 64)]
    event.listen(store.engine, "before_cursor_execute", note)
    try:
        for part in (runs[:4], runs[4:6], runs[6:]):
            file(store, *part)
            counts.append(len(statements))
            statements.clear()
    finally:
        event.remove(store.engine, "before_cursor_execute", note)
    assert counts[2] == counts[1]
