"""Disturbed runs of an experiment are repeated: so often as asked for, once each, whatever dies meanwhile."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.documents import experiment as schema
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Outcome
from slamhive.experiments.file import parse_experiment
from slamhive.services.experiments.progress import counted_runs
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive, open_hive
from slamhive.services.reindex import reindex
from slamhive.services.runs.service import repeat_if_disturbed
from slamhive.services.worker import worker as worker_module
from slamhive.store.records import CellRun, RunRecord
from tests.services.disturbed_machine import BUSY, QUIET, beside, beside_each
from tests.services.fake_executor import FakeExecutor

pytestmark = pytest.mark.quick

CHECKOUT = Path(__file__).resolve().parents[2]
ONE = "name: one\nalgorithms: tiny\ndatasets: track\nevaluate: false\nrepeat_disturbed: 2\n"


def source(text: str = ONE) -> ExperimentSource:
    return ExperimentSource(text, "one.yaml")


def work(hive: Hive, executor: FakeExecutor) -> None:
    hive.executors.opened["process"] = executor
    hive.worker().run(until_idle=True)


def runs_of(hive: Hive) -> tuple[RunRecord, ...]:
    return hive.store.read(lambda t: t.runs.get_many(hive.experiments.run_ids("one")))


def disturbed(hive: Hive) -> list[bool | None]:
    return [None if run.disturbance is None else run.disturbance.disturbed for run in runs_of(hive)]


@pytest.mark.integration
def test_a_disturbed_run_is_repeated_until_one_is_not(hive: Hive) -> None:
    hive.experiments.start(source())
    work(hive, beside_each(iter([BUSY, QUIET])))
    first, second = runs_of(hive)
    assert disturbed(hive) == [True, False]
    assert (second.retry_of, second.seed, second.cell, second.repeat_disturbed) == (first.id, first.seed, first.cell, 1)
    status = hive.experiments.status("one")
    assert (status.counts[Outcome.UNJUDGED], status.retried, status.disturbed) == (1, 1, 0)
    assert (status.runs, status.state) == (1, ConfigurationStanding.FINISHED)
    (cell,) = hive.experiments.report("one")
    (figures,) = cell.figures
    assert (figures.runs, figures.disturbed) == (1, 0)
    assert [(run.id, run.retried, run.disturbed) for run in cell.runs] == [
        (first.id, True, True),
        (second.id, False, False),
    ]


@pytest.mark.integration
def test_it_is_repeated_so_often_at_most_and_the_last_counts_marked(hive: Hive) -> None:
    hive.experiments.start(source())
    work(hive, beside(*BUSY))
    assert disturbed(hive) == [True, True, True]
    assert [run.repeat_disturbed for run in runs_of(hive)] == [2, 1, 0]
    status = hive.experiments.status("one")
    assert (status.counts[Outcome.UNJUDGED], status.retried, status.disturbed) == (1, 2, 1)
    assert status.content["disturbed"] == 1
    (cell,) = hive.experiments.report("one")
    (figures,) = cell.figures
    assert (figures.runs, figures.disturbed) == (1, 1)
    assert [run["disturbed"] for run in schema.CellDocument.of(cell).content["runs"]] == [True, True, True]


@pytest.mark.integration
def test_without_the_field_nothing_is_repeated_but_all_is_marked(hive: Hive) -> None:
    hive.experiments.start(source(ONE.replace("repeat_disturbed: 2\n", "")))
    work(hive, beside(*BUSY))
    assert disturbed(hive) == [True]
    assert hive.experiments.status("one").disturbed == 1


@pytest.mark.integration
def test_a_disturbed_failure_is_repeated_and_stays_among_the_failures_of_its_cell(hive: Hive) -> None:
    hive.experiments.start(source())
    hive.executors.opened["process"] = beside(*BUSY, exit_code=3)
    only = hive.experiments.run_ids("one")
    hive.worker(only=only).run(until_idle=True)
    work(hive, beside(*QUIET))
    assert [run.state for run in runs_of(hive)] == [RunState.FAILED, RunState.SUCCEEDED]
    assert hive.experiments.status("one").counts[Outcome.FAILED] == 0
    (cell,) = hive.experiments.report("one")
    assert sum(cell.failures.values()) == 1


@pytest.mark.integration
def test_a_quiet_failure_is_not_repeated(hive: Hive) -> None:
    hive.experiments.start(source())
    work(hive, beside(*QUIET, exit_code=3))
    assert [run.state for run in runs_of(hive)] == [RunState.FAILED]


@pytest.mark.integration
def test_of_a_cancelled_experiment_nothing_is_repeated(hive: Hive) -> None:
    hive.experiments.start(source())
    executor = beside(*BUSY)
    disturb = executor.on_start

    def cancel_meanwhile(spec) -> None:
        disturb(spec)
        record = hive.store.read(lambda t: t.experiments.get("one"))
        from slamhive.store.records import ExperimentState  # noqa: PLC0415 - used here alone

        hive.store.write(lambda t: t.experiments.change(record.id, state=ExperimentState.CANCELLED))

    executor.on_start = cancel_meanwhile
    work(hive, executor)
    assert disturbed(hive) == [True]


@pytest.mark.integration
def test_the_repetition_waits_while_the_experiment_is_paused(hive: Hive) -> None:
    hive.experiments.start(source())
    executor = beside(*BUSY)
    disturb = executor.on_start

    def pause_meanwhile(spec) -> None:
        disturb(spec)
        hive.experiments.pause("one")

    executor.on_start = pause_meanwhile
    work(hive, executor)
    assert [run.held for run in runs_of(hive)] == [True, True]
    assert runs_of(hive)[1].state is RunState.QUEUED


@pytest.mark.integration
def test_a_cancelled_repetition_leaves_the_disturbed_run_in_its_place(hive: Hive) -> None:
    hive.experiments.start(source())
    hive.executors.opened["process"] = beside(*BUSY)
    hive.worker(only=hive.experiments.run_ids("one")).run(until_idle=True)
    status = hive.experiments.status("one")
    assert (status.counts[Outcome.QUEUED], status.counts[Outcome.UNJUDGED], status.retried) == (1, 0, 1)
    (cell,) = hive.experiments.report("one")
    assert cell.figures[0].runs == 1, "it counts until the repetition has ended"
    hive.runs.cancel(runs_of(hive)[1].id)
    status = hive.experiments.status("one")
    assert (status.counts[Outcome.CANCELLED], status.counts[Outcome.UNJUDGED], status.disturbed) == (1, 1, 1)


@pytest.mark.integration
def test_what_dies_while_the_run_is_sealed_repeats_it_once(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_module, "TROUBLE_PAUSE_S", 0.01)
    died: list[int] = []

    def die_first(t, run, now) -> None:
        repeat_if_disturbed(t, run, now)
        if not died:
            died.append(hive.store.read(lambda other: len(other.experiments.run_ids(run.experiment_id))))
            raise Unavailable("the disk went away")

    monkeypatch.setattr("slamhive.services.worker.collecting.repeat_if_disturbed", die_first)
    hive.experiments.start(source())
    work(hive, beside_each(iter([BUSY, QUIET])))
    assert died == [1], "the end and the repetition are stored together, or not at all"
    assert disturbed(hive) == [True, False]


@pytest.mark.integration
@pytest.mark.parametrize(("when", "stored"), [("inside", 1), ("after", 2)])
def test_a_worker_that_is_killed_neither_loses_nor_doubles_a_repetition(hive: Hive, when: str, stored: int) -> None:
    hive.experiments.start(source())
    assert _worker(when) == -signal.SIGKILL
    assert len(hive.experiments.run_ids("one")) == stored
    assert _worker("never") == 0
    assert disturbed(hive) == [True, True, True]
    first, second, third = runs_of(hive)
    assert [run.retry_of for run in (first, second, third)] == [None, first.id, second.id]


def _worker(when: str) -> int:
    """A worker process of this installation that dies at a moment; how it ended."""
    command = [sys.executable, "-m", "tests.services.killed_while_sealing", when]
    return subprocess.run(command, cwd=CHECKOUT, timeout=120, check=False, capture_output=True).returncode


@pytest.mark.integration
def test_reindexing_queues_the_repetition_that_had_not_begun(hive: Hive, tmp_path: Path) -> None:
    hive.experiments.start(source())
    hive.executors.opened["process"] = beside(*BUSY)
    hive.worker(only=hive.experiments.run_ids("one")).run(until_idle=True)
    before = [(run.uid, run.state, run.retry_of, run.repeat_disturbed) for run in runs_of(hive)]
    assert [state for _, state, _, _ in before] == [RunState.SUCCEEDED, RunState.QUEUED]
    hive.close()
    (tmp_path / "data" / "slamhive.db").unlink()
    again = open_hive()
    for _ in range(2):
        reindex(again, lambda _done, _total: None)
        assert [(run.uid, run.state, run.retry_of, run.repeat_disturbed) for run in runs_of(again)] == before
    again.close()


def test_the_plan_shows_it(hive: Hive) -> None:
    preview = hive.experiments.preview(source())
    assert (preview.runs, preview.repeat_disturbed) == (1, 2)
    assert preview.content["repeat_disturbed"] == 2


@pytest.mark.parametrize("text", ["-1", "11", "often", "1.5"])
def test_other_numbers_are_refused_with_their_line(text: str) -> None:
    with pytest.raises(InvalidInput, match=r"one\.yaml line 5: repeat_disturbed"):
        parse_experiment(ONE.replace("repeat_disturbed: 2", f"repeat_disturbed: {text}"), "one.yaml")


def test_experiments_of_before_keep_their_hash() -> None:
    plain = ONE.replace("repeat_disturbed: 2\n", "")
    stored = "1f86d7ffb1a3c52d13b1263abdd8bae5fbb62eb5daaabdfea83380ad82300d19"
    assert parse_experiment(plain).content_hash == stored
    assert parse_experiment(plain + "repeat_disturbed: 0\n").content_hash == stored
    assert parse_experiment(ONE).content_hash != stored


def run(number: int, retry_of: int | None = None, *, was: bool | None = False, state: str = "succeeded") -> CellRun:
    return CellRun(number, 1, 0, RunState(state), None, retried=False, retry_of=retry_of, disturbed=was)


@pytest.mark.parametrize(
    ("runs", "counted"),
    [
        ([run(1), run(2)], [1, 2]),
        ([run(1, was=True)], [1]),
        ([run(1, was=True), run(2, 1, state="queued", was=None)], [1, 2]),
        ([run(1, was=True), run(2, 1)], [2]),
        ([run(1, was=True), run(2, 1, was=None)], [2]),
        ([run(1, was=True), run(2, 1, state="failed")], [2]),
        ([run(1, was=True), run(2, 1, state="cancelled", was=None)], [1, 2]),
        ([run(1, was=True), run(2, 1, was=True), run(3, 2, was=True)], [3]),
        ([run(1, was=True), run(2), run(3, 1, was=True), run(4, 3)], [2, 4]),
        ([run(1, state="failed"), run(2, 1, was=True)], [1, 2]),
        ([run(5, 2, was=True)], [5]),
    ],
)
def test_each_place_of_a_cell_counts_once(runs: list[CellRun], counted: list[int]) -> None:
    assert [entry.id for entry in counted_runs(runs)] == counted
