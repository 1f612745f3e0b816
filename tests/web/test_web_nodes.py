"""The page of nodes: what runs where, without changing anything where that is not possible."""

from __future__ import annotations

import json
import platform
from datetime import timedelta
from pathlib import Path

import pytest

from slamhive.base.clock import utc_now
from slamhive.base.settings import Mode
from slamhive.executors.host import describe_host
from slamhive.executors.process.executor import ProcessExecutor
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration


def test_the_page_shows_this_machine_and_what_runs_on_it(shown: Web) -> None:
    assert 'href="/nodes"' in shown.client.get("/").text
    text = shown.client.get("/nodes").text
    cpu = f'<td data-label="CPU">{describe_host().cpu_model}</td>'
    assert f'<td>{platform.node()}</td><td data-label="State">up</td>{cpu}' in text
    assert f'<a href="/runs/{shown.runs["running"]}">' in text
    assert "/nodes/drain" not in text, "this machine cannot be drained"


def test_the_overview_as_json(shown: Web) -> None:
    overview = shown.hive.nodes.overview()
    content = json.loads(json.dumps(overview.content))
    (engine,) = [entry for entry in content["engines"] if entry["executor"] == "process"]
    (node,) = engine["nodes"]
    assert (node["name"], node["takes_runs"], engine["drains"]) == (platform.node(), True, False)
    assert shown.runs["running"] in [run["id"] for run in node["runs"]]
    assert content["queued"] == sum(shown.hive.store.read(lambda t: t.durations.queued()).values())


def test_throughput_and_time_left_of_a_node(shown: Web) -> None:
    hive = shown.hive
    overview = hive.nodes.overview()
    (engine,) = [entry for entry in overview.engines if entry.executor == "process"]
    (node,) = engine.nodes
    ended = hive.store.read(lambda t: t.placing.ended_on(utc_now() - timedelta(hours=24)))
    assert node.runs_per_hour == ended.get(("process", None), 0) / 24
    left = [run.left_s for run in node.runs if run.left_s is not None]
    assert node.left_s == max(left, default=None)
    assert node.left_s == 0, "the run here began long ago"
    assert (node.runs_per_hour, ">overdue</span></td>" in shown.client.get("/nodes").text) == (0, True)


@pytest.mark.parametrize(
    ("fields", "code", "text"),
    [
        ({"executor": "process", "node": platform.node()}, 400, "the executor process cannot drain"),
        ({"executor": "process", "node": "elsewhere"}, 404, "unknown node"),
        ({"executor": "punchcards", "node": "a"}, 404, "unknown executor"),
        ({}, 404, "unknown executor"),
    ],
)
def test_what_cannot_be_drained(shown: Web, fields: dict[str, str], code: int, text: str) -> None:
    answer = shown.client.post("/nodes/drain", data={"csrf_token": shown.token, **fields})
    assert answer.status_code == code
    assert text in answer.text.lower()
    assert shown.client.post("/nodes/drain", data=fields).status_code == 400, "without the token of the form"


def test_an_engine_that_is_away_gives_one_line(web: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ProcessExecutor, "unavailable_because", lambda _self: "the engine sleeps; wake it")
    (engine,) = [entry for entry in web.hive.nodes.overview().engines if entry.executor == "process"]
    assert (engine.problem, engine.nodes) == ("the engine sleeps; wake it", ())
    assert web.runs["running"] in [run.id for run in engine.elsewhere]
    assert "the engine sleeps; wake it" in web.client.get("/nodes").text


def test_a_view_only_server_asks_no_engine(filled: Path) -> None:
    web = make_web(world.make_hive(filled, Mode.VIEW_ONLY))
    text = web.client.get("/nodes").text
    assert "A view-only server asks no engine" in text
    assert platform.node() not in text
    answer = web.client.post("/nodes/drain", data={"csrf_token": web.token, "executor": "process", "node": "x"})
    assert answer.status_code == 403
    assert not web.hive.executors.opened
    web.hive.close()
