"""Import of trajectories by a web form: looked at, then stored or discarded."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
from werkzeug.test import TestResponse

from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.integration


def trajectory() -> bytes:
    text = io.StringIO()
    np.savetxt(text, world.loop_path(noise_m=0.02))
    return text.getvalue().encode()


def send(web: Web, *files: tuple[str, bytes], **fields: str) -> TestResponse:
    data = {"csrf_token": web.token, "algorithm": "my-slam", "dataset": "room", "sensors": "stereo", **fields}
    streams = [(io.BytesIO(content), name) for name, content in files]
    return web.client.post("/import/trajectories", data={**data, "files": streams})


def action(page: str, name: str) -> str:
    found = re.search(rf'action="(/import/trajectories/[0-9a-f]+/{name})"', page)
    assert found, page
    return found[1]


def test_the_page_shows_what_was_detected_and_stores_it_only_then(web: Web) -> None:
    before = sum(web.hive.runs.counts().values())
    page = send(web, ("first.txt", trajectory()), ("second.txt", trajectory())).text
    assert "<h1>2 trajectories of my-slam on room</h1>" in page
    assert "<td>first.txt</td>" in page
    assert "only as s do the timestamps fall into the time of the ground truth" in page
    assert sum(web.hive.runs.counts().values()) == before
    answer = web.client.post(action(page, "store"), data={"csrf_token": web.token})
    assert answer.status_code == 303
    assert sum(web.hive.runs.counts().values()) == before + 2
    assert web.client.get(answer.headers["Location"]).text.count("my-slam") >= 2
    again = web.client.post(action(page, "store"), data={"csrf_token": web.token})
    assert again.status_code == 404


def test_discarded_trajectories_leave_nothing(web: Web) -> None:
    page = send(web, ("first.txt", trajectory())).text
    assert web.client.post(action(page, "discard"), data={"csrf_token": web.token}).status_code == 303
    assert list((web.hive.settings.data / "staged-trajectories").iterdir()) == []


def test_a_file_that_is_no_trajectory_is_named_beside_the_good_one(web: Web) -> None:
    page = send(web, ("good.txt", trajectory()), ("bad.txt", b"<b>no poses</b>\n")).text
    assert "1 trajectory of my-slam on room" in page
    assert "bad.txt" in page
    assert "cannot be imported" in page
    assert "<b>no poses" not in page


@pytest.mark.parametrize(
    ("name", "fields", "words"),
    [
        ("../../evil.txt", {"dataset": "attic"}, "attic"),
        ("a.txt", {"sensors": "sonar"}, "sonar"),
        ("table.csv", {}, "is no name of a trajectory"),
    ],
)
def test_wrong_input_is_one_line_and_nothing_is_kept(web: Web, name: str, fields: dict[str, str], words: str) -> None:
    answer = send(web, (name, trajectory()), **fields)
    assert answer.status_code in {400, 404}
    assert words in answer.text
    assert not list((web.hive.settings.data / "staged-trajectories").glob("*"))


def test_a_name_leads_out_of_no_folder(web: Web) -> None:
    send(web, ("..\\../../evil.txt", trajectory()))
    (folder,) = (web.hive.settings.data / "staged-trajectories").iterdir()
    assert {path.name for path in folder.iterdir()} == {"evil.txt", "owner", "table.csv"}


def test_the_token_of_a_form_is_needed(web: Web) -> None:
    assert send(web, ("a.txt", trajectory()), csrf_token="x").status_code == 400
