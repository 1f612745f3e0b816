"""The search over everything, on its page and by command."""

from __future__ import annotations

import json
import re

import pytest
from click.testing import CliRunner

from slamhive.cli import main
from slamhive.domain.finding import FoundKind
from slamhive.domain.run import NotesChange
from slamhive.services.finding import find
from slamhive.store.records import RunSort, SavedSearchRecord
from tests.web import web_world as world
from tests.web.web_world import Web

pytestmark = pytest.mark.integration


def names(web: Web, text: str) -> dict[str, list[str]]:
    return {kind.value: [entry.name for entry in entries] for kind, entries in find(web.hive, text).items()}


def links(web: Web, text: str) -> list[str]:
    page = web.client.get("/find", query_string={"q": text})
    assert page.status_code == 200
    return re.findall(r'<li><a href="([^"]+)">', page.text.partition("<main")[2])


def test_names_and_descriptions_are_found(shown: Web) -> None:
    assert names(shown, "eye-slam") == {"algorithm": ["eye-slam-mono", "eye-slam-stereo"]}
    assert names(shown, "hall") == {"dataset": ["hall"]}
    assert names(shown, "ate.rmse")["metric"][0] == "ate.rmse"
    assert names(shown, "  ") == {}
    assert names(shown, "no such thing") == {}


def test_the_api_finds_what_the_page_finds(shown: Web) -> None:
    found = shown.client.get("/api/v1/find?q=eye-slam").get_json()["found"]
    assert [entry["name"] for entry in found] == ["eye-slam-mono", "eye-slam-stereo"]
    assert {entry["kind"] for entry in found} == {"algorithm"}
    assert shown.client.get("/api/v1/find").status_code == 400


def test_a_number_is_a_run(shown: Web) -> None:
    assert names(shown, "3")["run"] == ["Run 3"]
    assert names(shown, "run 3")["run"] == ["Run 3"]
    assert "run" not in names(shown, "99")
    assert "run" not in names(shown, "9" * 40)


def test_a_filter_finds_runs(shown: Web) -> None:
    (found,) = find(shown.hive, "ate.rmse < 0.1")[FoundKind.RUNS]
    assert (found.key, found.words) == ("ate.rmse < 0.1", "1 run")
    assert links(shown, "ate.rmse < 0.1")[0] == "/runs?where=ate.rmse+%3C+0.1"


def test_tags_searches_and_analyses_are_found(web: Web) -> None:
    web.hive.notes.change([1, 2], NotesChange(add=("paper",)))
    web.hive.searches.save(SavedSearchRecord("paper-runs", "state = succeeded", (), RunSort(), False))
    made = web.hive.stored_analyses.create(
        "name: For the paper\nselect: {all: {where: 'id >= 1'}}\nforms: [{form: table}]\n"
    )
    found = find(web.hive, "paper")
    assert {kind: entries[0].words for kind, entries in found.items()} == {
        FoundKind.RUNS: "2 runs",
        FoundKind.SEARCH: "state = succeeded",
        FoundKind.ANALYSIS: "queued",
    }
    assert found[FoundKind.ANALYSIS][0].key == made.token


def test_every_link_of_the_page_leads_somewhere(web: Web) -> None:
    web.hive.searches.save(SavedSearchRecord("eye", "state = succeeded", (), RunSort(), False))
    for text in ("eye", "room", "1", "state = failed", "rmse", "search"):
        found = links(web, text)
        assert found
        for link in found:
            assert web.client.get(link.replace("&amp;", "&")).status_code == 200, link


def test_help_pages_are_found_by_their_headings(shown: Web) -> None:
    assert "/help/gate" in links(shown, "continuous integration")


def test_what_is_typed_is_shown_as_text(shown: Web) -> None:
    page = shown.client.get("/find", query_string={"q": world.HOSTILE})
    assert world.HOSTILE not in page.text
    assert "&lt;/script&gt;" in page.text


def test_the_command_prints_a_table_or_json(web: Web) -> None:
    data = str(web.hive.settings.data)
    call = ["--data", data, "find", "run", "3"]
    assert CliRunner().invoke(main, call).stdout.splitlines()[1].split()[:2] == ["run", "Run"]
    found, *_ = json.loads(CliRunner().invoke(main, [*call, "--json"]).stdout)
    assert found == {"kind": "run", "key": "3", "name": "Run 3", "words": "eye-slam-stereo on room, failed"}
    nothing = CliRunner().invoke(main, ["--data", data, "find", "no", "such"])
    assert (nothing.exit_code, nothing.stdout, nothing.stderr) == (0, "", "nothing found for 'no such'\n")
