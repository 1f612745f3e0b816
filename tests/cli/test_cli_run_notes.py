"""``slamhive runs note``, ``tag``, ``delete``, ``restore`` and ``trash``; trust in lists of runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.services.test_trash import end
from tests.web import web_world as world

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with two runs that have ended; the second dropped most of its frames."""
    folder = tmp_path_factory.mktemp("notes")
    hive = world.make_hive(folder)
    end(hive, *world.add_runs(hive, 2))
    hive.store.write(lambda t: t.metrics.put(2, None, {"frames.dropped_fraction": 0.79}))
    hive.close()
    return folder / "data"


def call(data: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "runs", *arguments])


def test_notes_and_tags_are_written_shown_and_found(data: Path) -> None:
    assert call(data, "tag", "1", "2", "--add", "paper", "--add", "x").stdout == (
        "run 1: tags paper, x\nrun 2: tags paper, x\n"
    )
    changed = call(data, "tag", "2", "--remove", "x", "--json")
    assert json.loads(changed.stdout) == [{"id": 2, "note": "", "tags": ["paper"]}]
    assert call(data, "note", "2", "look at this").stdout == "run 2: tags paper; look at this\n"
    shown = call(data, "show", "2").stdout
    assert "tags: paper\nnote: look at this\n" in shown
    found = json.loads(call(data, "--where", "tag = paper and tag != x", "--columns", "id,tags,note", "--json").stdout)
    assert found == [{"id": 2, "tags": "paper", "note": "look at this"}]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("tag", "1"), "no tag is named"),
        (("tag", "1", "--add", "two words"), "'two words' is not a tag"),
        (("tag", "99", "--add", "x"), "unknown run 99"),
        (("restore", "1"), "run 1 is not in the trash"),
        (("delete", "99"), "unknown run 99"),
    ],
)
def test_mistakes_are_one_line(data: Path, arguments: tuple[str, ...], said: str) -> None:
    result = call(data, *arguments)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.startswith(f"error: {said}")
    assert len(result.stderr.splitlines()) == 1


def test_lists_say_how_far_runs_can_be_trusted_and_why(data: Path) -> None:
    listed = call(data)
    assert "is very doubtful: the algorithm was too slow for 79 % of the frames" in listed.stderr
    rows = json.loads(call(data, "--where", "trust = low", "--columns", "id,trust", "--json").stdout)
    assert rows == [{"id": 2, "trust": "low"}]
    shown = call(data, "show", "2").stdout
    assert (
        "trust: very doubtful. the algorithm was too slow for 79 % of the frames, which were dropped; give it" in shown
    )
    assert "trust: unknown. dropped frames were not counted" in call(data, "show", "1").stdout


def test_runs_are_deleted_and_restored(data: Path) -> None:
    deleted = call(data, "delete", "1")
    assert deleted.stdout == "1 run moved to the trash; slamhive runs restore 1 takes them out again\n"
    assert [entry["id"] for entry in json.loads(call(data, "trash", "--json").stdout)] == [1]
    assert call(data, "show", "1").exit_code == 1
    assert call(data, "restore", "1").stdout == "1 run restored\n"
    assert call(data, "show", "1").exit_code == 0
    assert call(data, "trash").stderr == "the trash is empty\n"
    assert call(data, "trash", "--empty").stdout == "0 runs removed for good\n"


def test_all_runs_of_a_search_are_changed_after_a_question(data: Path) -> None:
    refused = CliRunner().invoke(main, ["--data", str(data), "runs", "delete", "--where", "id <= 2"], input="n\n")
    assert refused.exit_code == 1
    assert "move 2 runs to the trash? [y/N]" in refused.stderr
    assert json.loads(call(data, "trash", "--json").stdout) == []
    tagged = call(data, "tag", "--where", "id <= 2", "--add", "both", "--yes")
    assert tagged.stdout == "the tags of 2 runs are stored\n"
    assert json.loads(call(data, "--where", "tag = both", "--columns", "id", "--json").stdout) == [{"id": 2}, {"id": 1}]
    deleted = json.loads(call(data, "delete", "--where", "tag = both", "--yes", "--json").stdout)
    assert (deleted["done"], deleted["left_out"]) == (2, 0)
    assert call(data, "restore", "--deleted-at", deleted["deleted_at"]).stdout == "2 runs restored\n"
    retried = call(data, "retry", "--where", "tag = both", "--yes")
    assert retried.stdout == "0 runs queued, which repeat those of the search\n"
    assert "2 runs left out:\n  unknown algorithm 'eye-slam-stereo'" in retried.stderr
    assert retried.stderr.count("unknown algorithm") == 1, "a reason is stated once"
    assert call(data, "tag", "--where", "tag = nobody", "--add", "x").stdout == "no run matches this filter\n"


@pytest.mark.parametrize("arguments", [("delete",), ("delete", "1", "--where", "id = 1"), ("restore",)])
def test_runs_are_named_by_number_or_by_a_search(data: Path, arguments: tuple[str, ...]) -> None:
    result = call(data, *arguments)
    assert result.exit_code == 1
    assert result.stderr.startswith("error: name runs by number, or give --")
