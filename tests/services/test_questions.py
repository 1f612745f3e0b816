"""Experiments that choose their runs: from their file to the answer, through kills, failures and bad input."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.cli.questions import print_decision
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.metrics import metric
from slamhive.domain.question import CandidateStanding, QuestionAnswer
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from slamhive.services.deciding.look import STORING
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from slamhive.web.presenters import questions
from tests.services.gate_world import finish
from tests.web import web_world as world

pytestmark = pytest.mark.integration

TWO = """\
name: two
algorithms: eye-slam-stereo
datasets: room
parameters: {nFeatures: 1000 | 2000}
decide: {difference: 1 cm, budget: 80 runs}
executor: process
"""

Outcome = float | FailureReason


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


@pytest.fixture
def hive(tmp_path: Path, sqlite_template: Path) -> Iterator[Hive]:
    opened = world.make_hive(tmp_path, template=sqlite_template)
    yield opened
    opened.close()


def start(hive: Hive, text: str = TWO) -> None:
    hive.experiments.start(ExperimentSource(text, "two.yaml"))


def end(hive: Hive, outcome: Callable[[RunRecord], Outcome], name: str = "two") -> int:
    """End all queued runs of the experiment; returns how many there were."""
    waiting = hive.experiments.unfinished(name)
    for run_id in waiting:
        found = outcome(hive.runs.get(run_id))
        if isinstance(found, FailureReason):
            ends = (RunState.PREPARING, RunState.FAILED) if found is FailureReason.IMAGE_MISSING else _ENDS
            world.advance(hive, run_id, *ends, reason=found)
        else:
            finish(hive, run_id, found)
    return len(waiting)


_ENDS = (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING, RunState.FAILED)


def noisy(of: dict[int, float]) -> Callable[[RunRecord], float]:
    """Errors with a standard deviation of 1 cm around the mean of a number of features."""
    return lambda run: of[int(str(run.parameters["nFeatures"]))] + float(np.random.default_rng(run.id).normal(0, 0.01))


def play(hive: Hive, outcome: Callable[[RunRecord], Outcome], name: str = "two") -> None:
    """Let the experiment go on until it asks for nothing more."""
    while hive.questions.advance(name):
        end(hive, outcome, name)


def test_starting_stores_the_candidates_and_no_run(hive: Hive):
    start(hive)
    status = hive.experiments.status("two")
    assert (status.cells, status.runs, status.question, status.conclusion) == (2, 0, "decide", None)
    assert status.state is ConfigurationStanding.ACTIVE
    assert status.phase == "choosing the next runs"


def test_rounds_are_balanced_until_one_is_best(hive: Hive):
    start(hive)
    assert hive.questions.advance("two") == 4
    assert hive.questions.advance("two") == 0, "its runs are under way"
    end(hive, noisy({1000: 0.05, 2000: 0.09}))
    assert hive.questions.advance("two") == 2
    end(hive, noisy({1000: 0.05, 2000: 0.09}))
    play(hive, noisy({1000: 0.05, 2000: 0.09}))
    found = hive.questions.decision("two")
    assert found.answer is QuestionAnswer.BEST
    best, beaten = found.candidates
    assert (best.label, best.standing) == ("nFeatures 1000", CandidateStanding.BEST)
    assert (beaten.standing, beaten.beaten_by) == (CandidateStanding.BEATEN, "nFeatures 1000")
    assert best.runs == beaten.runs
    status = hive.experiments.status("two")
    assert status.conclusion == found.words
    assert status.conclusion.startswith("nFeatures 1000 is best in ATE RMSE with 0.0")
    assert status.state is ConfigurationStanding.FINISHED
    assert status.runs == found.runs < 80


def test_equal_candidates_end_without_a_difference_that_matters(hive: Hive):
    start(hive)
    play(hive, noisy({1000: 0.05, 2000: 0.05}))
    found = hive.questions.decision("two")
    assert found.answer is QuestionAnswer.SAME
    assert "no difference larger than 0.01 m" in found.words
    assert [entry.standing for entry in found.candidates] == [CandidateStanding.LEFT] * 2


def test_a_spent_budget_leaves_it_undecided(hive: Hive):
    start(hive, TWO.replace("80 runs", "12 runs"))
    play(hive, noisy({1000: 0.05, 2000: 0.051}))
    found = hive.questions.decision("two")
    assert (found.answer, found.runs) == (QuestionAnswer.UNDECIDED, 12)
    assert found.words.startswith("Undecided after the budget of 12 runs: nFeatures")
    (behind,) = [entry for entry in found.candidates if entry.difference]
    assert behind.difference_within is not None
    assert behind.difference_within > abs(behind.difference or 0)


def test_a_budget_of_time_counts_how_long_runs_took(hive: Hive):
    start(hive, TWO.replace("80 runs", "20 s") + "playback: {mode: sequential}\n")  # four runs of a few seconds each
    play(hive, noisy({1000: 0.05, 2000: 0.05}))
    found = hive.questions.decision("two")
    assert found.answer is QuestionAnswer.UNDECIDED
    assert 4 <= found.runs <= 12


def test_failed_runs_count_as_worst_and_nothing_is_shown_as_their_mean(hive: Hive, capsys: pytest.CaptureFixture[str]):
    start(hive)
    play(hive, lambda run: 0.05 if run.parameters["nFeatures"] == 1000 else FailureReason.LOST_TRACKING)
    found = hive.questions.decision("two")
    assert (found.answer, found.candidates[0].label) == (QuestionAnswer.BEST, "nFeatures 1000")
    failed = found.candidates[1].failed
    assert failed == found.candidates[1].runs > 0
    assert found.notes == (f"nFeatures 2000: {failed} of {failed} runs failed: lost tracking {failed}.",)
    assert (found.candidates[1].mean, found.candidates[1].difference) == (None, None)
    row = questions.rows(found, metric(found.metric))[1]
    assert isinstance(row, questions.CandidateRow)
    assert (row.mean.text, row.behind) == (f"failed: {failed} of {failed}", "–")
    print_decision(found)
    assert f"failed: {failed} of {failed}  " in capsys.readouterr().out


def test_runs_on_a_disturbed_machine_are_said(hive: Hive):
    start(hive)
    hive.questions.advance("two")
    busy = Disturbance(known=True, reasons=(DisturbanceReason(DisturbanceKind.OTHERS, "another program"),))
    run_ids = hive.experiments.unfinished("two")
    end(hive, noisy({1000: 0.05, 2000: 0.09}))
    hive.store.write(lambda t: t.runs.update(run_ids[0], disturbance=busy))
    (note,) = hive.questions.decision("two").notes
    assert note.startswith("1 of 4 runs ran on a disturbed machine, where frames may be lost.")


def test_lost_and_cancelled_runs_are_replaced_and_said(hive: Hive):
    start(hive)
    hive.questions.advance("two")
    first, second, *others = hive.experiments.unfinished("two")
    hive.runs.cancel(first)
    world.advance(hive, second, *_ENDS, reason=FailureReason.LOST)
    for run_id in others:
        finish(hive, run_id, 0.05)
    assert hive.questions.advance("two") == 2
    end(hive, lambda _run: 0.05)
    found = hive.questions.decision("two")
    assert found.notes == (
        "1 run cancelled by hand; others took their place.",
        "1 run lost, or evaluated under another protocol; others took their place.",
    )
    assert {entry.runs for entry in found.candidates} == {2}


def test_a_deleted_run_does_not_come_back(hive: Hive):
    start(hive)
    hive.questions.advance("two")
    end(hive, noisy({1000: 0.05, 2000: 0.06}))
    gone = hive.runs.get(hive.experiments.run_ids("two")[0])
    hive.trash.delete([gone.id])
    before = set(hive.experiments.run_ids("two"))
    assert hive.questions.advance("two") == 1
    (new,) = set(hive.experiments.run_ids("two")) - before
    assert hive.runs.get(new).uid != gone.uid


def test_a_candidate_that_cannot_be_built_is_set_aside(hive: Hive):
    start(hive, TWO.replace("1000 | 2000", "1000 | 2000 | 3000"))
    errors = noisy({1000: 0.05, 2000: 0.09})
    play(hive, lambda run: FailureReason.IMAGE_MISSING if run.parameters["nFeatures"] == 3000 else errors(run))
    found = hive.questions.decision("two")
    assert (found.answer, found.candidates[0].label) == (QuestionAnswer.BEST, "nFeatures 1000")
    assert found.candidates[-1].standing is CandidateStanding.ASIDE
    assert found.notes == ("nFeatures 3000 is set aside, because it cannot run: image missing.",)


def test_no_candidate_that_can_run_ends_it(hive: Hive):
    start(hive)
    play(hive, lambda _run: FailureReason.IMAGE_MISSING)
    assert hive.experiments.status("two").conclusion == "Undecided: no candidate can run: image missing."


def test_runs_that_all_fail_end_it_with_the_reason(hive: Hive):
    start(hive)
    play(hive, lambda _run: FailureReason.TIMEOUT)
    assert hive.experiments.status("two").conclusion == "Undecided: all 4 runs failed: timeout."


def test_a_metric_that_no_run_reports_ends_it(hive: Hive):
    start(hive, TWO.replace("difference: 1 cm", "metric: gpu.memory_max, difference: 5%"))
    play(hive, lambda _run: 0.05)
    assert hive.experiments.status("two").conclusion == (
        "Undecided: no run reports gpu.memory_max. Another metric can be compared."
    )


def test_an_interrupted_start_is_told_and_nothing_is_chosen_before_it_is_completed(hive: Hive):
    start(hive)
    record = hive.store.read(lambda t: t.experiments.get("two"))
    hive.store.write(lambda t: t.experiments.change(record.id, complete=False))
    assert hive.questions.decision("two").next == STORING
    assert (hive.questions.advance("two"), list(hive.questions.unfinished("two"))) == (0, [])
    assert hive.experiments.status("two").conclusion is None
    start(hive)
    assert hive.questions.advance("two") == 4


def test_a_paused_experiment_asks_for_nothing(hive: Hive):
    start(hive)
    hive.experiments.pause("two")
    assert hive.questions.advance("two") == 0
    hive.experiments.resume("two")
    assert hive.questions.advance("two") == 4


def test_two_that_choose_at_once_add_each_run_once(hive: Hive):
    start(hive)
    assert len(hive.experiments.ask_for_runs("two", {1: 1, 2: 1}, 0)) == 2
    assert hive.experiments.ask_for_runs("two", {1: 1, 2: 1}, 0) == []
    with hive.experiments.context.folder("two").locked(), pytest.raises(Conflict, match="another process"):
        hive.experiments.ask_for_runs("two", {1: 1}, 2)


def test_a_worker_takes_undecided_experiments_further(hive: Hive):
    start(hive)
    assert hive.questions.work_once()
    assert not hive.questions.work_once()
    assert len(hive.experiments.unfinished("two")) == 4


def test_a_new_database_goes_on_where_the_folders_end(hive: Hive, tmp_path: Path, sqlite_template: Path):
    start(hive)
    play(hive, noisy({1000: 0.05, 2000: 0.09}))
    conclusion = hive.experiments.status("two").conclusion
    start(hive, TWO.replace("name: two", "name: other"))
    hive.close()
    (tmp_path / "data" / "slamhive.db").unlink()
    again = world.make_hive(tmp_path, template=sqlite_template)
    try:
        assert [restored.problem for restored in again.experiments.restore_rows()] == [None, None]
        assert [restored.queued for restored in again.experiments.restore_runs()] == [0, 0]
        assert again.experiments.status("two").conclusion == conclusion
        assert again.questions.advance("other") == 4
    finally:
        again.close()


def test_a_preview_tells_the_budget_and_what_would_be_refused(hive: Hive):
    found = hive.experiments.preview(ExperimentSource(TWO))
    chooses = "the experiment chooses itself which of these run, and how often, within its budget of 80 runs"
    assert chooses in found.warnings
    small = hive.experiments.preview(ExperimentSource(TWO.replace("80 runs", "3 runs")))
    assert any("too small for one look" in refusal for refusal in small.refusals)


def test_no_repeats_are_added_by_hand(hive: Hive):
    start(hive)
    with pytest.raises(Conflict, match="two chooses its runs itself"):
        hive.experiments.add_repeats("two", 1)


def test_an_experiment_without_a_question_has_no_decision(hive: Hive):
    start(hive, TWO.replace("decide: {difference: 1 cm, budget: 80 runs}\n", ""))
    with pytest.raises(InvalidInput, match="two has no question: it runs all of its combinations"):
        hive.questions.decision("two")


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (TWO.replace("80 runs", "3 runs"), "budget of 3 runs is too small for one look: .* are 4"),
        (
            TWO.replace("80 runs", "2 min"),
            "2 runs of each of 2 candidates on 1 dataset take 2.667 min or more; raise it",
        ),
        (TWO.replace("1000 | 2000", "1000"), "nothing to choose: eye-slam-stereo is the only candidate"),
        (TWO.replace("1 cm", "1 kg"), "'1 kg' is no value of ate.rmse; write a number and one of mm, cm, m, km"),
        (TWO.replace("1 cm", "0"), "'?0.*'? is no difference"),
        (TWO.replace("80 runs", "soon"), "two.yaml line 5: budget 'soon' is not clear"),
        (TWO.replace("difference", "metric: ate.rsme, difference"), "two.yaml line 5: .*ate.rsme.*did you mean"),
        (TWO.replace("difference", "metric: poses, difference"), "no direction of poses is better"),
        (TWO.replace("executor: process", "repeats: 3"), "two.yaml line 6: the experiment decides how often"),
        (TWO.replace("executor: process", "evaluate: false"), "ate.rmse comes from an evaluation"),
        (
            TWO.replace("algorithms: eye-slam-stereo", "algorithms: eye-slam-stereo | eye-slam-mono"),
            "on room, 1 run uses SE.3., 1 Sim.3.: not comparable; to evaluate all under Sim.3., add to the file",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(hive: Hive, text: str, problem: str):
    with pytest.raises((InvalidInput, NotFound), match=problem) as caught:
        start(hive, text)
    assert "\n" not in str(caught.value)
    assert hive.experiments.list() == ()
    assert not hive.settings.experiments_folder.exists()
