"""Configurations through the pages and the API: list, form, YAML, names and groups, deletion."""

from __future__ import annotations

import html
import io
import re
from dataclasses import replace

import pytest

from slamhive.documents.submission import Submission
from slamhive.services.configurations import Label
from slamhive.services.executors import Executors
from tests.web.web_world import HOSTILE, Web

pytestmark = pytest.mark.quick

FORM = {
    "algorithm": "eye-slam-stereo",
    "dataset": "room",
    "parameter.nFeatures": "1500",
    "name": "mine",
    "note": "a\r\nb",
}


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def send(web: Web, path: str, **fields: object):
    return web.client.post(path, data={"csrf_token": web.token, **fields})


def unescaped(text: str) -> str:
    return html.unescape(re.sub(r"\s+", " ", text))


def test_the_form_stores_and_tells_what_is_the_same(web: Web):
    answer = send(
        web, "/configurations/new", **FORM, group="fast ones", steps="rate hz=10\n\nresolution@camera0 scale=0.5"
    )
    assert answer.status_code == 303
    page = unescaped(web.client.get(answer.location).text)
    assert "Configuration 2 (mine) is new." in page
    for words in ("rate of camera0, camera1, imu2 (hz 10)", "fast ones", "a b"):
        assert words in page
    again = send(
        web, "/configurations/new", **{**FORM, "name": "other"}, steps="rate hz=10\nresolution@camera0 scale=.5"
    )
    page = unescaped(web.client.get(again.location).text)
    assert "The same as configuration 2 (mine)." in page
    assert "It keeps the name 'mine'." in page
    assert web.hive.configurations.page().total == 2


def test_the_preview_knows_what_is_there(shown: Web):
    known = {"algorithm": "eye-slam-stereo", "dataset": "room", "parameter.nFeatures": "2000"}
    answer = shown.client.get("/configurations/new/preview", query_string=known).get_json()
    assert answer == {
        "preview": "Identical to configuration 1.",
        "errors": {},
        "bound": {},
        "used": {"sensor.left": "camera0", "sensor.right": "camera1"},
    }
    new = shown.client.get("/configurations/new/preview", query_string=FORM).get_json()
    assert new["preview"] == "This configuration does not exist yet."


@pytest.mark.parametrize(
    ("field", "typed", "words"),
    [("parameter.nFeatures", "9", "100 to 10000"), ("steps", "blur radius=2", "unknown pre-processing step 'blur'"),
     ("steps", "rate", "give either every"), ("steps", "rate@camera9 every=2", "has no sensor 'camera9'"),
     ("steps", "rate hz=100", "above the 20 Hz"), ("playback_rate", "0", "0.01 to 100"),
     ("dataset", "hall", "needs 2 camera"),
     ("algorithm", "nope", "unknown algorithm")],
)  # fmt: skip
def test_a_wrong_field_is_named_and_what_was_typed_is_kept(shown: Web, field: str, typed: str, words: str):
    answer = send(shown, "/configurations/new", **{**FORM, field: typed})
    assert answer.status_code == 400
    message = re.search(rf"data-error=\"{re.escape(field)}\">([^<]+)<", answer.text)
    assert message is not None, answer.text
    assert words in html.unescape(message[1])
    assert 'value="mine"' in answer.text
    assert shown.hive.configurations.page().total == 1


@pytest.mark.parametrize(
    ("name", "status", "words"), [("12", 400, "name '12' is not allowed"), ("taken", 409, "belongs to")]
)
def test_a_name_that_cannot_be_is_said_above_the_form(web: Web, name: str, status: int, words: str):
    web.hive.configurations.describe(1, Label("taken"))
    answer = send(web, "/configurations/new", **{**FORM, "name": name})
    assert answer.status_code == status
    assert words in unescaped(answer.text)
    assert web.hive.configurations.page().total == 1


@pytest.mark.integration
def test_markup_in_names_notes_and_groups_is_text(web: Web):
    web.hive.configurations.describe(1, Label(HOSTILE, HOSTILE, HOSTILE[:60]))
    for page in ("/configurations", "/configurations/1", "/configurations/1/edit", "/configurations/new?copy=1"):
        text = web.client.get(page).text
        assert "<script>alert" not in text
    assert html.escape(HOSTILE) in web.client.get("/configurations/1").text
    export = web.client.get("/configurations/1/configuration.yaml")
    assert export.mimetype == "application/yaml"
    assert export.headers["Content-Disposition"].startswith("attachment")


def test_a_copy_starts_from_what_is_there(web: Web):
    page = web.client.get("/configurations/new?copy=1").text
    assert re.search(r'name="parameter.nFeatures"[^>]* value="2000"', page)
    assert web.client.get("/configurations/new?copy=99").status_code == 404


@pytest.mark.integration
def test_a_change_leaves_what_has_runs(web: Web):
    web.hive.configurations.describe(1, Label("first"))
    fields = {**FORM, "name": "first", "note": ""}
    answer = send(web, "/configurations/1/edit", **fields)
    page = unescaped(web.client.get(answer.location).text)
    assert "Configuration 2 is new." in page
    assert "Configuration 1 (first) stays as it is: it has 5 runs." in page
    assert web.hive.configurations.get(1).configuration.parameters["nFeatures"] == 2000
    changed = send(web, "/configurations/2/edit", **{**fields, "name": "", "parameter.nFeatures": "1600"})
    page = unescaped(web.client.get(changed.location).text)
    assert "Configuration 2 is gone: nothing depended on it." in page
    assert web.hive.configurations.page().total == 2


@pytest.mark.integration
def test_what_has_runs_cannot_be_deleted(web: Web):
    assert 'action="/configurations/1/delete"' not in web.client.get("/configurations/1").text
    assert "no: it has 5 runs" in web.client.get("/configurations/1").text
    refused = send(web, "/configurations/1/delete")
    assert refused.status_code == 409
    assert "a configuration with runs must stay" in refused.text.lower()
    free = web.hive.configurations.create(Submission("eye-slam-mono", "room")).record.id
    gone = send(web, f"/configurations/{free}/delete")
    assert gone.location == "/configurations"
    assert web.client.get(f"/configurations/{free}").status_code == 404


@pytest.mark.integration
def test_groups_names_and_notes(web: Web):
    assert send(web, "/configurations/1/group", group="night").status_code == 303
    assert send(web, "/configurations/1/describe", name="one", note="x").status_code == 303
    page = unescaped(web.client.get("/configurations?group=night").text)
    assert "Showing 1 of 1 configuration: in group night, newest first." in page
    assert send(web, "/configurations/1/group", group="night", remove="1").status_code == 303
    assert send(web, "/configurations/1/group", group="").status_code == 400
    assert "No configuration matches this filter." in web.client.get("/configurations?group=night").text


@pytest.mark.integration
def test_the_list_filters_and_pages(web: Web):
    for count in (300, 400, 500):
        web.hive.configurations.create(Submission("eye-slam-mono", "room", {"nFeatures": count}))
    page = unescaped(
        web.client.get("/configurations?where=nFeatures>=400; nFeatures<1000&algorithm=eye-slam-mono").text
    )
    assert (
        "Showing 2 of 2 configurations: algorithm eye-slam-mono, nFeatures>=400, nFeatures<1000, newest first." in page
    )
    first = web.client.get("/configurations?limit=3").text
    following = html.unescape(re.search(r'rel="next" href="([^"]+)"', first)[1])  # type: ignore[index]
    assert "Showing the next 1 of 4 configurations" in web.client.get(following).text
    listed = web.client.get("/api/v1/configurations?used=yes").get_json()
    assert (listed["total"], listed["configurations"][0]["runs"], listed["next"]) == (1, 5, None)
    assert web.client.get("/api/v1/configurations/1").get_json()["parameters"]["nFeatures"]["type"] == "int"
    for wrong in ("where=x", "where=nFeature=1", "limit=0", "limit=x", "used=maybe", "after=x"):
        answer = web.client.get(f"/configurations?{wrong}")
        assert answer.status_code in {400, 404}, wrong


def test_yaml_pasted_or_uploaded(web: Web):
    text = web.client.get("/configurations/1/configuration.yaml").text
    same = send(web, "/configurations/import", text=text)
    assert same.location == "/configurations/1"
    other = text.replace("nFeatures: 2000", "nFeatures: 2222").encode()
    new = send(web, "/configurations/import", file=(io.BytesIO(other), "c.yaml"))
    assert web.hive.configurations.get(2).configuration.parameters["nFeatures"] == 2222
    assert new.location == "/configurations/2"


@pytest.mark.parametrize(
    ("text", "status", "words"),
    [("", 400, "there is no YAML to import"), ("a: &x 1\nb: *x", 400, "the text line 1: anchors and aliases"),
     ("slam-hive-algorithm: vins\nslam-hive-dataset: room\n", 404, "unknown algorithm 'vins'"),
     ("algorithm: <b>x</b>\ndataset: room\n", 404, "unknown algorithm '<b>x</b>'"),
     ("algorithm: eye-slam-mono\ndataset: room\nparameters: {nFeatures: x}", 400, "nFeatures='x' is not allowed")],
)  # fmt: skip
def test_yaml_that_cannot_be_used_is_shown_again(shown: Web, text: str, status: int, words: str):
    answer = send(shown, "/configurations/import", text=text)
    assert answer.status_code == status
    assert words in unescaped(answer.text)
    assert (
        html.escape(text, quote=False).splitlines()[0:1]
        == [line for line in [html.escape(text, quote=False)] for line in line.splitlines()][0:1]
    )
    assert "<b>x</b>" not in answer.text


def test_an_upload_that_is_no_text_or_too_large(shown: Web):
    binary = send(shown, "/configurations/import", file=(io.BytesIO(b"\xff\xfe\x00"), "../../x.yaml"))
    assert binary.status_code == 400
    assert "is not UTF-8 text" in binary.text
    form = "multipart/form-data; boundary=x"
    assert shown.client.post("/configurations/import", data=b"a" * 1_100_000, content_type=form).status_code == 413


@pytest.mark.integration
def test_the_run_form_takes_steps_and_the_run_tells_them(web: Web):
    answer = send(
        web, "/runs/new", algorithm="eye-slam-stereo", dataset="room", steps="resolution scale=0.5", evaluate="no"
    )
    assert answer.status_code == 303
    page = unescaped(web.client.get(answer.location).text)
    assert "resolution of camera0, camera1 (interpolation area, scale 0.5)" in page
    assert "resolution of camera0" in unescaped(web.client.get("/runs?columns=id,variant").text)
    filled = web.client.get("/configurations/2").text
    start = html.unescape(re.search(r'href="(/runs/new\?[^"]+)">Run it', filled)[1])  # type: ignore[index]
    form = web.client.get(start).text
    assert "resolution@camera0,camera1 interpolation=area scale=0.5" in form
    preview = web.client.get(start.replace("/runs/new?", "/configurations/new/preview?")).get_json()
    assert preview["preview"] == "Identical to configuration 2."


def test_a_configuration_that_no_longer_fits_says_so(web: Web):
    path = web.hive.catalogue.project_root / "algorithms" / "eye-slam" / "algorithm.yaml"
    path.write_text(path.read_text().replace("maximum: 10000", "maximum: 1000"))
    page = unescaped(web.client.get("/configurations/1").text)
    assert (
        "This configuration can no longer be run: nFeatures=2000 is stored, eye-slam-stereo now wants int, 100 to 1000"
        in page
    )
    assert "Run it" not in page


def test_the_experiments_that_hold_it_are_linked(web: Web, monkeypatch: pytest.MonkeyPatch):
    record = replace(web.hive.configurations.get(1), experiments=("rates",))
    monkeypatch.setattr(web.hive.configurations, "get", lambda _number: record)
    page = web.client.get("/configurations/1").text
    assert '<a href="/experiments/rates">rates</a>' in page
    assert "no: it is part of experiment rates" in unescaped(page)
