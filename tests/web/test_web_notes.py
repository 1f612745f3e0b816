"""Notes and tags on pages, in JSON and in exports; a view-only server only shows them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slamhive.base.settings import Mode
from slamhive.domain.run import RunNotes
from slamhive.run_folder.folder import RunFolder
from slamhive.services.runs import found_notes
from tests.web import web_world as world
from tests.web.web_world import HOSTILE, Web, make_web

pytestmark = pytest.mark.integration


@pytest.fixture
def noted(web: Web) -> Web:
    """Three runs have a folder with a record."""
    for name in ("done", "bare", "failed"):
        folder = web.hive.runs.folder(web.runs[name])
        if not folder.record.exists():
            folder.write_record({"id": web.runs[name]})
    return web


def send(web: Web, path: str, **fields: str | list[str]):
    return web.client.post(path, data={"csrf_token": web.token, **fields})


def test_a_note_and_tags_are_written_shown_found_and_removed(noted: Web) -> None:
    run_id = noted.runs["done"]
    answer = send(noted, f"/runs/{run_id}/notes", note=f"look: {HOSTILE}\r\nagain", tags="paper, to-check")
    assert (answer.status_code, answer.location) == (303, f"/runs/{run_id}")
    folder = noted.hive.runs.folder(run_id)
    assert json.loads(folder.notes.read_text()) == {"note": f"look: {HOSTILE}\nagain", "tags": ["paper", "to-check"]}
    page = noted.client.get(f"/runs/{run_id}").text
    assert 'value="paper to-check"' in page
    assert HOSTILE not in page
    listed = noted.client.get("/runs?where=tag = paper&columns=id,tags,note").text
    assert listed.count("paper, to-check") == 2
    rows = noted.client.get("/searches/export.json?where=has tag&columns=id,tags,note").get_json()
    assert rows == [{"id": run_id, "tags": "paper, to-check", "note": f"look: {HOSTILE}\nagain"}]
    found = noted.client.get(f"/api/v1/runs/{run_id}").get_json()
    assert (found["tags"], found["note"]) == (["paper", "to-check"], f"look: {HOSTILE}\nagain")
    fields = noted.client.get("/searches/fields.json").get_json()["fields"]
    assert next(entry for entry in fields if entry["name"] == "tag")["values"] == ["paper", "to-check"]
    send(noted, f"/runs/{run_id}/notes", note="", tags="")
    assert not noted.hive.runs.get(run_id).notes


def test_selected_runs_are_tagged_together(noted: Web) -> None:
    one, two = noted.runs["done"], noted.runs["failed"]
    form = noted.client.get(f"/runs/tags?run={one}&run={two}").text
    assert "Tag 2 runs" in form
    send(noted, "/runs/tags", run=[str(one), str(two)], add="first second")
    assert noted.hive.runs.get(two).tags == ("first", "second")
    assert 'value="second"> second' in noted.client.get(f"/runs/tags?run={one}").text
    send(noted, "/runs/tags", run=[str(one)], remove=["second"])
    assert (noted.hive.runs.get(one).tags, noted.hive.runs.get(two).tags) == (("first",), ("first", "second"))
    for answer in (noted.client.get("/runs/tags"), send(noted, "/runs/tags", add="x")):
        assert (answer.status_code, answer.location) == (303, "/runs")


@pytest.mark.parametrize("tags", ["<b>", "-x", "x" * 65, " ".join(map(str, range(21)))])
def test_what_cannot_be_kept_changes_nothing(noted: Web, tags: str) -> None:
    run_id = noted.runs["done"]
    answer = send(noted, f"/runs/{run_id}/notes", note="x", tags=tags)
    assert answer.status_code == 400
    assert not noted.hive.runs.folder(run_id).notes.exists()
    assert send(noted, f"/runs/{noted.runs['queued']}/notes", note="x", tags="").status_code == 409
    assert "when a worker has prepared the run" in noted.client.get(f"/runs/{noted.runs['queued']}").text


def test_a_view_only_server_shows_notes_and_changes_none(noted: Web, tmp_path: Path) -> None:
    run_id = noted.runs["done"]
    send(noted, f"/runs/{run_id}/notes", note="seen by all", tags="paper")
    noted.hive.close()
    public = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    page = public.client.get(f"/runs/{run_id}").text
    assert "seen by all" in page
    assert ">paper</a>" in page
    assert f"/runs/{run_id}/notes" not in page
    listed = public.client.get("/runs?columns=id,tags,note").text
    assert "seen by all" in listed
    assert "Tag selected" not in listed
    assert "data-edit" not in listed
    assert public.client.post(f"/runs/{run_id}/notes", data={"note": "x"}).status_code in {400, 403}
    assert public.hive.runs.get(run_id).note == "seen by all"
    public.hive.close()


def test_a_file_that_somebody_broke_costs_the_note_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = RunFolder(tmp_path)
    folder.write_notes(RunNotes("kept", ("paper",)))
    assert found_notes(folder) == RunNotes("kept", ("paper",))
    folder.notes.write_text('{"tags": "no list"}')
    assert not found_notes(folder)
    assert "notes.json is skipped: a note is a text" in caplog.text
