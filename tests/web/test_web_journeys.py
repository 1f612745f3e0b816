"""Journeys of somebody who is new: nothing selected, empty fields, names to complete, the first analysis."""

from __future__ import annotations

import html
import json
import re
from typing import Any

import pytest
from werkzeug.datastructures import MultiDict

from slamhive.analysis.plot_types import PLOT_TYPES
from slamhive.base import strict_yaml
from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.services.analysis import AnalysisService
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.store import Lease
from slamhive.web.analysis_editor import cards, entry_of, experiment_text, first_text, with_entry
from tests.store.store_samples import result
from tests.web import web_world as world
from tests.web.test_web_experiments import TRIAL
from tests.web.web_world import Web

pytestmark = pytest.mark.integration


def words(text: str) -> str:
    """The page as a reader sees it."""
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text)))


# -- lists of runs -----------------------------------------------------------------------------------------------------


def test_evaluating_with_none_selected_returns_to_the_list_and_says_so(web: Web) -> None:
    answer = web.client.post("/runs/evaluate?sort=seed&order=asc", data={"csrf_token": web.token})
    assert (answer.status_code, answer.location) == (303, "/runs?sort=seed&order=asc")
    text = web.client.get(answer.location).text
    assert "No run is selected. Select runs, then press" in text
    assert 'data-needs="1"' in text


def test_an_address_never_leads_elsewhere(web: Web) -> None:
    query = "endpoint=x&_external=1&_scheme=ftp&_anchor=a&state=failed"
    answer = web.client.post(f"/runs/evaluate?{query}", data={"csrf_token": web.token})
    assert (answer.status_code, answer.location) == (303, f"/runs?{query}")
    assert web.client.get(f"/runs?{query}&where=").location == f"/runs?{query}"


def test_empty_fields_are_left_out_of_the_address(shown: Web) -> None:
    fields = "&".join(f"{bound}.{key}=" for key in CATALOGUE for bound in ("min", "max"))
    answer = shown.client.get(f"/runs?where=&evaluated=&from=&{fields}&state=failed&state=succeeded&max.ate.rmse=1+m")
    assert answer.status_code == 302
    assert answer.location == "/runs?max.ate.rmse=1+m&state=failed&state=succeeded"
    page = shown.client.get(answer.location)
    assert page.status_code == 200
    assert "state in (failed, succeeded) and ate.rmse &lt;= 1 m" in page.text
    assert shown.client.get("/runs?where=&sort=+").location == "/runs"


def test_mixed_protocols_are_named_and_each_is_one_click_away(web: Web) -> None:
    world.evaluate_run(web.hive, web.runs["bare"])
    sim3 = Protocol(Alignment.SIM3)

    def work(t):
        (evaluation_id,) = t.evaluations.queue([web.runs["done"]], sim3, world.NOW)
        t.evaluations.claim(Lease("test", world.NOW, 30.0), runs=[web.runs["done"]])
        t.evaluations.finish(evaluation_id, "test", result(sim3, ate_rmse=0.01), world.NOW)
        t.evaluations.use([web.runs["done"]], sim3.fingerprint)

    web.hive.store.write(work)
    for address in ("/runs?state=succeeded", "/runs?group=configuration&state=succeeded"):
        text = web.client.get(address).text
        warning = re.search(r"alert-warning mixed[^>]*>(.*?)</p>", text, re.DOTALL)
        assert warning is not None
        assert "1 run uses" in warning[1]
        assert "not comparable" in warning[1]
        links = re.findall(r"href=\"([^\"]+)\">([^<]+)</a>", warning[1])
        protocols = sorted((world.PROTOCOL, sim3), key=lambda protocol: protocol.label)
        assert sorted(label for _, label in links) == [protocol.label for protocol in protocols]
        for (link, _), protocol in zip(sorted(links, key=lambda link: link[1]), protocols, strict=True):
            narrowed = web.client.get(html.unescape(link)).text
            assert "not comparable" not in narrowed
            assert f"protocol = {protocol.fingerprint}" in narrowed


def test_the_beginning_of_a_metric_suggests_the_metric(shown: Web) -> None:
    for typed, meant in (("ate", "ate.rmse"), ("rpe", "rpe.rmse"), ("cpu", "cpu.mean")):
        answer = shown.client.get(f"/api/v1/runs?where={typed} < 1")
        assert answer.get_json()["error"]["remedy"] == f"did you mean {meant!r}?"


def test_completion_offers_every_name_and_its_values(shown: Web) -> None:
    fields = {entry["name"]: entry for entry in shown.client.get("/searches/fields.json").get_json()["fields"]}
    assert set(CATALOGUE) <= set(fields)
    assert fields["ate.rmse"] == {"name": "ate.rmse", "label": "ATE RMSE", "unit": "m", "values": []}
    assert fields["trust"]["values"] == ["high", "limited", "low", "doubtful"]
    assert fields["disturbed"]["values"] == ["yes", "no"]
    assert "eye-slam-stereo" in fields["algorithm"]["values"]
    assert fields["nFeatures"]["unit"] == "features"
    for name, entry in fields.items():
        if entry["values"]:
            value = json.dumps(entry["values"][0])
            assert shown.client.get("/api/v1/runs", query_string={"where": f"{name} = {value}"}).status_code == 200, (
                name
            )
    text = shown.client.get("/runs").text
    assert 'data-fields="/searches/fields.json"' in text


# -- analyses ----------------------------------------------------------------------------------------------------------


def forms_of(text: str) -> list[str]:
    return [entry["form"] for entry in strict_yaml.parse(text, "text")["forms"]]


@pytest.mark.parametrize("key", PLOT_TYPES.names())
def test_every_plot_type_has_a_picture_of_its_own(shown: Web, key: str) -> None:
    template: Any = shown.app.jinja_env.get_template("analyses/_thumbnails.html").module
    assert template.thumbnail(key) != template.thumbnail("of a plug-in")
    assert "<path" in template.thumbnail("of a plug-in")


@pytest.mark.parametrize("key", PLOT_TYPES.names())
def test_every_plot_type_can_be_inserted(key: str) -> None:
    before = first_text("")
    (card,) = (card for card in cards() if card.key == key)
    entry = entry_of(card, MultiDict())
    after = with_entry(before, entry)
    assert forms_of(after) == [*forms_of(before), key]
    assert forms_of(with_entry(after, entry)) == [*forms_of(after), key]


@pytest.mark.parametrize(
    ("text", "forms"),
    [
        ("name: x\n", ["table"]),
        ("", ["table"]),
        ("forms:\n- form: line\n  x: seed\n\n# the end\nname: x\n", ["line", "table"]),
        ("forms:\n    - form: line\n      x: seed\nselect: {a: {runs: [1]}}\n", ["line", "table"]),
        ("name: x\nforms:   # none yet\n", ["table"]),
    ],
)
def test_an_entry_goes_to_the_end_of_the_list_wherever_that_is(text: str, forms: list[str]) -> None:
    assert forms_of(with_entry(text, {"form": "table"})) == forms


def test_what_cannot_be_inserted_is_refused_in_words() -> None:
    with pytest.raises(InvalidInput, match="in one line"):
        with_entry("forms: [{form: table}]\n", {"form": "table"})


def test_a_button_inserts_a_plot_type_without_scripts(shown: Web) -> None:
    page = shown.client.get("/analyses/new").text
    assert page.count('class="plot-type"') == len(cards())
    assert page.count('name="do" value="insert:') == 2 * len(cards()), "with sensible axes, or with chosen ones"
    data = {"csrf_token": shown.token, "yaml": first_text("id > 1"), "do": "insert:scatter"}
    answer = shown.client.post("/analyses", data=data)
    assert answer.status_code == 200
    typed = html.unescape(answer.text.partition("<textarea")[2].partition(">")[2].partition("</textarea>")[0])
    assert forms_of(typed) == ["by_algorithm", "distributions", "scatter"]
    refused = shown.client.post("/analyses", data={**data, "yaml": "forms: []\n"})
    assert refused.status_code == 400
    assert "in one line" in html.unescape(refused.text)
    wrong = shown.client.post("/analyses", data={**data, "do": "insert:scater"})
    assert wrong.status_code == 404
    assert "did you mean 'scatter'" in html.unescape(wrong.text)


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("{form: scatter, x: cpu.mean, y: nope}", "unknown name 'nope'"),
        ("{form: scatter, x: cpu.mean, y: ate}", "unknown name 'ate'"),
        ("{form: scatter, x: nFeatures, y: ate.rmse}", None),
        ("{form: heatmap, x: dataset, y: difficulty}", None),
        ("{form: line, x: variant.resolution.scale}", None),
    ],
)
def test_unknown_columns_are_refused_while_typing(shown: Web, entry: str, said: str | None) -> None:
    text = f"name: x\nselect:\n  a: {{runs: [1]}}\nforms:\n  - {entry}\n"
    found = shown.client.post("/analyses/check", data={"csrf_token": shown.token, "yaml": text}).get_json()
    assert found["ok"] is (said is None), found
    if said is not None:
        assert said in found["message"]
        assert found["line"] == 5
    if "ate}" in entry:
        assert found["remedy"] == "did you mean 'ate.rmse'?"


# -- experiments -------------------------------------------------------------------------------------------------------


@pytest.fixture
def trial(web: Web, monkeypatch: pytest.MonkeyPatch) -> Web:
    """An experiment of six configurations; one run of the first three has ended well."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    web.hive.experiments.start(ExperimentSource(TRIAL))
    for number, ate_m in ((1, 0.3), (2, 0.1), (3, 0.2)):
        (cell,) = web.hive.experiments.cells("trial", number - 1, 1).cells
        run_id = cell.runs[0].id
        world.finish_run(web.hive, run_id)
        world.evaluate_run(web.hive, run_id, ate_m)
    return web


def test_an_experiment_ranks_its_configurations_on_each_dataset(trial: Web) -> None:
    text = trial.client.get("/experiments/trial?by=configuration").text
    ranking = text.partition('id="ranking"')[2].partition("</section>")[0]
    rows = [words(row).split() for row in re.findall(r"<tr><td.*?</tr>", ranking, re.DOTALL)]
    assert [row[0] for row in rows] == ["–"] * 3, "one run of each decides no place"
    assert [row[row.index("nFeatures") + 1] for row in rows] == ["1000", "1500", "500"]
    assert "Preliminary: 3 of 12 runs have ended" in ranking
    assert "room, all configurations" in words(ranking)
    assert 'id="ranking"' not in trial.client.get("/experiments").text


def test_an_experiment_without_results_ranks_nothing(web: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    web.hive.experiments.start(ExperimentSource(TRIAL))
    page = web.client.get("/experiments/trial")
    assert page.status_code == 200
    assert 'id="ranking"' not in page.text


def test_an_experiment_leads_to_an_analysis_that_fits_it(trial: Web) -> None:
    page = trial.client.get("/experiments/trial").text
    assert 'href="/analyses/new?experiment=trial"' in page
    text = experiment_text("trial", trial.hive.experiments.axes("trial"))
    assert forms_of(text) == ["table", "by_algorithm", "line", "distributions", "pareto"]
    assert {"form": "line", "x": "nFeatures", "metric": "ate.rmse"} in strict_yaml.parse(text, "text")["forms"]
    analyses: AnalysisService = trial.hive.analyses
    assert analyses.check(text) == "trial"
    assert "experiment: trial" in html.unescape(trial.client.get("/analyses/new?experiment=trial").text)
    assert trial.client.get("/analyses/new?experiment=nothing").status_code == 404


def test_an_analysis_fits_what_an_experiment_varies() -> None:
    one = experiment_text("e", {"algorithm": ("a",), "dataset": ("d",)})
    assert forms_of(one) == ["table", "by_algorithm", "distributions"]
    two = experiment_text("e", {"algorithm": ("a", "b"), "solver": ("lm", "gn"), "rate": (5, 10.0)})
    assert forms_of(two) == ["table", "by_algorithm", "line", "heatmap", "importance", "distributions", "pareto"]
    assert strict_yaml.parse(two, "text")["forms"][0] == {"form": "table", "columns": "algorithms"}
    assert "columns" not in one, "a table for papers compares algorithms"
    linked = experiment_text("e", {"rate": (5, 10.0), "scale": (0.5, 1.0)}, lambda _first, _second: False)
    assert forms_of(linked) == ["table", "by_algorithm", "line", "line", "distributions", "pareto"]


def test_an_experiment_says_what_is_left_and_what_happens_now(trial: Web) -> None:
    assert trial.hive.experiments.status("trial").phase == "waiting for a worker"
    text = words(trial.client.get("/experiments/trial").text)
    assert "left, including builds and evaluations. Now: waiting for a worker." in text
