"""The cards of plot types: choices from the selected runs, and the entries that they write into the text."""

from __future__ import annotations

import base64
import html
import re
import subprocess
from typing import Any

import pytest

from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.accounts import ANYBODY
from slamhive.services.analysis.run import spread_over
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.stored_analyses import computing as limits
from slamhive.web.analysis_editor import Card, cards, first_text, title_of, with_title
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


def press(web: Web, button: str, text: str, **fields: Any) -> tuple[int, str]:
    """The answer to a button of the editor: its status and the page."""
    answer = web.client.post("/analyses", data={"csrf_token": web.token, "yaml": text, "do": button, **fields})
    return answer.status_code, html.unescape(answer.text)


def test_plots_are_edited_moved_and_removed(trial: Web) -> None:
    text = TEXT + "  - {form: line, x: nFeatures, metric: cpu.mean, title: Mine}\n"
    status, page = press(trial, "edit:2", text)
    assert (status, typed(page)) == (200, "\n" + text)
    (card,) = re.findall(r'<details class="card-form" open>.*?</details>', page, re.DOTALL)
    assert '<option value="cpu.mean" selected>' in card
    assert 'value="replace:2:line"' in card
    assert "replace:" not in press(trial, "", text)[1].replace(card, "")
    changed = typed(press(trial, "replace:2:line", text, **{"line.x": "nFeatures", "line.metric": "ate.rmse"})[1])
    assert forms_of(changed)[1] == {"form": "line", "title": "Mine", "x": "nFeatures", "metric": "ate.rmse"}
    other = typed(press(trial, "replace:2:scatter", text, **{"scatter.x": "cpu.mean", "scatter.y": "ate.rmse"})[1])
    assert forms_of(other)[1] == {"form": "scatter", "x": "cpu.mean", "y": "ate.rmse"}
    assert [form["form"] for form in forms_of(typed(press(trial, "earlier:2", text)[1]))] == ["line", "table"]
    assert [form["form"] for form in forms_of(typed(press(trial, "later:1", text)[1]))] == ["line", "table"]
    status, page = press(trial, "remove:1", text)
    assert [form["form"] for form in forms_of(typed(page))] == ["line"]
    assert "Plot 1 was removed." in page


def forms_of(text: str) -> list[Any]:
    return list(strict_yaml.parse(text, "text")["forms"])


@pytest.mark.parametrize(
    ("button", "status", "words"),
    [
        ("remove:3", 404, "the text has no plot 3"),
        ("earlier:1", 404, "the text has no plot 0"),
        ("edit:x", 400, "'x' is not the number of a plot"),
        ("replace:1:nope", 404, "unknown plot type 'nope'"),
    ],
)
def test_buttons_for_plots_that_are_not_there_are_refused(trial: Web, button: str, status: int, words: str) -> None:
    answered, page = press(trial, button, TEXT)
    assert (answered, words in page) == (status, True)


def test_the_check_lists_the_plots(trial: Web) -> None:
    body = {"csrf_token": trial.token, "yaml": TEXT + "  - {form: line, x: <b>}\n"}
    answer = trial.client.post("/analyses/check", data=body).get_json()
    assert answer["plots"].count("<li ") == 2
    assert "x: &lt;b&gt;" in answer["plots"]
    assert 'value="remove:2"' in answer["plots"]


def test_every_card_that_fits_writes_an_entry_that_is_understood(trial: Web) -> None:
    for card in cards(trial.hive.analyses.offered(TEXT)):
        if not card.lacking:
            assert trial.hive.analyses.check(insert(trial, card.key)) == "x", card.key


def test_a_name_that_no_run_has_is_refused_while_typing(trial: Web) -> None:
    text = TEXT + "  - {form: scatter, x: nFeatures, y: nope}\n"
    answer = trial.client.post("/analyses/check", data={"csrf_token": trial.token, "yaml": text}).get_json()
    assert answer["ok"] is False
    assert "unknown name 'nope'" in answer["message"]
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


def previewed(web: Web, text: str) -> str:
    return web.client.post("/analyses/previews", data={"csrf_token": web.token, "yaml": text}).text


def test_previews_draw_the_plots_of_a_text(trial: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    text = TEXT + "  - {form: line, x: nFeatures}\n  - {form: line, x: dataset}\n"
    page = previewed(trial, text)
    (image,) = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert base64.b64decode(image).startswith(b"\x89PNG")
    assert len(image) < 200_000
    assert page.count("<figure>") == 3
    assert re.search(r"<p class=\"quiet\">[^<]+: \d+ rows?</p>", page), "a table has no picture"
    assert "'dataset' is text" in html.unescape(page), "a plot that cannot be drawn says why"
    monkeypatch.setattr(subprocess, "Popen", lambda *_args, **_more: pytest.fail("computed again"))
    assert previewed(trial, text) == page, "they are kept"
    assert 'class="verdict bad"' in previewed(trial, "name: x\n")


def test_previews_work_without_scripts(trial: Web) -> None:
    data = {"csrf_token": trial.token, "yaml": TEXT + "  - {form: line, x: nFeatures}\n", "do": "preview"}
    answer = trial.client.post("/analyses", data=data)
    assert answer.status_code == 200
    assert 'alt="Preview of Over a parameter"' in answer.text
    assert typed(answer.text).strip() == data["yaml"].strip()


def test_previews_and_rankings_hold_what_the_viewer_may_see(trial: Web) -> None:
    assert len(trial.hive.analysis_previews.of(TEXT)) == 1
    with trial.hive.store.seen_by(ANYBODY):
        with pytest.raises(InvalidInput, match="unknown experiment 'trial'"):
            trial.hive.analysis_previews.of(TEXT)
        with pytest.raises(NotFound, match="unknown experiment 'trial'"):
            trial.hive.experiments.rankings("trial")
        with pytest.raises(NotFound, match="unknown experiment 'trial'"):
            trial.hive.analyses.offered(TEXT)


def test_previews_have_limits(trial: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(limits, "TIME_LIMIT_S", 0.01)
    assert "take longer than 0.01 s" in previewed(trial, TEXT)
    monkeypatch.setattr(limits, "MOST_WAIT_S", 0.01)
    assert trial.hive.analysis_previews.busy.acquire()
    try:
        assert "previews of another analysis are being computed" in previewed(trial, TEXT)
    finally:
        trial.hive.analysis_previews.busy.release()
    assert len(spread_over(range(1000), 200)) == 200
    assert len(spread_over(range(201), 200)) == 101
    assert spread_over((), 200) == ()


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


def test_a_report_asks_for_its_title_and_keeps_the_rest_of_the_text(web: Web) -> None:
    page = web.client.get("/analyses/new").text
    assert re.search(r'<input [^>]*name="title"[^>]* value=""[^>]* required>', page)
    text = first_text("")
    titled = with_title(text, " Stereo  or mono: 'which'? ")
    assert titled.splitlines()[0] == "name: \"Stereo or mono: 'which'?\""
    assert titled.splitlines()[1:] == text.splitlines()[1:]
    assert title_of(titled) == "Stereo or mono: 'which'?"
    assert with_title(titled, "") == titled
    answer = web.client.post("/analyses", data={"csrf_token": web.token, "yaml": text, "title": "Mine", "do": "create"})
    assert answer.status_code == 303
    assert "<h1>Mine" in web.client.get(answer.location).text
