"""Verdicts are stored with the metrics they follow from, for all repeats, under each protocol."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from sqlalchemy import text

from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import DROPPED_FRAMES
from slamhive.domain.verdict import DIVERGED, ERROR_OVER_REPEATS, REPEATS_LIMIT, VerdictKind, outcome_words
from slamhive.evaluation.job import EvaluationResult
from slamhive.filters.binding import Search, read_search
from slamhive.filters.fields import Vocabulary
from slamhive.filters.words import in_words
from slamhive.store import Lease, RunSort, Store, migrate
from slamhive.store.metrics import CODES, VERDICT, kind_of
from tests.store.store_samples import SE3, SIM3, WORKER, Samples

pytestmark = pytest.mark.integration

NOW = datetime(2026, 5, 4, 3, 2, 1, 123456, tzinfo=UTC)
GOOD, OUTLIER = VerdictKind.GOOD, VerdictKind.DIVERGED_OUTLIER


def outcome(error_m: float | None, protocol=SE3, tracked: float | None = 0.95) -> EvaluationResult:
    """What the engine finds of a run over 80 m; None: it cannot be evaluated."""
    metrics = {} if error_m is None else {"ate.rmse": error_m, "ate.per_path": error_m / 0.8, "tracked_fraction": 0.5}
    if error_m is not None and tracked is not None:
        metrics["tracked.path"] = tracked
    reason = "no pose matches" if error_m is None else None
    return EvaluationResult("1", protocol.fingerprint, reason, metrics, 50, 50, "evo 1.31")


def evaluate(store: Store, run_id: int, result: EvaluationResult, protocol=SE3) -> None:
    evaluation_id = store.write(lambda tx: tx.evaluations.queue([run_id], protocol, NOW))[0]
    store.write(lambda tx: tx.evaluations.claim(Lease(WORKER, NOW, 30.0)))
    store.write(lambda tx: tx.evaluations.finish(evaluation_id, WORKER, result, NOW))


def evaluated(store: Store, samples: Samples, *errors_m: float | None, protocol=SE3) -> list[int]:
    """Repeats of one configuration with these errors."""
    runs = [samples.run_in(RunState.SUCCEEDED) for _ in errors_m]
    for run_id, error_m in zip(runs, errors_m, strict=True):
        evaluate(store, run_id, outcome(error_m, protocol), protocol)
    return runs


def count_dropped(store: Store, run_id: int, share: float) -> None:
    store.write(lambda tx: tx.metrics.put(run_id, None, {DROPPED_FRAMES: share}))


def kinds(store: Store, runs: list[int]) -> list[VerdictKind | None]:
    """The stored verdicts; what pages derive from the metrics says the same."""
    found = store.read(lambda tx: tx.runs.get_many(runs, with_metrics=True))
    for run in found:
        assert (run.verdict and run.verdict.kind) == run.judged
    return [run.judged for run in found]


def rows(store: Store, key: str) -> list[tuple[int, int, float, int]]:
    query = text(
        "SELECT run_id, protocol_id, value, is_current FROM metric_values JOIN metrics ON metrics.id = metric_id "
        "WHERE metrics.`key` = :key ORDER BY run_id, protocol_id"
    )
    with store.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(query, {"key": key})]


def test_repeats_are_judged_again_when_another_one_is_evaluated(store: Store, samples: Samples) -> None:
    runs = evaluated(store, samples, 0.1, 1.4)
    assert kinds(store, runs) == [GOOD, GOOD]
    runs += evaluated(store, samples, 0.12)
    assert kinds(store, runs) == [GOOD, OUTLIER, GOOD]
    metrics = store.read(lambda tx: tx.metrics.for_runs(runs))
    assert metrics[runs[1]][ERROR_OVER_REPEATS] == pytest.approx(1.4 / 0.12)
    assert metrics[runs[1]][REPEATS_LIMIT] == 4.0
    assert VERDICT not in metrics[runs[1]]


def test_other_configurations_and_other_protocols_are_no_repeats(store: Store, samples: Samples) -> None:
    runs = evaluated(store, samples, 0.1, 0.12, 0.11, 1.4)
    other = samples.run_in(RunState.SUCCEEDED, configuration_id=samples.configuration({"nFeatures": 5}))
    evaluate(store, other, outcome(1.4))
    for run_id in runs:
        evaluate(store, run_id, outcome(1.4, SIM3), SIM3)
    assert kinds(store, [*runs, other]) == [GOOD, GOOD, GOOD, OUTLIER, GOOD]
    store.write(lambda tx: tx.evaluations.use(runs, SIM3.fingerprint))
    assert kinds(store, runs) == [GOOD, GOOD, GOOD, GOOD]


def test_a_run_that_is_evaluated_again_gets_a_new_verdict_and_so_do_its_repeats(store: Store, samples: Samples) -> None:
    runs = evaluated(store, samples, 0.1, 0.12, 1.4)
    evaluate(store, runs[2], outcome(0.11))
    assert kinds(store, runs) == [GOOD, GOOD, GOOD]
    evaluate(store, runs[0], outcome(0.1, tracked=0.3))
    assert kinds(store, runs) == [VerdictKind.TRACKED_TOO_LITTLE, GOOD, GOOD]
    assert rows(store, ERROR_OVER_REPEATS) == []


def test_a_run_that_got_69_of_150_sweeps_is_not_good(store: Store, samples: Samples) -> None:
    """Its error is seven times that of its repeats, and yet too small to be an outlier."""
    runs = [samples.run_in(RunState.SUCCEEDED) for _ in range(4)]
    for run_id, error_m, dropped in zip(runs, (0.012, 0.011, 0.013, 0.084), (0.0, 0.0, 0.3, 81 / 150), strict=True):
        count_dropped(store, run_id, dropped)
        evaluate(store, run_id, outcome(error_m))
    missed = VerdictKind.MISSED_INPUT
    assert kinds(store, runs) == [GOOD, GOOD, GOOD, missed]
    (last,) = store.read(lambda tx: tx.runs.get_many(runs[3:], with_metrics=True))
    assert outcome_words(last) == "failed: missed too much input"
    assert last.verdict is not None
    assert last.verdict.words == "The run missed 54 % of the input frames; 50 % are allowed."
    assert found(store, "verdict = missed_input", RunSort("id")) == runs[3:]


def test_runs_from_before_input_was_counted_are_judged_again_by_the_migration(store: Store, samples: Samples) -> None:
    (run_id,) = evaluated(store, samples, 0.1)
    migrate.downgrade(store.engine, "0025")
    count_dropped(store, run_id, 0.6)
    migrate.upgrade(store.engine)
    assert kinds(store, [run_id]) == [VerdictKind.MISSED_INPUT]
    migrate.downgrade(store.engine, "0025")
    assert rows(store, VERDICT) == []
    migrate.upgrade(store.engine)


def test_what_cannot_be_evaluated_has_a_verdict_until_it_can(store: Store, samples: Samples) -> None:
    (run_id,) = evaluated(store, samples, None)
    assert kinds(store, [run_id]) == [VerdictKind.NOT_EVALUABLE]
    evaluate(store, run_id, outcome(None, SIM3), SIM3)
    assert kinds(store, [run_id]) == [VerdictKind.NOT_EVALUABLE]
    code = float(CODES[VerdictKind.NOT_EVALUABLE])
    assert [row[2:] for row in rows(store, VERDICT)] == [(code, 0), (code, 1)]
    evaluate(store, run_id, outcome(0.1))
    assert kinds(store, [run_id]) == [GOOD]
    assert [row[2:] for row in rows(store, VERDICT)] == [(0.0, 1), (code, 0)]
    evaluate(store, run_id, outcome(None))
    assert kinds(store, [run_id]) == [GOOD]


def test_runs_that_ended_badly_have_a_verdict_and_those_that_nobody_judged_have_none(
    store: Store, samples: Samples
) -> None:
    failed = samples.run_in(RunState.FAILED)
    cancelled, succeeded, queued = (
        samples.run_in(state) for state in (RunState.CANCELLED, RunState.SUCCEEDED, RunState.QUEUED)
    )
    found = store.read(lambda tx: tx.runs.get_many([failed, cancelled, succeeded, queued], with_metrics=True))
    assert [run.verdict and run.verdict.kind for run in found] == [VerdictKind.ENDED_BADLY, None, None, None]


def test_runs_from_before_there_were_verdicts_are_judged_by_the_migration(store: Store, samples: Samples) -> None:
    runs = evaluated(store, samples, 0.1, 0.12, 1.4, None)
    evaluate(store, runs[1], outcome(0.12, tracked=None))
    expected, stored = kinds(store, runs), rows(store, VERDICT)
    assert expected == [GOOD, VerdictKind.TRACKED_TOO_LITTLE, GOOD, VerdictKind.NOT_EVALUABLE]
    migrate.downgrade(store.engine, "0008")
    assert (rows(store, VERDICT), rows(store, ERROR_OVER_REPEATS)) == ([], [])
    migrate.upgrade(store.engine)
    assert (kinds(store, runs), rows(store, VERDICT)) == (expected, stored)


def test_verdicts_are_no_metric_that_lists_offer(store: Store, samples: Samples) -> None:
    evaluated(store, samples, 0.1)
    assert VERDICT not in store.read(lambda tx: tx.searches.metrics())
    assert ERROR_OVER_REPEATS not in store.read(lambda tx: tx.searches.metrics())
    (figures,) = store.read(lambda tx: tx.metrics.by_protocol(1)).values()
    assert VERDICT not in figures


def test_every_kind_that_is_stored_has_a_code_of_its_own() -> None:
    assert {kind_of(code) for code in CODES.values()} == set(VerdictKind) - {VerdictKind.ENDED_BADLY}
    assert kind_of(None) is None


# -- filters and groups ----------------------------------------------------------------------------------------------


@pytest.fixture
def mixed(store: Store, samples: Samples) -> list[int]:
    """Runs of every kind: 5 repeats, one that lost track, one diverged, one lost with its node, and some not judged."""
    runs = evaluated(store, samples, 0.1, 0.12, 0.11, 1.4, None)
    lost = samples.run_in(RunState.SUCCEEDED)
    evaluate(store, lost, outcome(0.01, tracked=0.2))
    far = samples.run_in(RunState.SUCCEEDED, configuration_id=samples.configuration({"nFeatures": 7}))
    evaluate(store, far, outcome(8.0))
    taken = samples.run_in(RunState.FAILED, FailureReason.LOST)
    states = (RunState.FAILED, RunState.CANCELLED, RunState.SUCCEEDED, RunState.QUEUED)
    return [*runs, lost, far, taken, *(samples.run_in(state) for state in states)]


def found(store: Store, where: str, sort: RunSort | None = None) -> list[int]:
    search = read_search(where, Vocabulary(protocols={SIM3.fingerprint: SIM3.label}))
    page = store.read(lambda tx: tx.runs.page(search, sort, limit=100))
    assert store.read(lambda tx: tx.searches.exact_count(search)) == page.count.number == len(page.records)
    assert store.read(lambda tx: tx.searches.run_ids(search)) == sorted(run.id for run in page.records)
    return [run.id for run in page.records]


@pytest.mark.parametrize(
    ("where", "kinds_wanted"),
    [
        ("verdict = good", {VerdictKind.GOOD}),
        ("verdict = diverged", set(DIVERGED)),
        ("verdict = diverged_outlier", {OUTLIER}),
        ("verdict = failed", set(VerdictKind) - {GOOD}),
        ("verdict != good", set(VerdictKind) - {GOOD}),
        ("verdict in (ended_badly, not_evaluable)", {VerdictKind.ENDED_BADLY, VerdictKind.NOT_EVALUABLE}),
        ("verdict not in (diverged, good)", set(VerdictKind) - {GOOD, *DIVERGED}),
        ("verdict ~ tracked*", {VerdictKind.TRACKED_TOO_LITTLE}),
        ("verdict !~ diverged*", set(VerdictKind) - set(DIVERGED)),
        ("verdict = failed and ate.rmse > 1", set(DIVERGED)),
        ("has verdict", set(VerdictKind)),
        ("not verdict = failed and id > 0", {GOOD, None}),
        ("missing verdict", {None}),
    ],
)
def test_filters_find_runs_by_their_verdict(
    store: Store, mixed: list[int], where: str, kinds_wanted: set[VerdictKind | None]
) -> None:
    runs = store.read(lambda tx: tx.runs.get_many(mixed, with_metrics=True))
    wanted = [run.id for run in runs if (run.verdict and run.verdict.kind) in kinds_wanted]
    assert wanted
    assert found(store, where, RunSort("id", descending=False)) == wanted
    assert set(found(store, where, RunSort("ate.rmse"))) == set(wanted)


def test_a_run_that_was_taken_away_is_lost_and_has_not_failed(store: Store, mixed: list[int]) -> None:
    (taken,) = found(store, "reason = lost")
    (run,) = store.read(lambda tx: tx.runs.get_many([taken], with_metrics=True))
    assert (run.outcome_words, run.verdict) == ("lost", None)
    for where in ("verdict = failed", "verdict = ended_badly", "has verdict"):
        assert taken not in found(store, where)
    assert taken in found(store, "missing verdict")


def test_a_filter_that_chooses_a_protocol_goes_by_the_verdicts_under_it(store: Store, mixed: list[int]) -> None:
    evaluate(store, mixed[0], outcome(6.0, SIM3), SIM3)
    assert found(store, f"verdict = diverged_far and protocol = {SIM3.fingerprint}") == [mixed[0]]
    assert mixed[0] in found(store, "verdict = good")


def test_a_filter_says_in_words_what_it_looks_for() -> None:
    search = read_search("verdict = diverged", Vocabulary())
    assert in_words(search) == "verdict one of diverged, diverged (outlier among its repeats)"
    assert in_words(read_search("verdict = good", Vocabulary())) == "verdict good"


def test_groups_count_every_failure_and_average_the_others(store: Store, mixed: list[int]) -> None:
    page = store.read(lambda tx: tx.searches.groups(Search(), RunSort("failed"), None, 10, ["ate.rmse"]))
    first, second = page.records
    assert [(group.runs, group.failed) for group in (first, second)] == [(11, 4), (1, 1)]
    (figures,) = first.figures.values()
    spread = figures["ate.rmse"]
    assert [spread.n, spread.median, spread.mean, spread.maximum] == pytest.approx([3, 0.11, 0.11, 0.12])
    assert second.figures == {}


@pytest.mark.parametrize(("errors_m", "middle"), [([0.1], 0.1), ([0.1, 0.3], 0.2), ([0.1, 0.2, 0.15, 0.3], 0.175)])
def test_the_median_of_groups(store: Store, samples: Samples, errors_m: list[float], middle: float) -> None:
    evaluated(store, samples, *errors_m)
    page = store.read(lambda tx: tx.searches.groups(Search(), RunSort("ate.rmse"), None, 10, ["ate.rmse"]))
    (figures,) = page.records[0].figures.values()
    assert figures["ate.rmse"].median == pytest.approx(middle)
