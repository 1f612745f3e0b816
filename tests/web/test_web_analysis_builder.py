"""The cards of plot types: choices from the selected runs, and the entries that they write into the text."""

from __future__ import annotations

import html
import re
from typing import Any

import pytest

from slamhive import strict_yaml
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.web.analysis_builder import Card, cards
from tests.web import web_world as world
from tests.web.test_web_experiments import TRIAL
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

TEXT = "name: x\nselect: {runs: {experiment: trial}}\nforms:\n  - {form: table}\n"


@pytest.fixture
def trial(web: Web, monkeypatch: pytest.MonkeyPatch) -> Web:
    """An experiment over one parameter; one run of each of three configurations has ended well."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    web.hive.experiments.start(ExperimentSource(TRIAL))
    for number, ate_m in ((1, 0.3), (2, 0.1), (3, 0.2)):
        (cell,) = web.hive.experiments.cells("trial", number - 1, 1).cells
        world.finish_run(web.hive, cell.runs[0].id)
        world.evaluate_run(web.hive, cell.runs[0].id, ate_m)
    return web


def card_of(web: Web, key: str) -> Card:
    return next(card for card in cards(web.hive.analyses.offered(TEXT)) if card.key == key)


def choices_of(card: Card) -> dict[str, list[str]]:
    return {field.option: [choice.value for choice in field.choices] for field in card.fields}


def typed(page: str) -> str:
    return html.unescape(page.partition("<textarea")[2].partition(">")[2].partition("</textarea>")[0])


def insert(web: Web, key: str, **fields: Any) -> str:
    data = {"csrf_token": web.token, "yaml": TEXT, "do": f"insert:{key}", **fields}
    answer = web.client.post("/analyses", data=data)
    assert answer.status_code == 200
    return typed(answer.text)


def test_choices_are_what_the_selected_runs_have(trial: Web) -> None:
    line = choices_of(card_of(trial, "line"))
    assert line["x"] == ["nFeatures"], "only what varies among these runs"
    assert "ate.rmse" in line["metric"]
    assert "gpu.mean" not in line["metric"], "no run has measured it"
    assert "form: line" in card_of(trial, "line").example
    assert "x: nFeatures" in card_of(trial, "line").example
    scatter = choices_of(card_of(trial, "scatter"))
    assert {"nFeatures", "ate.rmse", "cpu.mean"} <= set(scatter["x"])
    assert "It needs 2 parameters with several values" in card_of(trial, "heatmap").lacking
    assert card_of(trial, "line").lacking == ""


def test_a_card_writes_its_choices_into_the_text(trial: Web) -> None:
    text = insert(trial, "line", **{"line.x": "nFeatures", "line.metric": "cpu.mean", "scatter.x": "ate.rmse"})
    assert strict_yaml.parse(text, "text")["forms"] == [
        {"form": "table"},
        {"form": "line", "x": "nFeatures", "metric": "cpu.mean"},
    ]
    assert trial.hive.analyses.check(text) == "x"
    text = insert(trial, "pareto", **{"pareto.metrics": ["ram.max", "ate.rmse"]})
    assert strict_yaml.parse(text, "text")["forms"][1] == {"form": "pareto", "metrics": ["ram.max", "ate.rmse"]}


def test_every_card_that_fits_writes_an_entry_that_is_understood(trial: Web) -> None:
    for card in cards(trial.hive.analyses.offered(TEXT)):
        if not card.lacking:
            assert trial.hive.analyses.check(insert(trial, card.key)) == "x", card.key


def test_a_name_that_no_run_has_is_refused_while_typing(trial: Web) -> None:
    text = TEXT + "  - {form: scatter, x: nFeatures, y: nope}\n"
    answer = trial.client.post("/analyses/check", data={"csrf_token": trial.token, "yaml": text}).get_json()
    assert answer["ok"] is False
    assert "nothing is called 'nope'" in answer["message"]
    assert answer["line"] == 5


def test_the_page_says_where_the_choices_are_from(trial: Web) -> None:
    page = trial.client.get("/analyses/new?experiment=trial").text
    assert 'name="line.x"' in page
    assert "The choices are from 3 of 12 selected runs." in " ".join(re.sub("<[^>]+>", " ", page).split())
    nothing = trial.client.get("/analyses/new", query_string={"where": "id = 99999"}).text
    assert "The text selects no runs" in nothing
    assert 'name="line.x"' not in nothing


def test_defaults_are_written_as_yaml(trial: Web) -> None:
    options = {option.name: option.default for option in card_of(trial, "pareto").options}
    assert options["metrics"] == "[cpu.mean, ate.rmse]"
    flags = {option.name: option.default for option in card_of(trial, "trajectories").options}
    assert flags["in_3d"] == "false"


STEPPED = """\
name: stepped
algorithms: eye-slam-mono
datasets: room
steps:
  image_rate: {step: rate, sensors: camera, hz: 20 | 10}
  image_resolution: {step: resolution, sensors: camera, scale: 1 | .5}
executor: process
"""


@pytest.mark.parametrize(("linked", "drawn"), [("", True), ("linked: [[image_rate, image_resolution]]\n", False)])
def test_linked_axes_get_no_heat_map(trial: Web, linked: str, drawn: bool) -> None:
    trial.hive.experiments.start(ExperimentSource(STEPPED + linked))
    text = typed(trial.client.get("/analyses/new?experiment=stepped").text)
    forms = {entry["form"] for entry in strict_yaml.parse(text, "text")["forms"]}
    assert ({"heatmap", "importance"} <= forms) is drawn
    assert ({"heatmap", "importance"} & forms == set()) is not drawn
