"""The web API."""

from __future__ import annotations

from typing import Any

import pytest

from slamhive.documents import catalogue
from slamhive.documents.run import RunWith
from slamhive.services.executors import Executors
from slamhive.web.security import API_HEADER
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

HEADERS = {API_HEADER: "1"}


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


def test_a_run_has_the_fields_that_everything_shares(shown: Web):
    run = shown.client.get(f"/api/v1/runs/{shown.runs['done']}").get_json()
    assert run["metrics"]["ate.rmse"] == {"value": 0.04567, "unit": "m"}
    assert run["metrics"]["ram.max"]["unit"] == "bytes"
    for field in ("id", "algorithm", "dataset", "parameters", "executor", "state", "reason", "created_at", "poses"):
        assert field in run
    assert [event["to"] for event in run["events"]][-1] == "succeeded"
    assert run["evaluations"][0]["state"] == "succeeded"


def test_every_answer_is_what_its_model_says(shown: Web):
    """What is read by the model and written again is the same: the schemas of the documentation hold."""

    def get(path: str) -> Any:
        return shown.client.get(f"/api/v1/{path}").get_json()

    for run_id in shown.runs.values():
        assert RunWith.read(get(f"runs/{run_id}")).content == get(f"runs/{run_id}")
    for kind, name in ((catalogue.AlgorithmDocument, "algorithms"), (catalogue.DatasetDocument, "datasets")):
        entries = get(name)[name]
        assert [kind.read(entry).content for entry in entries] == entries
    for entry in get("configurations")["configurations"]:
        assert catalogue.ConfigurationDocument.read(entry).content == entry


def test_runs_are_paged(shown: Web):
    first = shown.client.get("/api/v1/runs?limit=3").get_json()
    assert (len(first["runs"]), first["total"]) == (3, 5)
    second = shown.client.get(first["next"]).get_json()
    assert (len(second["runs"]), second["next"]) == (2, None)
    assert shown.client.get("/api/v1/runs?state=failed").get_json()["total"] == 1


def test_submit(web: Web):
    body: dict[str, Any] = {"algorithm": "eye-slam-mono", "dataset": "room", "parameters": {"nFeatures": 1500}}
    answer = web.client.post("/api/v1/runs", json={**body, "repeat": 2}, headers=HEADERS)
    assert answer.status_code == 201
    assert [run["parameters"]["nFeatures"] for run in answer.get_json()["runs"]] == [1500, 1500]


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [({"algorithm": "eye-slam-stereo"}, 400, "dataset"), ({"algorithm": 1, "dataset": "room"}, 400, "algorithm"),
     ({"algorithm": "no", "dataset": "room"}, 404, "unknown algorithm"), ([], 400, "JSON object"),
     ({"algorithm": "eye-slam-stereo", "dataset": "hall"}, 400, "needs 2 camera"),
     ({"algorithm": "eye-slam-stereo", "dataset": "room", "parameters": {"nFeature": 1}}, 404, "nFeatures"),
     ({"algorithm": "eye-slam-stereo", "dataset": "room", "parameters": {"nFeatures": 1}}, 400, "100 to 10000"),
     ({"algorithm": "eye-slam-stereo", "dataset": "room", "repeat": 1001}, 400, "repeat"),
     ({"algorithm": "eye-slam-stereo", "dataset": "room", "surprise": 1}, 400, "surprise")],
)  # fmt: skip
def test_what_cannot_be_submitted(shown: Web, body: Any, status: int, words: str):
    before = sum(shown.hive.runs.counts().values())
    answer = shown.client.post("/api/v1/runs", json=body, headers=HEADERS)
    assert answer.status_code == status
    assert words in str(answer.get_json()["error"])
    assert sum(shown.hive.runs.counts().values()) == before


def test_a_body_that_is_not_json(shown: Web):
    answer = shown.client.post("/api/v1/runs", data="algorithm=x", headers=HEADERS)
    assert answer.status_code == 400
    assert answer.get_json()["error"]["remedy"] == "send it with Content-Type: application/json"
    assert (
        shown.client.post("/api/v1/runs", data="{", content_type="application/json", headers=HEADERS).status_code == 400
    )


@pytest.mark.parametrize("number", ["1e999", "NaN", "-Infinity"])
@pytest.mark.parametrize("place", ['"parameters": {"nFeatures": %s}', '"parameters": {"label": %s}', '"repeat": %s'])
def test_numbers_that_are_none_are_refused(shown: Web, number: str, place: str):
    body = '{"algorithm": "eye-slam-stereo", "dataset": "room", ' + place % number + "}"
    answer = shown.client.post("/api/v1/runs", data=body, content_type="application/json", headers=HEADERS)
    assert answer.status_code == 400
    assert "not a finite number" in answer.get_json()["error"]["message"]


def test_cancel_retry_evaluate(web: Web):
    runs = web.runs
    assert web.client.post(f"/api/v1/runs/{runs['queued']}/cancel", headers=HEADERS).get_json()["state"] == "cancelled"
    assert web.client.post(f"/api/v1/runs/{runs['queued']}/cancel", headers=HEADERS).status_code == 409
    again = web.client.post(f"/api/v1/runs/{runs['done']}/retry", headers=HEADERS)
    assert (again.status_code, again.get_json()["retry_of"]) == (201, runs["done"])
    queued = web.client.post("/api/v1/evaluations", json={"runs": [runs["bare"]]}, headers=HEADERS)
    assert (queued.status_code, queued.get_json()) == (202, {"queued": 1})
    assert web.client.post("/api/v1/evaluations", json={"runs": [999]}, headers=HEADERS).status_code == 404
    assert web.client.post("/api/v1/evaluations", json={}, headers=HEADERS).get_json() == {"queued": 0}


def test_algorithms_and_datasets(shown: Web):
    algorithms = shown.client.get("/api/v1/algorithms").get_json()["algorithms"]
    assert [entry["name"] for entry in algorithms] == ["beam-odometry", "eye-slam-mono", "eye-slam-stereo"]
    assert (
        shown.client.get("/api/v1/algorithms/eye-slam-mono").get_json()["parameters"]["nFeatures"]["maximum"] == 10000
    )
    room = shown.client.get("/api/v1/datasets/room").get_json()
    assert room["groundtruth"]["gravity_aligned"]
    assert "folder" not in room
    assert str(shown.hive.settings.data) not in str(room)
    assert [entry["name"] for entry in shown.client.get("/api/v1/datasets").get_json()["datasets"]] == ["hall", "room"]
