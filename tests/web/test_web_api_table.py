"""The table of the web API: its description, its rules for all operations, and what it shares with the commands."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
from click.testing import CliRunner

from slamhive.base.errors import InvalidInput
from slamhive.cli import main
from slamhive.documents.model import json_schema, parse
from slamhive.domain.run import RunState
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.web.api import TABLE
from slamhive.web.api.operation import KEY_HEADER, PREFIX, REPEATED_HEADER
from slamhive.web.security import API_HEADER
from slamhive.web.views.api_docs import description
from tests.web import web_world as world
from tests.web.request_fuzz import ANALYSIS, CONFIGURATION, EXPERIMENT
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

SUBMISSION = {"algorithm": "eye-slam-mono", "dataset": "room", "parameters": {"nFeatures": 1500}}


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def post(web: Web, path: str, body: dict[str, Any] | None = None, key: str | None = None) -> Any:
    headers = {API_HEADER: "1", **({} if key is None else {KEY_HEADER: key})}
    return web.client.post(PREFIX + path, json=body, headers=headers)


def get(web: Web, path: str) -> Any:
    return web.client.get(PREFIX + path).get_json()


@pytest.mark.parametrize(
    "body", {entry.body for entry in TABLE.operations if isinstance(entry.body, type)}, ids=lambda body: body.__name__
)
def test_an_unknown_key_is_answered_with_the_keys_that_are_described(body: type[Any]):
    with pytest.raises(InvalidInput, match="unknown key 'zzzzzzzz'") as refused:
        parse(body, {"zzzzzzzz": 1})
    named = str(refused.value).partition("; known: ")[2].partition("; and")[0].split(", ")
    assert named == sorted(json.loads(json_schema(body))["properties"])


def references(value: Any) -> Iterator[str]:
    if isinstance(value, dict):
        for key, entry in value.items():
            yield from [entry] if key == "$ref" else references(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from references(entry)


def test_the_description_is_complete(shown: Web):
    found = shown.client.get("/api/openapi.json").get_json()
    assert found == json.loads(json.dumps(description(TABLE)))
    assert found["openapi"].startswith("3.1")
    for reference in references(found):
        *_, part, name = reference.split("/")
        assert name in found["components"][part]
    names = [entry["operationId"] for methods in found["paths"].values() for entry in methods.values()]
    assert len(set(names)) == len(names)
    rules = {rule.endpoint for rule in shown.app.url_map.iter_rules() if rule.rule.startswith(PREFIX)}
    assert rules == {f"api.{name}" for name in names}


def test_every_operation_and_field_is_explained():
    found = description(TABLE)
    for methods in found["paths"].values():
        for entry in methods.values():
            assert entry["summary"].endswith("."), entry["operationId"]
            assert all(parameter["description"] for parameter in entry["parameters"])
    assert all(schema.get("description") or "enum" in schema for schema in found["components"]["schemas"].values()), [
        name for name, schema in found["components"]["schemas"].items() if not schema.get("description")
    ]


def test_the_page_shows_the_whole_description(shown: Web):
    text = shown.client.get("/api/docs").text
    for operation in TABLE.operations:
        assert f'id="{operation.name}"' in text
    for name in description(TABLE)["components"]["schemas"]:
        assert f'id="model-{name}"' in text
    assert not re.findall(r'(?:src|href)="(?:https?:)?//', text)


@pytest.mark.parametrize(
    ("path", "status", "title"),
    [("/runs/999", 404, "Not Found"), ("/nothing", 404, "Not Found"), ("/runs?limit=0", 400, "Bad Request"),
     ("/runs?where=ate.rms<1", 400, "Bad Request"), ("/runs?after=x", 400, "Bad Request"),
     ("/comparison?runs=1", 400, "Bad Request")],
)  # fmt: skip
def test_errors_are_problem_details(shown: Web, path: str, status: int, title: str):
    answer = shown.client.get(PREFIX + path)
    problem = answer.get_json()
    assert (answer.status_code, answer.mimetype) == (status, "application/problem+json")
    assert (problem["status"], problem["title"], problem["type"]) == (status, title, "about:blank")
    assert problem["error"] == {"status": status, "message": problem["detail"], "remedy": problem["remedy"]}


def test_unchanged_answers_are_not_sent_again(shown: Web):
    for path in ("/runs", "/runs/1", "/algorithms", "/runs/1/files/traj.txt"):
        with shown.client.get(PREFIX + path) as first:
            tag = first.headers["ETag"]
        with shown.client.get(PREFIX + path, headers={"If-None-Match": tag}) as again:
            assert (again.status_code, again.data) == (304, b"")


def test_a_part_of_a_file(shown: Web):
    whole = shown.hive.runs.folder(shown.runs["done"]).trajectory.read_bytes()
    with shown.client.get(f"{PREFIX}/runs/1/files/traj.txt", headers={"Range": "bytes=10-19"}) as answer:
        assert (answer.status_code, answer.data) == (206, whole[10:20])
    files = {file["key"]: file for file in get(shown, "/runs/1/files")["files"]}
    assert files["traj.txt"]["size_bytes"] == len(whole)
    with shown.client.get(files["traj.txt"]["address"]) as answer:
        assert answer.data == whole
    assert shown.client.get(f"{PREFIX}/runs/1/files/..%2f..%2fslamhive.db").status_code == 404


@pytest.mark.integration
def test_pages_neither_repeat_nor_hide_runs_while_others_are_added(web: Web):
    before = {run["id"] for run in get(web, "/runs")["runs"]}
    for sort in ("", "&sort=id&order=asc", "&sort=ate.rmse&order=asc", "&sort=created_at&order=desc"):
        seen, address = [], f"{PREFIX}/runs?limit=2{sort}"
        while address:
            page = web.client.get(address).get_json()
            seen += [run["id"] for run in page["runs"]]
            address = page["next"]
            world.add_runs(web.hive, 1)
            assert len(seen) < 100
            if before <= set(seen):
                break
        assert len(seen) == len(set(seen))
        assert before <= set(seen)


def test_exports_are_streams_of_the_same_rows(shown: Web):
    address = f"{PREFIX}/exports/runs"
    args = "?columns=id,state,ate.rmse&sort=id&order=asc"
    rows = shown.client.get(f"{address}.json{args}").get_json()
    answer = shown.client.get(f"{address}.ndjson{args}", buffered=False)
    assert (answer.mimetype, answer.is_streamed) == ("application/x-ndjson", True)
    assert [json.loads(line) for line in answer.text.splitlines()] == rows
    assert [row["id"] for row in rows] == sorted(shown.runs.values())
    assert shown.client.get(f"{address}.csv{args}").text == shown.client.get(f"/searches/export.csv{args}").text
    assert shown.client.get(f"{address}.xls").status_code == 404


def test_a_change_with_a_key_is_done_once(web: Web):
    first = post(web, "/runs", SUBMISSION, key="a")
    again = post(web, "/runs", SUBMISSION, key="a")
    assert (first.status_code, again.status_code) == (201, 201)
    assert again.get_json() == first.get_json()
    assert (first.headers.get(REPEATED_HEADER), again.headers[REPEATED_HEADER]) == (None, "true")
    assert post(web, "/runs", SUBMISSION, key="b").get_json() != first.get_json()
    other = post(web, "/runs", {**SUBMISSION, "seed": 3}, key="a")
    assert (other.status_code, "another request" in other.get_json()["detail"]) == (400, True)


def test_a_refused_change_may_be_sent_again_with_its_key(web: Web):
    running = web.runs["running"]
    assert post(web, f"/runs/{running}/retry", key="a").status_code == 409
    ends = (RunState.COLLECTING, RunState.SUCCEEDED)
    world.advance(web.hive, running, *ends, poses=1, exit_code=0)
    assert post(web, f"/runs/{running}/retry", key="a").status_code == 201


def test_a_change_that_failed_in_the_middle_is_not_repeated(web: Web, monkeypatch: pytest.MonkeyPatch):
    with monkeypatch.context() as patch:
        patch.setattr(type(web.hive.runs), "cancel", lambda *_: 1 / 0)
        assert post(web, f"/runs/{web.runs['queued']}/cancel", key="a").status_code == 500
    answer = post(web, f"/runs/{web.runs['queued']}/cancel", key="a")
    assert (answer.status_code, "was cut off" in answer.get_json()["detail"]) == (409, True)


@pytest.mark.integration
def test_the_commands_print_what_the_api_answers(web: Web, monkeypatch: pytest.MonkeyPatch):
    run_id = web.runs["done"]
    web.hive.experiments.start(ExperimentSource(EXPERIMENT.replace("NAME", "trial")))
    post(web, "/searches", {"name": "best", "where": "id > 1"})
    post(web, "/runs/delete", {"runs": [web.runs["failed"]]})
    monkeypatch.setenv("SLAMHIVE_ROOT", str(web.hive.project_root))
    monkeypatch.setenv("SLAMHIVE_DATA", str(web.hive.settings.data))

    def printed(*command: str) -> Any:
        ended = CliRunner().invoke(main, [*command, "--json"])
        assert ended.exit_code == 0, (command, ended.stderr)
        return json.loads(ended.stdout)

    assert printed("runs") == get(web, "/runs")["runs"]
    assert {key: found for key, found in printed("runs", "show", str(run_id)).items()
            if key not in ("folder", "provenance")} == get(web, f"/runs/{run_id}")  # fmt: skip
    assert printed("compare", "1", "2") == get(web, "/comparison?runs=1,2")
    assert printed("runs", "trash") == get(web, "/trash")["runs"]
    assert printed("algorithm", "show", "eye-slam-mono") == get(web, "/algorithms/eye-slam-mono")
    assert printed("configuration", "list") == get(web, "/configurations")["configurations"]
    assert printed("experiment", "list") == get(web, "/experiments")["experiments"]
    assert printed("protocol", "list") == get(web, "/protocols")
    assert printed("search", "list") == get(web, "/searches")["searches"]
    shown = printed("dataset", "show", "room")
    assert {key: shown[key] for key in get(web, "/datasets/room")} == get(web, "/datasets/room")


def test_notes_tags_deletion_and_the_way_back(web: Web):
    done, bare = web.runs["done"], web.runs["bare"]
    for run_id in (done, bare):
        folder = web.hive.runs.folder(run_id)
        folder.write_record({"id": run_id, **(folder.read_record() if folder.record.exists() else {})})
    noted = post(web, f"/runs/{done}/notes", {"note": "look", "tags": ["paper"]}).get_json()
    assert (noted["note"], noted["tags"]) == ("look", ["paper"])
    assert post(web, f"/runs/{done}/notes", {"note": "again"}).get_json()["tags"] == ["paper"]
    tagged = post(web, "/runs/tags", {"runs": [done, bare], "add": ["two"], "remove": ["paper"]}).get_json()["runs"]
    assert [run["tags"] for run in tagged] == [["two"], ["two"]]
    assert post(web, f"/runs/{done}/notes", {"tags": ["a b"]}).status_code == 400
    assert post(web, "/runs/delete", {"runs": []}).status_code == 400
    assert post(web, "/runs/delete", {"runs": [bare, web.runs["running"]]}).status_code == 409
    assert get(web, "/trash") == {"runs": []}


@pytest.mark.integration
def test_a_saved_search(web: Web):
    wanted: dict[str, Any] = {"name": "best", "where": "id > 1", "columns": ["id", "ate.rmse"], "sort": "ate.rmse"}
    wanted |= {"descending": False, "group": False, "pinned": 2, "colours": True, "sparks": False}
    assert post(web, "/searches", wanted).get_json() == wanted
    assert get(web, "/searches")["searches"] == [wanted]
    assert post(web, "/searches", {**wanted, "columns": ["nothing"]}).status_code == 404
    assert post(web, "/searches", {**wanted, "pinned": 21}).status_code == 400
    assert post(web, "/searches/best/delete").get_json() == {"removed": "best"}
    assert "ate.rmse" in {field["name"] for field in get(web, "/fields")["fields"]}


@pytest.mark.integration
def test_configurations_are_stored_described_grouped_and_deleted(web: Web):
    made = post(web, "/configurations", {"submission": SUBMISSION, "name": "mine", "group": "g"})
    number = made.get_json()["id"]
    assert (made.status_code, made.get_json()["created"], made.get_json()["groups"]) == (201, True, ["g"])
    assert not post(web, "/configurations", {"submission": SUBMISSION}).get_json()["created"]
    imported = post(web, "/configurations/import", {"yaml": CONFIGURATION.replace("NAME", "other")}).get_json()
    assert (imported["name"], imported["created"]) == ("other", True)
    place = f"/configurations/{number}"
    assert post(web, f"{place}/describe", {"note": "n"}).get_json()["note"] == "n"
    assert post(web, f"{place}/group", {"group": "g", "remove": True}).get_json()["groups"] == []
    assert "eye-slam-mono" in web.client.get(f"{PREFIX}{place}/yaml").text
    modified = post(web, f"{place}/modify", {"parameters": {"nFeatures": 900}}).get_json()
    assert (modified["parameters"]["nFeatures"]["value"], modified["name"]) == (900, "mine")
    assert post(web, f"/configurations/{modified['id']}/delete").get_json() == {"removed": str(modified["id"])}
    assert post(web, "/configurations/1/delete").status_code == 409


def test_analyses_are_stored_listed_and_deleted(web: Web):
    assert post(web, "/analyses/check", {"yaml": ANALYSIS}).get_json() == {"name": "An analysis"}
    assert post(web, "/analyses/check", {"yaml": "name: x"}).status_code == 400
    made = post(web, "/analyses", {"yaml": ANALYSIS, "listed": False}).get_json()
    assert (made["state"], get(web, "/analyses")["analyses"]) == ("queued", [])
    place = f"/analyses/{made['token']}"
    assert post(web, f"{place}/list", {"listed": True}).get_json()["listed"]
    assert [entry["token"] for entry in get(web, "/analyses")["analyses"]] == [made["token"]]
    assert get(web, place)["yaml"] == ANALYSIS
    assert web.client.get(f"{PREFIX}{place}/report").status_code == 404
    assert post(web, f"{place}/delete").get_json() == {"removed": made["token"]}
    assert web.client.get(PREFIX + place).status_code == 404


def test_progress_metrics_log_and_server(shown: Web):
    runs = shown.runs
    progress = get(shown, f"/runs/{runs['running']}/progress")
    assert (progress["state"], progress["fraction"]) == ("running", 0.5)
    assert get(shown, f"/runs/{runs['done']}/progress") == {
        "state": "succeeded", "text": "succeeded", "fraction": None, "elapsed_s": None, "left_s": None,
        "cpu_cores": None, "memory_bytes": None,
    }  # fmt: skip
    (values,) = get(shown, f"/runs/{runs['done']}/metrics")["protocols"].values()
    assert values["ate.rmse"] == 0.04567
    assert shown.client.get(f"{PREFIX}/runs/{runs['done']}/log?bytes=9").text == "tracking\n"
    (engine,) = [entry for entry in get(shown, "/nodes")["engines"] if entry["executor"] == "process"]
    assert runs["running"] in [run["id"] for node in engine["nodes"] for run in node["runs"]]
    refused = post(shown, "/nodes/drain", {"executor": "process", "node": "elsewhere"})
    assert (refused.status_code, "unknown node" in refused.get_json()["detail"]) == (404, True)
    server = get(shown, "/server")
    assert (server["mode"], server["changes"]) == ("workstation", True)
    assert next(entry for entry in get(shown, "/metrics")["metrics"] if entry["key"] == "ate.rmse")["unit"] == "m"
