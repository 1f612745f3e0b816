"""Actions on all runs of a search, on pages."""

from __future__ import annotations

import html
import json
import re

import pytest

from slamhive.services import search_actions as actions
from slamhive.web.views import search_actions
from tests.services.test_trash import end
from tests.web import web_world as world
from tests.web.test_web_actions import send
from tests.web.web_world import Web

pytestmark = pytest.mark.quick


@pytest.fixture
def many(web: Web) -> Web:
    """Seven more runs that have ended, from number 6 on."""
    end(web.hive, *world.add_runs(web.hive, 7))
    return web


def act(web: Web, action: str, where: str, count: int, **form: str):
    return send(web, f"/runs/search/{action}?where={where}", count=str(count), **form)


def message(web: Web, address: str) -> str:
    text = web.client.get(address).text.partition('aria-live="polite">')[2].partition("</div>")[0]
    return html.unescape(" ".join(re.sub(r"<[^>]+>", "", text).split()))


def test_a_page_of_many_leads_to_all_runs_of_the_search(many: Web) -> None:
    text = many.client.get("/runs?limit=3&where=id+%3E%3D+6").text
    address = re.search(r'href="(/runs/search[^"]+)"', text)
    assert address
    page = many.client.get(html.unescape(address[1])).text
    assert "7 runs of a search" in page
    assert '<code class="break">id &gt;= 6</code>' in page
    assert "/runs/search" not in many.client.get("/runs?where=id+%3E%3D+6").text, "one page shows them all"


def test_all_runs_are_tagged_and_those_without_a_folder_named(many: Web) -> None:
    answer = act(many, "tag", "id+>%3D+5", 8, add="paper, two")
    assert (answer.status_code, answer.location) == (303, "/runs?where=id+%3E%3D+5")
    assert message(many, answer.location) == ("The tags of 7 runs are stored. 1 run left out: run 5 has no folder yet.")
    assert len(many.hive.searches.find("tag = paper")) == 7


def test_what_was_deleted_together_is_restored_together(many: Web) -> None:
    before = many.hive.searches.find("")
    answer = act(many, "delete", "id+>%3D+4", 9)
    text = many.client.get(answer.location).text
    assert "7 runs moved to the trash. 2 runs left out: run 4 has not ended, it is running" in html.unescape(text)
    deleted_at = re.search(r'name="deleted_at" value="([^"]+)"', text)
    assert deleted_at
    many.hive.trash.delete([many.runs["failed"]])
    assert send(many, "/trash/restore", deleted_at=html.unescape(deleted_at[1])).status_code == 303
    assert many.hive.searches.find("") == [run for run in before if run != many.runs["failed"]]


def test_a_search_that_matches_others_by_now_changes_nothing(many: Web) -> None:
    answer = act(many, "delete", "id+>%3D+6", 6)
    assert answer.status_code == 409
    assert "matches 7 runs now, not 6" in answer.text
    assert len(many.hive.searches.find("id >= 6")) == 7


def test_too_many_runs_are_left_to_the_command_line(many: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (search_actions, actions):
        monkeypatch.setattr(module, "MOST_OF_A_REQUEST", 6)
    text = many.client.get("/runs/search?where=id+>%3D+6").text
    assert "slamhive runs delete --where &#39;id &gt;= 6&#39;" in text
    assert '<form method="post" action="/runs/search' not in text
    assert act(many, "delete", "id+>%3D+6", 7).status_code == 400


@pytest.mark.parametrize(
    ("action", "form", "words"),
    [
        ("tag", {}, "no tag is named"),
        ("tag", {"add": "a", "count": "x"}, "count"),
        ("share", {"visibility": "x"}, "visibility"),
        ("evaluate", {"protocol": "x"}, "protocol"),
    ],
)
def test_bad_input_is_refused_in_a_line(many: Web, action: str, form: dict[str, str], words: str) -> None:
    answer = send(many, f"/runs/search/{action}?where=id+>%3D+6", **{"count": "7", **form})
    assert 400 <= answer.status_code < 410
    assert words in answer.text.lower()
    assert send(many, "/runs/search/tag?where=id+>", count="7", add="one").status_code == 400


def test_all_runs_are_retried_or_evaluated(many: Web) -> None:
    count = sum(many.hive.runs.counts().values())
    answer = act(many, "retry", "id+>%3D+4", 9)
    assert message(many, answer.location).startswith("7 runs queued again. 2 runs left out: run 4 is running")
    assert sum(many.hive.runs.counts().values()) == count + 7
    answer = act(many, "evaluate", "id+between+3+and+8", 6)
    assert message(many, answer.location).startswith("Evaluations of 3 runs queued. 3 runs left out: run 3 is failed")


def test_programs_change_what_they_expect(many: Web) -> None:
    def ask(action: str, **body: object):
        return many.client.post(f"/api/v1/runs/search/{action}", json=body, headers={"X-SLAM-Hive": "1"})

    assert ask("tags", where="id >= 5", count=8, add=["paper"]).json == {
        "done": 7,
        "left_out": 1,
        "reasons": ["run 5 has no folder yet"],
        "deleted_at": None,
    }
    answer = ask("delete", where="id >= 6", count=6)
    assert answer.status_code == 409
    assert "the search matches 7 runs now, not 6" in answer.text
    assert len(many.hive.searches.find("tag = paper")) == 7
    deleted = json.loads(ask("delete", where="id >= 6", count=7).text)
    assert deleted["done"] == 7
    together = {"deleted_at": deleted["deleted_at"]}
    answer = many.client.post("/api/v1/trash/restore-together", json=together, headers={"X-SLAM-Hive": "1"})
    assert answer.json == {"runs": [6, 7, 8, 9, 10, 11, 12]}
    assert ask("tags", where="id >= 6", count=7).status_code == 400
