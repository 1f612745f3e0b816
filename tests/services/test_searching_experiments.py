"""Experiments that search their combinations: from the file to the sentence at the end."""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slamhive.analysis import optuna_sampling
from slamhive.base.errors import InvalidInput, NotFound, Unavailable
from slamhive.documents.experiment import SearchStanding
from slamhive.domain.dataset import Dataset
from slamhive.domain.question import QuestionAnswer
from slamhive.domain.run import FailureReason
from slamhive.experiments.file import parse_experiment
from slamhive.recordings import reader
from slamhive.services.deciding import optimise
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource, starting
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
from tests.services.gate_world import finish
from tests.services.test_questions import Outcome, end, play
from tests.web import web_world as world

pytestmark = pytest.mark.integration

MANY = """\
name: many
algorithms: eye-slam-stereo
datasets: room
parameters: {nFeatures: 500:3000:500, scale: 1.1 | 1.2 | 1.3 | 1.4 | 1.5 | 1.6, solver: lm | gn}
optimise: {budget: 90 runs, within: 10%}
executor: process
"""


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    # The first places follow from the id of the experiment. A random one would make another search in each test run.
    monkeypatch.setattr(starting, "uuid", SimpleNamespace(uuid4=lambda: uuid.UUID(int=7 << 120)))


@pytest.fixture
def hive(tmp_path: Path, sqlite_template: Path) -> Iterator[Hive]:
    opened = world.make_hive(tmp_path, template=sqlite_template)
    yield opened
    opened.close()


def start(hive: Hive, text: str = MANY) -> None:
    hive.experiments.start(ExperimentSource(text, "many.yaml"))


def error_m(run: RunRecord) -> float:
    """The true typical error: 5 cm at 1500 features and a scale of 1.3, and 30 % more with the other solver."""
    features, scale = (float(str(run.parameters[key])) for key in ("nFeatures", "scale"))
    bent = ((features - 1500) / 1000) ** 2 + (10 * (scale - 1.3)) ** 2 / 5
    return 0.05 * math.exp(0.5 * bent) * (1.3 if run.parameters["solver"] == "gn" else 1.0)


def noisy(run: RunRecord) -> float:
    return error_m(run) * math.exp(0.05 * np.random.default_rng(run.id).standard_normal())


def very_noisy(run: RunRecord) -> float:
    return error_m(run) * math.exp(np.random.default_rng(run.id).normal(0, 0.5))


def searched(hive: Hive, outcome: Callable[[RunRecord], Outcome] = noisy) -> SearchStanding:
    play(hive, outcome, "many")
    return hive.questions.search("many")


def value(found: float | None) -> float:
    assert found is not None
    return found


def test_a_search_ends_near_the_best_with_few_runs(hive: Hive):
    start(hive)
    assert hive.questions.advance("many") == 24
    assert hive.questions.search("many").words == "Nothing is known yet."
    end(hive, noisy, "many")
    found = searched(hive)
    assert found.answer is QuestionAnswer.BEST
    assert found.runs < 90 > found.combinations / 2
    best = found.candidates[0].values
    assert (best["solver"], best["nFeatures"], best["scale"]) == ("lm", 1500, 1.3)
    assert found.gap is not None
    assert found.gap <= 0.1
    assert found.words == hive.experiments.status("many").conclusion
    assert found.words.startswith(
        f"After {found.runs} runs of 72 combinations, nFeatures 1500, scale 1.3, solver lm is within"
    )
    assert found.words.endswith("m.")
    assert {entry.axis for entry in found.importance} == {"nFeatures", "scale", "solver"}


def test_a_spent_budget_says_how_near_it_came(hive: Hive):
    start(hive, MANY.replace("90 runs", "30 runs").replace("10%", "0.1%"))
    found = searched(hive, very_noisy)
    assert (found.answer, found.runs) == (QuestionAnswer.UNDECIDED, 30)
    assert "within" in found.words
    assert found.expected_gain is not None


def test_what_fails_is_not_the_best(hive: Hive):
    start(hive)
    found = searched(hive, lambda run: FailureReason.TIMEOUT if run.parameters["solver"] == "lm" else noisy(run))
    assert found.candidates[0].values["solver"] == "gn"
    assert all(entry.failing < 0.5 for entry in found.candidates[:3])
    assert all((entry.expected is None) == (0 < entry.runs == entry.failed) for entry in found.candidates)


def test_a_run_that_breaks_a_limit_counts_as_failed(hive: Hive):
    start(hive, MANY.replace("within: 10%", 'within: 10%, limits: ["cpu.mean <= 0.1"]'))
    found = searched(hive)
    assert found.answer is QuestionAnswer.UNDECIDED
    assert found.words.startswith("Undecided: no run kept cpu.mean <= 0.1 cores; the nearest is nFeatures")


def test_a_limit_that_one_run_kept_is_told_with_the_nearest_of_the_others(hive: Hive):
    start(
        hive, MANY.replace("within: 10%", 'within: 10%, limits: ["ate.per_path <= 0.1"]').replace("90 runs", "24 runs")
    )
    hive.questions.advance("many")
    lucky, *_ = hive.experiments.unfinished("many")
    end(hive, lambda run: 0.04 if run.id == lucky else 0.06 + run.id / 1000, "many")
    words = searched(hive).words
    assert words.startswith(
        "Undecided: only 1 of 24 runs kept ate.per_path <= 0.1 %; the nearest of the others is nFeatures"
    )


def test_an_objective_that_no_run_reports_ends_it_after_the_first_runs(hive: Hive):
    start(hive, MANY.replace("within: 10%", "within: 10%, against: gpu.memory_max"))
    found = searched(hive)
    assert found.words == "Undecided: no run reports gpu.memory_max. Another metric can be searched for."
    assert found.runs == 24


def test_runs_that_all_fail_end_with_the_budget(hive: Hive):
    start(hive, MANY.replace("90 runs", "26 runs"))
    found = searched(hive, lambda _run: FailureReason.TIMEOUT)
    assert found.words == "Undecided: fewer than two of 26 runs were good."


def test_a_trial_that_is_cancelled_takes_no_part(hive: Hive):
    start(hive)
    hive.questions.advance("many")
    gone = hive.experiments.unfinished("many")[0]
    hive.runs.cancel(gone)
    found = searched(hive)
    assert found.notes[0].startswith("Cancelled by hand, and takes no part: nFeatures")


def test_an_algorithm_that_cannot_be_built_takes_no_part(hive: Hive):
    text = MANY.replace("eye-slam-stereo", "eye-slam-stereo | eye-slam-mono").replace("90 runs", "30 runs")
    start(hive, text + "evaluate: {alignment: sim3}\n")
    found = searched(
        hive,
        lambda run: FailureReason.IMAGE_MISSING if run.algorithm == "eye-slam-mono" else noisy(run),
    )
    assert found.notes == ("eye-slam-mono cannot be built, and takes no part.",)
    assert {entry.values["algorithm"] for entry in found.candidates} == {"eye-slam-stereo"}


TRADED = MANY.replace("within: 10%", "within: 10%, against: [cpu.mean, failed]")


def test_several_objectives_end_with_the_best_trade_offs(hive: Hive):
    start(hive, TRADED.replace("90 runs", "40 runs"))
    found = searched(hive, lambda run: FailureReason.TIMEOUT if run.parameters["solver"] == "gn" else noisy(run))
    assert [other.metric for other in found.against] == ["cpu.mean", "failed"]
    assert found.gap is not None
    assert all(entry.on_front and entry.values["solver"] == "lm" for entry in found.candidates)
    best = found.candidates[0]
    assert best.expected == min(value(entry.expected) for entry in found.candidates)
    assert set(best.against) == {"cpu.mean", "failed"}
    failed = best.against["failed"]
    assert 0 <= value(failed.low) <= value(failed.high) <= 1
    assert {entry.objective for entry in found.importance} == {"ate.rmse", "cpu.mean", "failed"}


def test_the_answer_of_several_objectives_names_the_ends_of_the_front(hive: Hive):
    start(hive, TRADED.replace("90 runs", "30 runs").replace("10%", "0.1%"))
    hive.questions.advance("many")
    end(hive, very_noisy, "many")
    untried = [entry.label for entry in hive.questions.search("many").candidates if not entry.runs]
    assert untried
    next_ones = hive.questions.search("many").next
    assert next_ones.endswith("it seems to be the best, and has too few runs.")
    assert any(label in next_ones for label in untried)
    found = searched(hive, very_noisy)
    assert found.answer is QuestionAnswer.UNDECIDED
    assert found.words.startswith("After 30 runs of 72 combinations, ")
    assert ("best trade-offs of ATE RMSE against CPU mean and failed runs" in found.words) or (
        "is the best in everything" in found.words
    )


def test_it_is_told_how_the_best_grew(hive: Hive):
    start(hive, MANY.replace("90 runs", "52 runs").replace("10%", "0.1%"))
    found = searched(hive, very_noisy)
    assert [step.runs for step in found.growth] == [24, 48, 52]
    assert found.growth[-1].gap == found.gap
    assert found.growth[-1].front == ({"ate.rmse": found.candidates[0].expected},)


def test_other_runs_are_asked_for_when_half_of_the_places_are_free(hive: Hive):
    start(hive)
    hive.questions.advance("many")
    end(hive, very_noisy, "many")
    assert hive.questions.advance("many") == 4
    first, second, *_ = hive.experiments.unfinished("many")
    finish(hive, first, 0.06)
    assert hive.questions.advance("many") == 0
    assert not hive.questions.work_once()
    finish(hive, second, 0.06)
    assert hive.questions.work_once()
    left = hive.experiments.unfinished("many")
    assert len(left) == 4
    for run_id in left[:2]:
        finish(hive, run_id, 0.06)
    assert hive.questions.work_once(), "as many wait as before, and they are others"
    assert not hive.questions.work_once()


def test_no_candidate_is_best_of_which_a_run_has_failed_where_none_may(hive: Hive):
    start(hive, MANY.replace("within: 10%", 'within: 10%, limits: ["failed = 0"]').replace("90 runs", "36 runs"))
    found = searched(hive, lambda run: FailureReason.TIMEOUT if run.parameters["solver"] == "lm" else noisy(run))
    assert found.limits == ("failed <= 0",)
    assert found.candidates[0].values["solver"] == "gn"
    assert found.candidates[0].failed == 0


def test_the_model_is_fitted_once_for_the_same_runs(hive: Hive, monkeypatch: pytest.MonkeyPatch):
    start(hive)
    hive.questions.advance("many")
    end(hive, noisy, "many")
    first = hive.questions.search("many")
    monkeypatch.setattr(optimise, "search", lambda *_: pytest.fail("the model is fitted again"))
    assert hive.questions.search("many") is first


def test_first_looks_rank_and_only_whole_runs_answer(hive: Hive):
    start(hive, MANY.replace("90 runs", "40 runs, first_look: 1 s, keep: 50%"))
    assert hive.questions.advance("many") == 48
    assert hive.questions.search("many").next == "48 runs under way."
    assert hive.questions.advance("many") == 0
    looks = [hive.runs.get(run) for run in hive.experiments.unfinished("many")]
    assert {step.kind for run in looks for step in run.variant} == {"clip"}
    end(hive, lambda run: 3 * error_m(run), "many")  # as good a ranking, but another error
    assert hive.questions.search("many").next == "The best of the first looks."
    assert hive.questions.advance("many") == 24
    followed = [hive.runs.get(run) for run in hive.experiments.unfinished("many")]
    assert not any(run.variant for run in followed)
    assert sorted(map(error_m, followed)) == pytest.approx(sorted(map(error_m, looks))[:24])
    end(hive, noisy, "many")
    found = searched(hive, lambda run: 3 * error_m(run) if run.variant else noisy(run))
    assert found.runs <= 40
    assert found.first_looks >= 48
    assert found.words.startswith(
        f"After {found.runs} runs of 72 combinations and {found.first_looks} first looks, nFeatures "
    )
    assert value(found.candidates[0].expected) < 0.1 < 3 * 0.05, "no clip is better than 15 cm"
    (ranking,) = hive.experiments.rankings("many")
    assert not any("first_look" in ranked.cell.values for ranked in (*ranking.best, *ranking.worst))
    assert ranking.best[0].good is not None
    assert ranking.best[0].good.mean < 0.1


def test_each_recording_is_opened_once_for_first_looks(hive: Hive, monkeypatch: pytest.MonkeyPatch):
    opened: list[str] = []
    read = reader.recording_begin_s

    def opening(dataset: Dataset) -> float:
        opened.append(dataset.name)
        return read(dataset)

    monkeypatch.setattr(reader, "recording_begin_s", opening)
    text = MANY.replace("eye-slam-stereo", "eye-slam-stereo | eye-slam-mono")
    text = text.replace("90 runs", "90 runs, first_look: 1 s")
    hive.experiments.context.expand(parse_experiment(text, "many.yaml"))
    assert opened == ["room"]


def test_a_plan_tells_first_looks_and_whole_recordings_apart(hive: Hive):
    plain = hive.experiments.preview(ExperimentSource(MANY))
    looked = hive.experiments.preview(ExperimentSource(MANY.replace("90 runs", "90 runs, first_look: 1 s")))
    assert (plain.combinations, plain.cells, plain.first_looks) == (72, 72, 0)
    assert (looked.combinations, looked.cells, looked.first_looks) == (72, 144, 72)
    assert plain.time_s < looked.time_s < 1.5 * plain.time_s, "a clip of 1 s of 40 s takes little time"


def test_first_looks_leave_time_for_the_runs_that_follow_them(hive: Hive):
    start(hive, MANY.replace("90 runs", "3 min, first_look: 15 s, keep: 25%"))
    assert hive.questions.advance("many") == 4, "nobody knows yet how long a look takes"
    end(hive, noisy, "many")
    asked = hive.questions.advance("many")
    assert 4 < 4 + asked < 72, "a look at each combination would leave no time for whole recordings"
    end(hive, noisy, "many")
    found = searched(hive, noisy)
    assert found.runs >= (4 + asked) / 4


def test_a_budget_of_time_asks_for_few_runs_before_one_has_ended(hive: Hive):
    start(hive, MANY.replace("90 runs", "30 s") + "playback: {mode: sequential}\n")
    assert hive.questions.advance("many") == 4
    end(hive, noisy, "many")
    found = searched(hive, noisy)
    assert found.runs < 24
    assert (
        found.words
        == f"Undecided: the budget of 30 s had room for {found.runs} runs, and 24 are needed to say anything."
    )


def test_a_clip_without_any_error_is_the_best_of_the_first_looks(hive: Hive):
    start(hive, MANY.replace("90 runs", "40 runs, first_look: 1 s, keep: 50%"))
    hive.questions.advance("many")
    exact, *_ = hive.experiments.unfinished("many")
    end(hive, lambda run: 0.0 if run.id == exact else error_m(run), "many")
    hive.questions.advance("many")
    followed = [hive.runs.get(run).parameters for run in hive.experiments.unfinished("many")]
    assert hive.runs.get(exact).parameters in followed


def test_optuna_chooses_the_next_runs_where_it_is_asked_to(hive: Hive):
    start(hive, MANY.replace("90 runs", "40 runs, sampler: tpe").replace("10%", "0.1%"))
    hive.questions.advance("many")
    end(hive, very_noisy, "many")
    assert "as tpe of Optuna suggests" in hive.questions.search("many").next
    assert searched(hive, very_noisy).runs == 40


def test_a_sampler_that_is_not_installed_is_refused_before_anything_is_stored(
    hive: Hive, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(optuna_sampling, "find_spec", lambda _name: None)
    with pytest.raises(Unavailable, match="sampler nsga2 needs Optuna, which is not installed"):
        start(hive, MANY.replace("90 runs", "90 runs, sampler: nsga2"))
    assert hive.experiments.list() == ()


def test_a_metric_where_more_is_better_is_searched_upwards(hive: Hive):
    start(hive, MANY.replace("budget: 90 runs", "metric: tracked.path, budget: 60 runs"))
    found = searched(hive)
    assert found.candidates[0].expected == pytest.approx(0.99, abs=0.01)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            MANY.replace("90 runs", "9 runs"),
            "budget of 9 runs is too small for one look: the first runs of 72 .* are 24",
        ),
        (
            MANY.replace("90 runs", "10 min"),
            "budget of 10 min is too small for one look: the first runs of 72 .* take 16 min or more; raise it",
        ),
        (
            MANY.replace("90 runs", "30 s, first_look: 10 s"),
            "budget of 30 s is too small for one look: the first runs of 72 .* take 60.6 s or more",
        ),
        (
            MANY.replace("90 runs", "30 s, first_look: 10 s") + "playback: {rate: 2}\n",
            "the first runs of 72 .* take 30.3 s or more",
        ),
        (MANY.replace("10%", "10 m"), "many.yaml line 5: '10 m' is no share; write 5%, or 0.05"),
        (MANY.replace("within: 10%", "limits: [cpu.mean = 2]"), "'cpu.mean = 2' is no limit"),
        (MANY.replace("within: 10%", "limits: [cpu.mena <= 2]"), "unknown metric 'cpu.mena'; did you mean"),
        (MANY.replace("within: 10%", "limits: [failed = 1]"), "'failed = 1' is no limit; write failed = 0"),
        (MANY.replace("within: 10%", "against: [ate.rmse]"), "ate.rmse is there twice; name each objective once"),
        (MANY.replace("within: 10%", "against: [poses]"), "no direction of .* is better"),
        (MANY.replace("within: 10%", "sampler: cma"), "many.yaml line 5"),
        (MANY.replace("within: 10%", "first_look: 15 m"), "'15 m' is no first look; write 15 s"),
        (MANY.replace("within: 10%", "first_look: 600 s"), "the first 600 s are no first look at room, which takes"),
        (MANY.replace("within: 10%", "first_look: 2 s, against: failed"), "a first look ranks by ate.rmse alone"),
        (MANY.replace("within: 10%", "keep: 50%"), "keep needs first looks; add first_look: 15 s"),
        (MANY.replace("within: 10%", "limits: [cpu.mean <= 2 m]"), "'2 m' is no value of cpu.mean"),
        (MANY.replace("executor", "decide: {difference: 1 cm, budget: 90 runs}\nexecutor"), "one question"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(hive: Hive, text: str, problem: str):
    with pytest.raises((InvalidInput, NotFound), match=problem) as caught:
        start(hive, text)
    assert "\n" not in str(caught.value)
    assert hive.experiments.list() == ()
