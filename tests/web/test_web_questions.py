"""Experiments that choose their runs, on their page, in the API and in the client."""

from __future__ import annotations

import pytest

from slamhive.documents.experiment import Decision, SearchStanding
from slamhive.experiments.file import parse_experiment
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.web.experiment_fields import fields_from_yaml, yaml_from_fields
from slamhive.web.presenters.questions import front_plots
from tests.services.test_questions import TWO, noisy, play
from tests.services.test_searching_experiments import MANY
from tests.services.test_searching_experiments import noisy as searched_error_m
from tests.web.web_world import Web

pytestmark = pytest.mark.integration


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def test_the_page_says_how_it_stands_and_what_comes_next(web: Web):
    web.hive.experiments.start(ExperimentSource(TWO))
    page = web.client.get("/experiments/two/question").text
    assert "Not decided yet." in page
    assert "Next: More runs of nFeatures 1000 and nFeatures 2000 on 1 dataset" in page
    assert "/experiments/two/question" in web.client.get("/experiments/two").text


def test_the_page_and_the_api_give_the_same_answer(web: Web):
    web.hive.experiments.start(ExperimentSource(TWO))
    play(web.hive, noisy({1000: 0.05, 2000: 0.09}))
    answer = web.client.get("/api/v1/experiments/two/decision").json
    found = Decision.read(answer)
    page = web.client.get("/experiments/two/question").text
    assert found.words in page
    assert "nFeatures 2000</td><td>beaten" in page
    assert found.words in web.client.get("/experiments/two").text
    assert (web.client.get("/api/v1/experiments/two").json or {})["conclusion"] == found.words
    assert web.hive.questions.decision("two") == found
    assert found.words in web.client.get("/").text
    answer = web.hive.experiments.answer("two")
    assert (answer.sentence, answer.more_repeats) == (found.words, None)


def test_an_experiment_without_a_question_has_no_such_page(web: Web):
    web.hive.experiments.start(ExperimentSource(TWO.replace("decide: {difference: 1 cm, budget: 80 runs}\n", "")))
    assert web.client.get("/experiments/two/question").status_code == 400
    assert web.client.get("/api/v1/experiments/two/decision").status_code == 400
    assert web.client.get("/experiments/none/question").status_code == 404


def test_a_search_has_its_page_and_its_answer(web: Web):
    web.hive.experiments.start(ExperimentSource(MANY))
    assert "Nothing is known yet." in web.client.get("/experiments/many/question").text
    play(web.hive, searched_error_m, "many")
    found = SearchStanding.read(web.client.get("/api/v1/experiments/many/search").json)
    page = web.client.get("/experiments/many/question").text
    assert found.words in page
    assert "Candidates that may be best" in page
    assert web.client.get("/api/v1/experiments/many/decision").status_code == 400


def test_the_page_of_a_search_shows_the_trade_offs_as_they_grew(web: Web):
    traded = MANY.replace("budget: 90 runs, within: 10%", "budget: 28 runs, within: 0.1%, against: cpu.mean | failed")
    web.hive.experiments.start(ExperimentSource(traded))
    play(web.hive, searched_error_m, "many")
    found = web.hive.questions.search("many")
    page = web.client.get("/experiments/many/question").text
    assert "Best trade-offs" in page
    assert page.count('<svg class="front"') == 2
    assert page.count("<circle") == 2 * sum(len(step.front) for step in found.growth)
    assert "What matters for CPU mean" in page
    for plot in front_plots(found):
        for ticks in (plot.ticks_across, plot.ticks_up):
            assert len({text for _, text in ticks}) == len(ticks), "ticks read alike"
    assert "many is not decided" not in web.client.get("/").text
    assert [step.runs for step in found.growth] == [24, 28]


def test_the_builder_keeps_a_question_and_offers_a_search(web: Web):
    page = web.client.get("/new-experiment").text
    assert "Search instead of all combinations" in page
    text = MANY.replace(
        "budget: 90 runs", "budget: 90 runs, against: [cpu.mean, failed], limits: [ram.max <= 1 GB, failed = 0]"
    )
    again = parse_experiment(yaml_from_fields(fields_from_yaml(text)))
    assert again.optimise is not None
    assert (again.optimise.against, again.optimise.failing) == (("cpu.mean", "failed"), 0.0)
    assert again.content_hash == parse_experiment(text).content_hash
    assert parse_experiment(yaml_from_fields(fields_from_yaml(TWO))).content_hash == parse_experiment(TWO).content_hash
