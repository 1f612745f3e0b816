"""A mistake in an imported run is told by every command with its remedy, and stays with the evaluation."""

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner

from slamhive.cli import main
from slamhive.domain.verdict import Hint
from slamhive.services.evaluations.service import evaluation_notes
from tests.services.imports.world import write

pytestmark = pytest.mark.integration


def flight(scale: float = 1.0, seed: int = 0) -> str:
    """A flight that turns about all axes; seeds above 0 are off by millimetres."""
    t = np.arange(0.0, 40.0, 0.05)
    noise_m = np.random.default_rng(seed).normal(0, 0.005 if seed else 0.0, (len(t), 3))
    positions_m = np.column_stack([6 * np.sin(t / 4), 5 * np.sin(t / 3 + 1), np.sin(t / 2)]) + noise_m
    half = 0.5 * np.column_stack([0.4 * np.sin(t / 3), 0.5 * np.cos(t / 2), 0.9 * np.sin(t / 4)])
    quats = np.column_stack([half, np.sqrt(1 - (half**2).sum(axis=1))])
    rows = np.column_stack([t + 100, positions_m * scale, quats])
    return "".join(" ".join(f"{value:.6f}" for value in row) + "\n" for row in rows)


@pytest.fixture
def source(tmp_path):
    write(tmp_path / "source" / "seq" / "groundtruth.txt", flight())
    write(tmp_path / "source" / "good" / "seq" / "0.txt", flight(seed=1))
    for trial in range(2):
        write(tmp_path / "source" / "millimetric" / "seq" / f"{trial}.txt", flight(1000.0, seed=2 + trial))
    return tmp_path / "source"


def command(*arguments: object) -> tuple[int, str, str]:
    called = CliRunner().invoke(main, [str(argument) for argument in arguments])
    return called.exit_code, called.stdout, called.stderr


SENTENCE = r"The estimate is \d+(\.\d+)? times as large as the ground truth: it seems to be in millimetres\."


def test_commands_tell_a_mistake_once_with_its_remedy(hive, source):
    code, _, messages = command("runs", "import", source, "--sensors", "stereo")
    assert code == 0
    (line,) = [line for line in messages.splitlines() if "hint for" in line]
    where = "hint for runs 2, 3 (the numbers are those of run 2)"
    assert re.fullmatch(rf"{re.escape(where)}: {SENTENCE} Remedy: write positions in metres\.", line)
    code, shown, messages = command("evaluate", "1", "2", "--json")
    assert [[hint["key"] for hint in run["hints"]] for run in json.loads(shown)] == [[], ["scale"]]
    assert re.search(rf"hint for run 2: {SENTENCE}", messages)
    assert re.search(rf"^hint: {SENTENCE}", command("runs", "show", "2")[1], re.MULTILINE)
    assert "hint: " not in command("runs", "show", "1")[1]
    (evaluation, *_) = json.loads(command("runs", "show", "2", "--json")[1])["evaluations"]
    assert evaluation["hints"][0]["remedy"] == "write positions in metres"


def test_a_lost_database_does_not_lose_it(hive, source):
    command("runs", "import", source, "--sensors", "stereo")
    fingerprint = hive.runs.get(2).protocol.fingerprint
    before = evaluation_notes(hive.runs.folder(2), fingerprint)
    assert before.hints
    assert command("reindex")[0] == 0
    assert evaluation_notes(hive.runs.folder(2), fingerprint) == before


def test_results_of_before_there_were_hints_are_read(hive, source):
    command("runs", "import", source, "--sensors", "stereo")
    path = hive.runs.folder(2).evaluation(hive.runs.get(2).protocol.fingerprint) / "result.json"
    content = json.loads(path.read_text())
    assert content["hints"] == [
        {"key": "scale", "sentence": content["hints"][0]["sentence"], "remedy": "write positions in metres"}
    ]
    for text, hints in (
        (json.dumps({key: value for key, value in content.items() if key != "hints"}), ()),
        (json.dumps({**content, "hints": [{"key": "a", "sentence": "b", "remedy": "c"}]}), (Hint("a", "b", "c"),)),
        (json.dumps({**content, "hints": [{"key": "a"}]}), ()),
        (json.dumps({**content, "hints": 7}), ()),
    ):
        path.write_text(text)
        assert evaluation_notes(hive.runs.folder(2), content["fingerprint"]).hints == hints
