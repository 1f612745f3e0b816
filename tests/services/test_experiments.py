"""The life of an experiment: previewed, stored, watched, paused, cancelled, tried again, repeated."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import text

from slamhive.base.errors import Conflict, Forbidden, InvalidInput, NotFound, SlamHiveError, Unavailable
from slamhive.base.files import size_bytes
from slamhive.base.settings import Mode
from slamhive.cli.demo import DemoPhase as BuildPhase
from slamhive.cli.demo import Phases, buildable, describe_end
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.run import RunState
from slamhive.domain.verdict import Outcome
from slamhive.services.experiments import previewing
from slamhive.services.experiments.context import (
    GUESSED_BUILD_S,
    GUESSED_EVALUATION_S,
    GUESSED_OVERHEAD_S,
    GUESSED_START_S,
)
from slamhive.services.experiments.previewing import NODE_BYTES_PER_S
from slamhive.services.experiments.views import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.store import Lease, RunRecord
from tests.services.conftest import opened_hive

pytestmark = pytest.mark.integration

SIX = """\
name: six
algorithms: tiny
datasets: track
parameters:
  behaviour: good | crash
  seconds: 0 | 0.01 | 0.02
stop_when: {time_s: 30}
priority: 3
"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, sqlite_template: Path) -> Iterator[Hive]:
    """An installation in which the experiment has run. Tests leave it as it is."""
    folder = tmp_path_factory.mktemp("finished")
    with pytest.MonkeyPatch.context() as patch, opened_hive(folder, patch, sqlite_template) as hive:
        hive.experiments.start(source())
        work(hive)
        yield hive


def source(text: str = SIX) -> ExperimentSource:
    return ExperimentSource(text, "six.yaml")


def work(hive: Hive) -> None:
    hive.worker().run(until_idle=True)


def counts(hive: Hive, name: str = "six") -> dict[str, int]:
    return {phase.value: count for phase, count in hive.experiments.status(name).counts.items() if count}


def rows(hive: Hive, table: str) -> int:
    return int(hive.store.read(lambda t: t.database.execute(text(f"SELECT count(*) FROM {table}")).scalar_one()))


def runs_of(hive: Hive) -> tuple[RunRecord, ...]:
    return hive.store.read(lambda t: t.runs.get_many(hive.experiments.run_ids("six")))


def everything(hive: Hive) -> dict[str, int]:
    tables = ("experiments", "experiment_cells", "runs", "run_events", "configurations", "configuration_values")
    return {table: rows(hive, table) for table in tables}


def test_the_time_left_of_the_demo_counts_no_build_that_is_over(hive: Hive) -> None:
    """Its first steps build all packages, so the last one begins with what the preview of six runs says."""
    phases = Phases([BuildPhase("building tiny", 1.0, "build")])
    assert buildable(hive, "process", ["tiny"], phases) == ["tiny"]
    started = hive.experiments.start(source())
    between_s = GUESSED_OVERHEAD_S + GUESSED_EVALUATION_S
    assert started.left_s == pytest.approx(6 * (10.0 + GUESSED_START_S + between_s))
    assert (started.low_s, started.high_s) == (None, None), "only the length of the recording is known"


def test_the_demo_says_of_each_run_its_error_or_why_it_has_none(finished: Hive) -> None:
    runs = [finished.runs.get(run.id) for run in runs_of(finished)]
    good = next(run for run in runs if run.metrics)
    crashed = next(run for run in runs if run.state is RunState.FAILED)
    begin = f"run {good.id}: tiny succeeded, {good.poses} poses, "
    assert re.fullmatch(rf"{begin}ATE RMSE \d\.\d{{4}} m", describe_end(good, None))
    lost = replace(good, metrics=None)
    assert describe_end(lost, "only 2 poses match") == f"{begin}not evaluated: only 2 poses match"
    assert describe_end(lost, None) == f"{begin}not evaluated"
    assert crashed.detail
    assert describe_end(crashed, None) == f"run {crashed.id}: tiny failed, {crashed.poses or 0} poses, {crashed.detail}"


def test_a_preview_tells_what_would_happen_and_stores_nothing(hive: Hive) -> None:
    found = hive.experiments.preview(source(SIX.replace("priority: 3", "repeats: 2")))
    assert (found.cells, found.runs, found.known_cells, found.known_runs) == (6, 12, 0, 0)
    assert found.axes == {"behaviour": 2, "seconds": 3}
    assert [row.name for row in found.rows] == [f"six-{number:04d}" for number in range(1, 7)]
    assert dict(found.rows[1].values, playback_mode=0, playback_rate=0) == {
        "algorithm": "tiny",
        "dataset": "track",
        "behaviour": "good",
        "seconds": 0.01,
        "playback_mode": 0,
        "playback_rate": 0,
    }
    between_s = GUESSED_OVERHEAD_S + GUESSED_EVALUATION_S
    assert found.between_s == between_s
    guessed_s = 12 * (10.0 + GUESSED_START_S + between_s) + GUESSED_BUILD_S
    assert found.time_s == pytest.approx(guessed_s), "nothing has run, so the recording's length counts"
    assert hive.experiments.preview(source(f"{SIX}evaluate: false\n")).between_s == GUESSED_OVERHEAD_S
    assert found.measured_runs == 0
    assert found.refusals == ()
    assert set(everything(hive).values()) == {0}
    assert not hive.settings.experiments_folder.exists()


def test_a_preview_knows_what_is_stored_and_how_long_it_took(finished: Hive) -> None:
    found = finished.experiments.preview(source(SIX.replace("name: six", "name: seven").replace("0.02", "0.03")))
    assert (found.known_cells, found.known_runs, found.measured_runs) == (4, 4, 6)
    overhead, evaluation = finished.store.read(lambda t: (t.durations.overhead(), t.durations.evaluation()))
    assert overhead is not None
    assert evaluation is not None
    assert found.between_s == pytest.approx(overhead.seconds + evaluation.seconds)
    assert found.build_time_s == 0
    assert 6 * found.between_s < found.time_s < 6 * (10.0 + found.between_s)
    assert found.standing is None
    assert finished.experiments.preview(source()).standing == ConfigurationStanding.FINISHED


def test_a_plan_for_a_cluster_counts_the_data_of_each_node(hive: Hive) -> None:
    recording_bytes = size_bytes(hive.catalogue.dataset("track").bag_path)
    for nodes, used in ((4, 3), (9, 6)):  # on four nodes, two runs on each of three end as early with less data
        found = hive.experiments.preview(source(), nodes=nodes)
        assert found.cluster is not None
        assert (found.slots, found.cluster.nodes, found.cluster.used_nodes) == (nodes, nodes, used)
        assert (found.cluster.moved_bytes, found.cluster.node_bytes) == (used * recording_bytes, recording_bytes)
        run_s = 10.0 + GUESSED_START_S + found.between_s
        transfer_s = recording_bytes / NODE_BYTES_PER_S
        assert found.cluster.time_s == pytest.approx(math.ceil(6 / nodes) * run_s + transfer_s)
        assert found.time_s == pytest.approx(found.cluster.time_s + GUESSED_BUILD_S / nodes)


def test_starting_stores_cells_and_runs_with_all_that_the_file_says(hive: Hive) -> None:
    done: list[tuple[int, int]] = []
    status = hive.experiments.start(source(), progress=lambda *now: done.append(now))
    assert done[-1] == (6, 6)
    assert (status.state, status.cells, status.runs, status.missing) == (ConfigurationStanding.ACTIVE, 6, 6, 0)
    runs = runs_of(hive)
    assert len(runs) == 6
    for run in runs:
        assert (run.experiment, run.priority, run.stop_when.time_s, run.held) == ("six", 3, 30.0, False)
        assert run.affinity
    assert sorted(run.cell or 0 for run in runs) == [1, 2, 3, 4, 5, 6]


def test_it_runs_and_tells_every_cell(finished: Hive) -> None:
    status = finished.experiments.status("six")
    assert status.state is ConfigurationStanding.FINISHED
    assert counts(finished) == {"good": 3, "failed": 3}
    assert status.failures == {"nonzero_exit": 3}
    assert (status.left_s, status.low_s, status.high_s) == (0.0, 0.0, 0.0)
    cells = list(finished.experiments.report("six"))
    assert [cell.number for cell in cells] == [1, 2, 3, 4, 5, 6]
    for cell in cells:
        good = cell.values["behaviour"] == "good"
        assert cell.counts[Outcome.GOOD if good else Outcome.FAILED] == 1
        assert bool(cell.figures) == good
        if good:
            (figures,) = cell.figures
            assert figures.protocol is not None
            assert figures.metrics["ate.rmse"].n == 1
            assert figures.metrics["ate.rmse"].std is None
            assert 0 <= figures.metrics["ate.rmse"].mean < 0.1


def test_figures_of_different_protocols_stay_apart(hive: Hive) -> None:
    one = SIX.replace("good | crash", "good").replace("0 | 0.01 | 0.02", "0")
    hive.experiments.start(source(one.replace("priority: 3", "repeats: 2")))
    work(hive)
    first = hive.experiments.cells("six", limit=1).cells[0].runs[0]
    hive.evaluations.queue([first.id], "sim3")
    work(hive)
    figures = hive.experiments.cells("six", limit=1).cells[0].figures
    protocols = {hive.runs.get(run.id).protocol for run in hive.experiments.cells("six", limit=1).cells[0].runs}
    assert len(figures) == len(protocols)
    assert sum(entry.runs for entry in figures) == 2


def test_pages_of_cells_and_the_grid(finished: Hive) -> None:
    page = finished.experiments.cells("six", limit=4)
    assert ([cell.number for cell in page.cells], page.total, page.next_number) == ([1, 2, 3, 4], 6, 4)
    rest = finished.experiments.cells("six", after=4, limit=4)
    assert ([cell.number for cell in rest.cells], rest.next_number) == ([5, 6], None)
    grid = finished.experiments.grid("six", "behaviour", "seconds")
    assert (grid.rows, grid.columns) == (("good", "crash"), (0.0, 0.01, 0.02))
    assert {place: cell.counts[Outcome.GOOD] for place, cell in grid.cells.items()} == {
        (row, column): int(row == 0) for row in range(2) for column in range(3)
    }
    with pytest.raises(NotFound, match=r"unknown axis of experiment six 'second'.*seconds"):
        finished.experiments.grid("six", "behaviour", "second")
    assert list(finished.experiments.axes("six")) == [
        "algorithm",
        "dataset",
        "behaviour",
        "seconds",
        "playback_mode",
        "playback_rate",
    ]


def test_the_same_file_twice_is_one_experiment(hive: Hive) -> None:
    hive.experiments.start(source())
    before = everything(hive)
    hive.experiments.start(source("# a remark\n" + SIX))
    assert everything(hive) == before


def test_a_file_that_has_run_is_not_run_again(finished: Hive) -> None:
    before = everything(finished)
    finished.experiments.start(source())
    assert everything(finished) == before


def test_a_name_that_is_taken_is_refused_with_its_place(hive: Hive) -> None:
    hive.experiments.start(source())
    before = everything(hive)
    other = source(SIX.replace("0.02", "0.03"))
    with pytest.raises(Conflict, match=r"six.yaml line 1: experiment six exists already"):
        hive.experiments.start(other)
    assert "exists already with other content" in hive.experiments.preview(other).refusals[0]
    assert everything(hive) == before


@pytest.mark.parametrize(
    ("change", "error"),
    [
        (lambda text: "", "six.yaml"),
        (lambda text: text.replace("track", "trakc"), r"six.yaml line 3: unknown dataset 'trakc'"),
        (lambda text: text.replace("tiny", "tinny"), r"six.yaml line 2: unknown algorithm"),
        (
            lambda text: text.replace("0 | 0.01 | 0.02", "lin(0, 1, 100000)").replace("priority: 3", "seeds: 1:10000"),
            r"1,000,000",
        ),
        (lambda text: text + "where: seconds > 5\n", r"six.yaml line 9: .* removes every combination"),
        (lambda text: text + "executor: dokcer\n", r"dokcer"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_stored(hive: Hive, change, error) -> None:
    with pytest.raises(SlamHiveError, match=error):
        hive.experiments.start(source(change(SIX)))
    assert set(everything(hive).values()) == {0}
    assert not hive.settings.experiments_folder.exists()


def test_more_disk_than_there_is_is_refused(hive: Hive, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(previewing, "UNMEASURED_RUN_BYTES", 10**15)
    with pytest.raises(Unavailable, match=r"six.yaml line 1: the experiment needs .* MB free"):
        hive.experiments.start(source())
    assert "needs" in hive.experiments.preview(source()).refusals[0]
    assert set(everything(hive).values()) == {0}


def test_a_recording_that_is_gone_is_refused(hive: Hive) -> None:
    (hive.settings.datasets_folder / "track" / "track.bag").unlink()
    with pytest.raises(InvalidInput, match=r"six.yaml line 3: dataset track lacks its recording"):
        hive.experiments.start(source())
    assert set(everything(hive).values()) == {0}


def test_a_broken_package_is_told_with_its_reason(hive: Hive) -> None:
    (hive.catalogue.project_root / "algorithms" / "tiny" / "algorithm.yaml").write_text("format: 1\n")
    with pytest.raises(InvalidInput, match=r"six.yaml line 2: algorithm 'tiny' cannot be used"):
        hive.experiments.start(source())


def test_paused_runs_are_not_taken_and_resumed_ones_are(hive: Hive) -> None:
    hive.experiments.start(source())
    assert hive.experiments.pause("six").state is ConfigurationStanding.PAUSED
    assert all(run.held for run in runs_of(hive))
    work(hive)
    assert counts(hive) == {"queued": 6}
    assert hive.experiments.resume("six").state is ConfigurationStanding.ACTIVE
    work(hive)
    assert counts(hive) == {"good": 3, "failed": 3}
    with pytest.raises(Conflict, match="has finished"):
        hive.experiments.pause("six")


def test_pausing_lets_the_running_one_end(hive: Hive) -> None:
    hive.experiments.start(source())
    now = hive.runs.get(1).created_at
    claimed = hive.store.write(lambda t: t.queue.claim(Lease("someone", now, 1e6)))
    assert claimed is not None
    hive.experiments.pause("six")
    run = hive.runs.get(claimed.id)
    assert (run.state, run.cancel_requested) == (RunState.PREPARING, False)
    assert counts(hive) == {"queued": 5, "running": 1}
    hive.store.write(lambda t: t.runs.move(run.id, RunState.QUEUED, why="given back", now=now))
    assert hive.store.write(lambda t: t.queue.claim(Lease("other", now, 1.0))) is None, "given back, it is on hold"


def test_cancelling_ends_what_waits_and_asks_what_runs(hive: Hive) -> None:
    hive.experiments.start(source())
    now = hive.runs.get(1).created_at
    claimed = hive.store.write(lambda t: t.queue.claim(Lease("someone", now, 1e6)))
    assert claimed is not None
    status = hive.experiments.cancel("six")
    assert status.state is ConfigurationStanding.CANCELLED
    assert counts(hive) == {"cancelled": 5, "running": 1}
    assert hive.runs.get(claimed.id).cancel_requested
    (cancelled,) = {run.id for run in runs_of(hive) if run.cell == 6}
    assert [event.to_state for event in hive.runs.events(cancelled)] == [
        RunState.QUEUED,
        RunState.CANCELLED,
    ]
    for change in (hive.experiments.cancel, hive.experiments.resume, hive.experiments.retry_failed):
        with pytest.raises(Conflict, match="experiment six was cancelled"):
            change("six")
    with pytest.raises(Conflict, match=r"experiment six was cancelled.*another name"):
        hive.experiments.start(source())


def test_failed_runs_are_tried_again_once(hive: Hive) -> None:
    hive.experiments.start(source())
    work(hive)
    assert hive.experiments.retry_failed("six") == 3
    assert hive.experiments.retry_failed("six") == 0
    status = hive.experiments.status("six")
    assert (counts(hive), status.retried) == ({"good": 3, "queued": 3}, 3)
    retries = [run for run in runs_of(hive) if run.state is RunState.QUEUED]
    for run in retries:
        old = hive.runs.get(run.retry_of or 0)
        assert (run.cell, run.stop_when, run.affinity, run.seed) == (old.cell, old.stop_when, old.affinity, old.seed)
    work(hive)
    assert hive.experiments.retry_failed("six") == 3, "they have failed again"
    cell = next(cell for cell in hive.experiments.report("six") if cell.values["behaviour"] == "crash")
    assert (cell.failures, len(cell.runs)) == ({"nonzero_exit": 2}, 3), "failures are never forgotten"


def test_a_retry_in_a_paused_experiment_waits_with_the_others(hive: Hive) -> None:
    hive.experiments.start(source(SIX.replace("0 | 0.01 | 0.02", "0")))
    while counts(hive) != {"queued": 1, "failed": 1} and counts(hive) != {"queued": 1, "good": 1}:
        first = min(run.id for run in runs_of(hive) if run.state is RunState.QUEUED)
        hive.worker(only=[first]).run(until_idle=True)
    hive.experiments.pause("six")
    ended = next(run for run in runs_of(hive) if run.state.ended)
    assert hive.runs.retry(ended.id).held


def test_the_time_left_has_an_interval_as_soon_as_a_run_has_ended(hive: Hive) -> None:
    hive.experiments.start(source())
    first = min(run.id for run in runs_of(hive))
    hive.worker(only=[first]).run(until_idle=True)
    status = hive.experiments.status("six")
    assert status.ended == 1
    assert status.left_s is not None
    assert status.low_s is not None
    assert status.high_s is not None
    assert 0 < status.low_s < status.left_s < status.high_s


def test_more_repeats_are_the_same_as_asked_for_at_once(hive: Hive) -> None:
    two_seeds = SIX.replace("priority: 3", "seeds: 4 | 7")
    hive.experiments.start(source(two_seeds))
    status = hive.experiments.add_repeats("six", 2)
    assert (status.repeats, status.runs, counts(hive)) == (3, 36, {"queued": 36})
    runs = runs_of(hive)
    assert Counter((run.cell, run.seed) for run in runs) == {(cell, seed): 3 for cell in range(1, 7) for seed in (4, 7)}
    hive.experiments.start(source(two_seeds))
    assert rows(hive, "runs") == 36
    with pytest.raises(InvalidInput, match="998 more repeats are not allowed, six has 3"):
        hive.experiments.add_repeats("six", 998)


def test_an_algorithm_that_is_gone_keeps_its_results_and_gets_no_more_runs(finished: Hive, tmp_path: Path) -> None:
    package = finished.catalogue.project_root / "algorithms" / "tiny"
    package.rename(tmp_path / "tiny")
    try:
        assert finished.experiments.status("six").counts[Outcome.GOOD] == 3
        assert len(list(finished.experiments.report("six"))) == 6
        with pytest.raises(NotFound, match="experiment six line 2: unknown algorithm 'tiny'"):
            finished.experiments.add_repeats("six", 1)
        assert (rows(finished, "runs"), finished.experiments.status("six").repeats) == (6, 1)
    finally:
        (tmp_path / "tiny").rename(package)


def test_an_algorithm_that_changed_while_storing_was_interrupted_is_told(hive: Hive) -> None:
    hive.experiments.start(source())
    record = hive.store.read(lambda t: t.experiments.get("six"))
    hive.store.write(lambda t: t.experiments.change(record.id, complete=False))
    path = hive.catalogue.project_root / "algorithms" / "tiny" / "algorithm.yaml"
    path.write_text(path.read_text() + "  more: {type: int, default: 5, unit: '', help: More.}\n")
    with pytest.raises(Conflict, match="six-0001 is another configuration now than the one stored"):
        hive.experiments.start(source())


def test_view_only_refuses_every_change(hive: Hive) -> None:
    hive.experiments.start(source())
    before = everything(hive)
    viewer = Hive(hive.settings.with_values({"mode": Mode.VIEW_ONLY}), hive.store, hive.project_root)
    viewer.experiments.preview(source())
    for change in (
        lambda: viewer.experiments.start(source(SIX.replace("name: six", "name: seven"))),
        lambda: viewer.experiments.pause("six"),
        lambda: viewer.experiments.resume("six"),
        lambda: viewer.experiments.cancel("six"),
        lambda: viewer.experiments.retry_failed("six"),
        lambda: viewer.experiments.add_repeats("six", 1),
    ):
        with pytest.raises(Forbidden, match="view-only"):
            change()
    assert everything(hive) == before
    assert hive.experiments.status("six").state is ConfigurationStanding.ACTIVE


def test_an_unknown_experiment_is_told_with_the_nearest(hive: Hive) -> None:
    hive.experiments.start(source())
    for look in (hive.experiments.status, hive.experiments.pause, hive.experiments.report, hive.experiments.cells):
        with pytest.raises(NotFound, match=r"unknown experiment 'sxi'.*six"):
            look("sxi")
    assert not (hive.settings.experiments_folder / "sxi").exists()
