"""Starting, cancelling, retrying and evaluating through the pages."""

from __future__ import annotations

import html
import re

import pytest

from slamhive.base.errors import Unavailable
from slamhive.domain.run import RunState
from slamhive.services.executors import Executors
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

FORM = {"algorithm": "eye-slam-stereo", "dataset": "room", "executor": "process", "repeat": "3", "evaluate": "no"}


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether an executor can be used on this machine is no matter of the pages."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def send(web: Web, path: str, **fields: str):
    return web.client.post(path, data={"csrf_token": web.token, **fields})


def shown_value(page: str, field: str) -> str:
    found = re.search(rf"name=\"{re.escape(field)}\"[^>]* value=\"([^\"]*)\"", page)
    assert found is not None
    return html.unescape(found[1])


def test_the_form_starts_runs_and_redirects(web: Web):
    answer = send(web, "/runs/new", **FORM, **{"parameter.nFeatures": "1234", "parameter.solver": "gn"})
    assert answer.status_code == 303
    assert "configuration=" in answer.location
    page = web.hive.runs.page(limit=3)
    assert [run.parameters["nFeatures"] for run in page.records] == [1234, 1234, 1234]
    assert {run.state for run in page.records} == {RunState.QUEUED}
    assert page.records[0].parameters["solver"] == "gn"
    assert not page.records[0].evaluate
    first, last = page.records[-1].id, page.records[0].id
    assert f"Runs {first} to {last} were put into the queue." in web.client.get(answer.location).text


def test_a_run_that_is_running_already_is_not_said_to_be_queued(web: Web):
    answer = send(web, "/runs/new", **{**FORM, "repeat": "1"})
    (run,) = web.hive.runs.page(limit=1).records
    world.start_run(web.hive, run.id)
    text = web.client.get(answer.location).text
    assert f"Run {run.id} was put into the queue." in text
    assert "is queued" not in text


@pytest.mark.parametrize(
    ("field", "typed", "words"),
    [("parameter.nFeatures", "99", "100 to 10000"), ("parameter.nFeatures", "<b>", "expected int"),
     ("parameter.scale", "nan", "expected float"), ("parameter.solver", "qr", "one of lm, gn"),
     ("repeat", "0", "use 1 to 1000"), ("repeat", "many", "not a whole number"),
     ("playback_rate", "1e9", "0.01 to 100"),
     ("seed", "-1", "use 0 to"), ("timeout_s", "soon", "not a number"), ("alignment", "magic", "use one of none"),
     ("playback_mode", "backwards", "use one of realtime"), ("dataset", "hall", "needs 2 camera sensors"),
     ("dataset", "nowhere", "unknown dataset"), ("algorithm", "", "nothing is chosen")],
)  # fmt: skip
def test_a_wrong_field_is_named_and_everything_typed_is_kept(shown: Web, field: str, typed: str, words: str):
    before = sum(shown.hive.runs.counts().values())
    answer = send(shown, "/runs/new", **{**FORM, "parameter.note": 'mine "quoted"', "seed": "7", field: typed})
    assert answer.status_code == 400
    message = re.search(rf"data-error=\"{re.escape(field)}\">([^<]+)<", answer.text)
    assert message is not None, answer.text
    assert words in html.unescape(message[1])
    assert sum(shown.hive.runs.counts().values()) == before
    if field not in {"dataset", "algorithm"}:
        assert shown_value(answer.text, "parameter.note") == 'mine "quoted"'
    if field != "seed":
        assert shown_value(answer.text, "seed") == "7"
    if field in {"repeat", "parameter.nFeatures"}:
        assert shown_value(answer.text, field) == typed


def test_what_only_the_services_know_is_said_above_the_form(web: Web, monkeypatch: pytest.MonkeyPatch):
    def unavailable(executors: Executors, asked: str | None = None) -> str:
        raise Unavailable("no Docker engine answers", "start it")

    monkeypatch.setattr(Executors, "choose", unavailable)
    answer = send(web, "/runs/new", **FORM)
    assert answer.status_code == 503
    assert "no Docker engine answers; start it" in answer.text
    assert shown_value(answer.text, "repeat") == "3"


def test_the_preview_says_what_will_happen(shown: Web):
    answer = shown.client.get("/runs/new/preview", query_string=FORM).get_json()
    assert answer["errors"] == {}
    assert answer["preview"] == (
        "3 runs of eye-slam-stereo on room, each about 40.0 s plus start-up, 2 min 00 s in all; "
        "time limit 3 min 00 s. At most 1 queued run goes first."
    )
    urgent = shown.client.get("/runs/new/preview", query_string={**FORM, "priority": "5"}).get_json()
    assert urgent["preview"].endswith("time limit 3 min 00 s."), "runs of a lower priority go later"
    wrong = shown.client.get("/runs/new/preview", query_string={**FORM, "repeat": "x"}).get_json()
    assert wrong["preview"] is None
    assert list(wrong["errors"]) == ["repeat"]


def test_datasets_without_the_sensors_are_explained(shown: Web):
    text = shown.client.get("/runs/new?algorithm=eye-slam-stereo").text
    assert re.search(r"<option value=\"hall\" disabled>", text)
    assert "needs 2 camera sensors, dataset hall has 0" in text
    assert "default 1000; int, 100 to 10000 features" in text


def test_cancel_and_retry(web: Web):
    answer = send(web, f"/runs/{web.runs['queued']}/cancel")
    assert answer.status_code == 303
    assert web.hive.runs.get(web.runs["queued"]).state is RunState.CANCELLED
    again = send(web, f"/runs/{web.runs['failed']}/retry")
    new = int(again.location.rpartition("/")[2])
    assert web.hive.runs.get(new).retry_of == web.runs["failed"]
    assert send(web, f"/runs/{web.runs['queued']}/cancel").status_code == 409


def test_evaluate_one_some_and_all(web: Web):
    bare, done = web.runs["bare"], web.runs["done"]
    assert send(web, f"/runs/{done}/evaluate", protocol="sim3").status_code == 303
    assert [entry.protocol.alignment for entry in web.hive.evaluations.of_run(done)][-1] == "sim3"
    assert send(web, f"/runs/{done}/evaluate", protocol="magic").status_code == 404
    assert send(web, "/runs/evaluate", all="1").status_code == 303
    assert [entry.state for entry in web.hive.evaluations.of_run(bare)] == ["queued"]
    assert "The evaluation is in progress." in web.client.get(f"/runs/{bare}").text
    assert web.hive.searches.unevaluated() == 0


def test_evaluating_the_ticked_needs_ticks(web: Web):
    assert send(web, "/runs/evaluate").status_code == 303
    assert send(web, "/runs/evaluate", run="1; drop").status_code == 400
    assert send(web, "/runs/evaluate", run=str(web.runs["failed"])).status_code == 409
    assert send(web, "/runs/evaluate", run=str(web.runs["bare"])).status_code == 303


@pytest.mark.integration
def test_a_failed_evaluation_says_why(web: Web):
    world.evaluate_run(web.hive, web.runs["bare"], reason="no time overlap with the ground truth")
    assert "no time overlap with the ground truth" in web.client.get(f"/runs/{web.runs['bare']}").text
