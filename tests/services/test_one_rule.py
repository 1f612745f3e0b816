"""Lists, groups, experiments and analyses count the same runs as failed, for the same reasons."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from slamhive.analysis.table import FAILED
from slamhive.documents.run import RunDocument
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.verdict import DEFAULT_RULE, Outcome, VerdictKind
from slamhive.evaluation.job import EvaluationResult
from slamhive.services.analysis.table import TableRequest, load_table
from slamhive.services.hive import Hive
from slamhive.store import Lease, RunSort
from slamhive.store.records import CellRecord, ExperimentState
from tests.store.store_samples import SE3, WORKER, Samples

pytestmark = pytest.mark.integration

NOW = datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)
OUTLIER, LOST = VerdictKind.DIVERGED_OUTLIER, VerdictKind.TRACKED_TOO_LITTLE
ERRORS_M = {1: 0.1, 2: 0.12, 3: 0.11, 4: 1.4, 5: 1.41, 6: 0.13, 7: 0.01}
"""Of the repeats; the seventh lost track early."""


def evaluate(hive: Hive, run_id: int, metrics: dict[str, float], reason: str | None = None) -> None:
    """File what an evaluation found."""
    (number,) = hive.store.write(lambda t: t.evaluations.queue([run_id], SE3, NOW))
    hive.store.write(lambda t: t.evaluations.claim(Lease(WORKER, NOW, 30.0)))
    result = EvaluationResult(str(number), SE3.fingerprint, reason, metrics, 50, 50, "evo")
    hive.store.write(lambda t: t.evaluations.finish(number, WORKER, result, NOW))


@pytest.fixture
def runs(hive: Hive) -> list[int]:
    """Ten runs of a cell: 4 good, 2 diverged, 1 lost, 1 cannot be evaluated, 1 timed out, 1 was never evaluated."""
    samples = Samples(hive.store, NOW)
    configuration = samples.configuration()
    values: dict[str, Any] = {
        "description": "",
        "content_hash": "",
        "source": "name: e",
        "state": ExperimentState.ACTIVE,
    }
    values |= {"executor": "process", "priority": 0, "repeats": 10, "cells": 1, "runs": 10, "complete": True}

    def add(t: Any) -> int:
        record = t.experiments.get_or_create("0" * 32, "e", created_at=NOW, **values)
        t.experiments.add_cells(record.id, [CellRecord(1, "c", configuration, {"seed": 1, "rate": 2})])
        number: int = record.id
        return number

    place: dict[str, Any] = {"configuration_id": configuration, "experiment_id": hive.store.write(add), "cell": 1}
    states = [*[RunState.SUCCEEDED] * 8, RunState.FAILED, RunState.SUCCEEDED]
    made = [samples.run_in(state, **place) for state in states]
    for run_id, error_m in ERRORS_M.items():
        tracked = 0.2 if run_id == 7 else 0.95
        metrics = {"ate.rmse": error_m, "ate.per_path": error_m, "tracked.path": tracked, "tracked_fraction": 0.3}
        evaluate(hive, made[run_id - 1], metrics)
    evaluate(hive, made[7], {}, "no pose matches")
    return made


def test_list_groups_experiment_analysis_and_json_agree(hive: Hive, runs: list[int]) -> None:
    expected = {4: OUTLIER, 5: OUTLIER, 7: LOST, 8: VerdictKind.NOT_EVALUABLE, 9: VerdictKind.ENDED_BADLY}
    failed = {runs[place - 1]: kind for place, kind in expected.items()}

    listed = {run.id: run.verdict for run in hive.runs.page(limit=100).records}
    assert {run: verdict.kind for run, verdict in listed.items() if verdict and verdict.failed} == failed
    assert listed[runs[9]] is None
    shown = {run.id: RunDocument.of(run).content["verdict"] for run in hive.runs.page(limit=100).records}
    assert {run: found["kind"] for run, found in shown.items() if found and found["failed"]} == failed

    (group,) = hive.searches.groups(hive.searches.read(""), RunSort("failed"), None, 10, ["ate.rmse"]).records
    assert (group.runs, group.failed) == (10, 5)

    status = hive.experiments.status("e")
    assert {phase: count for phase, count in status.counts.items() if count} == {
        Outcome.GOOD: 4,
        Outcome.FAILED: 5,
        Outcome.UNJUDGED: 1,
    }
    why = {OUTLIER: 2, LOST: 1, VerdictKind.NOT_EVALUABLE: 1, FailureReason.TIMEOUT: 1}
    assert (status.failures, status.ended, status.ended_badly) == (why, 10, 1)
    (cell,) = hive.experiments.cells("e", 0, 10).cells
    assert (cell.counts, cell.failures) == (status.counts, why)
    grid = hive.experiments.grid("e", "seed", "rate")
    assert [(entry.counts, entry.failures) for entry in grid.cells.values()] == [(status.counts, why)]
    untold: dict[str, Any] = dict.fromkeys(("left_s", "low_s", "high_s"))
    (listed_status,) = hive.experiments.list()
    assert replace(listed_status, **untold) == replace(status, **untold)

    table = load_table(hive.store, TableRequest(runs, {"ate.rmse"}, None, DEFAULT_RULE), {}, {})
    assert set(table.failed()["run_id"]) == set(failed)
    assert (len(table.good()), table.not_evaluated) == (4, 1)
    assert Counter(table.failed()[FAILED])[OUTLIER.label] == 2


def test_means_and_medians_are_of_the_same_runs(hive: Hive, runs: list[int]) -> None:
    good = [0.1, 0.12, 0.11, 0.13]
    (group,) = hive.searches.groups(hive.searches.read(""), RunSort("failed"), None, 10, ["ate.rmse"]).records
    spread = next(figures["ate.rmse"] for figures in group.figures.values())
    (cell,) = hive.experiments.cells("e", 0, 10).cells
    figures = next(entry for entry in cell.figures if entry.protocol is not None)
    table = load_table(hive.store, TableRequest(runs, {"ate.rmse"}, None, DEFAULT_RULE), {}, {})
    for found in (spread, figures.metrics["ate.rmse"]):
        assert [found.n, found.mean, found.median] == pytest.approx([4, sum(good) / 4, 0.115])
    assert sorted(table.good()["ate.rmse"]) == pytest.approx(sorted(good))


def test_cancelled_and_unfinished_runs_are_neither_good_nor_failed_in_an_analysis(hive: Hive, runs: list[int]) -> None:
    samples = Samples(hive.store, NOW)
    samples._numbers = iter(range(1000, 2000))  # type: ignore[assignment]
    more = [samples.run_in(RunState.CANCELLED), samples.run_in(RunState.RUNNING)]
    table = load_table(hive.store, TableRequest([*runs, *more], {"ate.rmse"}, None, DEFAULT_RULE), {}, {})
    assert not set(table.frame["run_id"]) & set(more)
    assert table.not_evaluated == 3
