"""``slamhive challenge``: from the file of a challenge to its ranking, and mistakes in one line."""

from __future__ import annotations

import json
import re
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from slamhive.base.project import project_root
from slamhive.cli import main
from slamhive.documents.challenge import Challenge, ChallengeRanking, ChallengeSubmission
from slamhive.services.challenges.definition import load_definition
from slamhive.services.evaluations import Evaluations
from tests.services.challenge_world import InThisProcess, entry_of, rooms, write_challenge

pytestmark = pytest.mark.integration

PHASES = [{"name": "public"}, {"name": "final", "begins": "2126-01-01T00:00:00+00:00"}]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with the challenge ``rooms``, which no test changes."""
    folder = tmp_path_factory.mktemp("made")
    path = write_challenge(folder / "organiser", rooms(2, phases=PHASES))
    created = call(folder / "data", "create", str(path))
    assert created.stdout == (
        "challenge rooms: 2 sequences, phase public open; phase final opens 2126-01-01 00:00 UTC\n"
    ), created.output
    return folder / "data"


@pytest.fixture
def data(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A data root of the test's own; evaluations need no process."""
    engine = InThisProcess()
    monkeypatch.setattr(Evaluations, "measure", lambda _, *arguments: engine.measure(*arguments))
    return Path(shutil.copytree(made, tmp_path / "data"))


def call(data: Path, *arguments: str) -> Result:
    return CliRunner().invoke(main, ["--data", str(data), "challenge", *arguments])


def read(data: Path, *arguments: str) -> Any:
    return json.loads(call(data, *arguments, "--json").stdout)


def write_entry(folder: Path, sigma_m: float = 0.02) -> str:
    folder.mkdir()
    for name, content in entry_of(2, sigma_m).items():
        (folder / name).write_bytes(content)
    return str(folder)


def wait_for_the_minute(data: Path) -> None:
    """Let results be shown now that wait for the next full minute."""
    past = (datetime.now(UTC) - timedelta(hours=1)).isoformat()
    for path in data.glob("challenges/*/submissions/*/result.json"):
        path.write_text(json.dumps({**json.loads(path.read_text()), "shown_at": past}))


def test_a_challenge_from_its_file_to_its_ranking(data: Path, tmp_path: Path):
    (brief,) = read(data, "list")
    assert (brief["name"], brief["open_phases"]) == ("rooms", ["public"])
    shown = call(data, "show", "rooms").stdout
    assert "999.500 to 1003.500 s" in shown
    assert Challenge.read(read(data, "show", "rooms")).metric == "ate.rmse"
    files = write_entry(tmp_path / "mine")
    assert call(data, "submit", "rooms", files, "--team", "a", "--dry-run").stdout.startswith("room-0: 300 poses\n")
    sent = call(data, "submit", "rooms", files, "--team", "a")
    assert re.fullmatch(r"submission \d{8}-[0-9a-f]{12} of team a to phase public is queued\n", sent.stdout)
    evaluated = call(data, "evaluate")
    assert (evaluated.stdout, "next full minute" in evaluated.stderr) == ("1 submission evaluated\n", True)
    wait_for_the_minute(data)
    (entry,) = read(data, "status", "rooms", "--team", "A")
    assert ChallengeSubmission.read(entry).state == "evaluated"
    ranking = ChallengeRanking.read(read(data, "ranking", "rooms"))
    assert [(team.rank, team.team) for team in ranking.teams] == [(1, "a")]
    table = call(data, "ranking", "rooms")
    assert re.search(r"^ +1 +a +0\.0\d+ +0\.0\d+ to 0\.0\d+ ", table.stdout, re.MULTILINE)
    assert "Student's paired t test" in table.stderr


def test_phases_end_by_commands(data: Path, tmp_path: Path):
    moved = call(data, "phase", "rooms", "public", "--ends", "2100-01-01T00:00+00:00")
    assert "phase public open until 2100-01-01 00:00 UTC" in moved.stdout
    assert call(data, "close", "rooms").stdout == "challenge rooms: phase public ended; phase final ended\n"
    refused = call(data, "submit", "rooms", write_entry(tmp_path / "mine"), "--team", "a")
    assert (refused.exit_code, refused.stderr) == (
        1,
        "error: no phase of challenge rooms is open; its page says when one opens\n",
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("show", "room"), "unknown challenge 'room'; did you mean 'rooms'?"),
        (("ranking", "rooms", "--phase", "finals"), "unknown phase 'finals'; did you mean 'final'?"),
        (("phase", "rooms", "public", "--ends", "tomorrow"), "'tomorrow' is no time"),
        (("phase", "rooms", "public", "--ends", "2100-01-01"), "2100-01-01 lacks its UTC offset"),
        (("submit", "rooms", __file__, "--team", "a"), "test_cli_challenge.py belongs to no sequence"),
        (("create", __file__), "test_cli_challenge.py"),
    ],
)
def test_mistakes_are_one_line(made: Path, arguments: tuple[str, ...], words: str):
    result = call(made, *arguments)
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert words in line


def test_an_empty_installation_says_how_to_begin(data: Path):
    shutil.rmtree(data / "challenges")
    assert "slamhive challenge create FILE" in " ".join(call(data, "list").stderr.split())


def test_the_file_in_the_documentation_is_a_challenge(tmp_path: Path):
    page = (project_root() / "docs" / "challenges.md").read_text()
    path = tmp_path / "corridors.yaml"
    path.write_text(page.partition("```yaml\n")[2].partition("```")[0])
    definition = load_definition(path)
    assert [entry.name for entry in definition.file.phases] == ["public", "final"]
    known = set(type(definition.file).model_fields)
    named = set(re.findall(r"`(\w+)`", page.partition("## The file")[2].partition("## Presets")[0]))
    assert known - {"format"} <= named
