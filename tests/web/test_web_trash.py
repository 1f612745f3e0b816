"""Deleting runs on pages: asked first, undone by one button, listed in the trash."""

from __future__ import annotations

import re

import pytest

from slamhive.store import RunRequest
from tests.services.test_trash import end
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.integration


@pytest.fixture
def run_id(web: Web) -> int:
    """A run whose folder is complete."""
    configuration = web.hive.runs.get(1).configuration_id
    request = RunRequest(uid="d" * 32, configuration_id=configuration, executor="process")
    (number,) = web.hive.store.write(lambda t: t.runs.add_runs([request], world.NOW))
    end(web.hive, number)
    return number


def send(web: Web, path: str, **fields: str | list[str]):
    return web.client.post(path, data={"csrf_token": web.token, **fields})


def test_a_run_is_deleted_after_a_question_and_undone_by_a_button(web: Web, run_id: int) -> None:
    assert f'href="/runs/delete?run={run_id}"' in web.client.get(f"/runs/{run_id}").text
    question = web.client.get(f"/runs/delete?run={run_id}").text
    assert "Delete 1 run?" in question
    assert f'name="run" value="{run_id}"' in question
    answer = send(web, "/runs/delete", run=str(run_id))
    assert (answer.status_code, answer.location) == (303, "/runs")
    text = web.client.get("/runs").text
    assert "1 run moved to the trash." in text
    assert f'<a href="/runs/{run_id}">' not in text
    assert web.client.get(f"/runs/{run_id}").status_code == 404
    undo = re.search(r'action="/trash/restore".*?name="run" value="(\d+)".*?Undo', text, re.DOTALL)
    assert undo is not None
    answer = send(web, "/trash/restore", run=undo[1])
    assert answer.location == f"/runs/{run_id}"
    assert "1 run restored." in web.client.get(answer.location).text


def test_the_trash_lists_restores_and_is_emptied(web: Web, run_id: int) -> None:
    assert "The trash is empty." in web.client.get("/trash").text
    send(web, "/runs/delete", run=str(run_id))
    text = web.client.get("/trash").text
    assert f'data-label="Run">{run_id}</td><td data-label="Algorithm">eye-slam-stereo</td>' in text
    assert send(web, "/trash/empty").status_code == 303
    assert "The trash is empty." in web.client.get("/trash").text
    assert send(web, "/trash/restore", run=str(run_id)).status_code == 404


def test_what_has_not_ended_is_refused_in_words(web: Web) -> None:
    answer = send(web, "/runs/delete", run=str(web.runs["running"]))
    assert answer.status_code == 409
    assert "has not ended" in answer.text
    assert send(web, "/runs/delete").status_code == 303
    assert web.client.get("/runs/delete").status_code == 303
    assert web.client.get("/runs/delete?run=999").status_code == 404
