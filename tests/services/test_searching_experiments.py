"""Experiments that search their combinations: from the file to the sentence at the end."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.documents.question import SearchStanding
from slamhive.domain.question import QuestionAnswer
from slamhive.domain.run import FailureReason
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.hive import Hive
from slamhive.store import RunRecord
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


def searched(hive: Hive, outcome: Callable[[RunRecord], Outcome] = noisy) -> SearchStanding:
    play(hive, outcome, "many")
    return hive.questions.search("many")


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
    assert found.words.startswith(f"After {found.runs} runs of 72, nFeatures 1500, scale 1.3, solver lm is within")
    assert found.words.endswith("m.")
    assert {entry.axis for entry in found.importance} == {"nFeatures", "scale", "solver"}


def test_a_spent_budget_says_how_near_it_came(hive: Hive):
    start(hive, MANY.replace("90 runs", "30 runs").replace("10%", "0.1%"))
    found = searched(hive, lambda run: error_m(run) * math.exp(np.random.default_rng(run.id).normal(0, 0.5)))
    assert (found.answer, found.runs) == (QuestionAnswer.UNDECIDED, 30)
    assert "within" in found.words
    assert found.expected_gain is not None


def test_what_fails_is_not_the_best(hive: Hive):
    start(hive)
    found = searched(hive, lambda run: FailureReason.TIMEOUT if run.parameters["solver"] == "lm" else noisy(run))
    assert found.candidates[0].values["solver"] == "gn"
    assert all(entry.failing < 0.5 for entry in found.candidates[:3])


def test_a_run_that_breaks_a_limit_counts_as_failed(hive: Hive):
    start(hive, MANY.replace("within: 10%", 'within: 10%, limits: ["cpu.mean <= 0.1"]'))
    found = searched(hive)
    assert found.answer is QuestionAnswer.UNDECIDED
    assert found.words.startswith("Undecided: no run kept cpu.mean <= 0.1 cores; the nearest is nFeatures")


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
        (MANY.replace("10%", "10 m"), "many.yaml line 5: '10 m' is no share; write 5%, or 0.05"),
        (MANY.replace("within: 10%", "limits: [cpu.mean = 2]"), "'cpu.mean = 2' is no limit"),
        (MANY.replace("within: 10%", "limits: [cpu.mena <= 2]"), "unknown metric 'cpu.mena'; did you mean"),
        (MANY.replace("within: 10%", "limits: [cpu.mean <= 2 m]"), "'2 m' is no value of cpu.mean"),
        (MANY.replace("executor", "decide: {difference: 1 cm, budget: 90 runs}\nexecutor"), "one question"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(hive: Hive, text: str, problem: str):
    with pytest.raises((InvalidInput, NotFound), match=problem) as caught:
        start(hive, text)
    assert "\n" not in str(caught.value)
    assert hive.experiments.list() == ()
