"""``slamhive configuration``: what it prints, and its one line for each mistake."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration


class Command:
    """``slamhive configuration`` with arguments."""

    def __call__(self, *arguments: str, text: str | None = None) -> Result:
        return CliRunner().invoke(main, ("configuration", *arguments), input=text)

    def json(self, *arguments: str) -> Any:
        return json.loads(self(*arguments, "--json").stdout)


@pytest.fixture
def configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sqlite_template: Path) -> Command:
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)
    return Command()


def test_from_making_to_running(configuration: Command):
    made = configuration("create", "tiny", "track", "--set", "seconds=1", "--name", "one s", "--group", "quick")
    assert made.stdout == "configuration 1 (one s) is new\n"
    assert configuration("create", "tiny", "track", "--set", "seconds=1.0").stdout == (
        "the same as configuration 1 (one s)\n"
    )
    copied = configuration.json("copy", "one s", "--set", "seconds=2", "--note", "slower")
    assert (copied["id"], copied["created"], copied["note"]) == (2, True, "slower")
    (run,) = configuration.json("run", "2", "--seed", "7")
    assert (run["configuration"], run["seed"], run["parameters"]["seconds"]) == (2, 7, 2.0)
    shown = configuration("show", "2").stdout
    assert shown.startswith("configuration 2: tiny on track\n")
    assert "slower" in shown
    assert "queued" in shown
    assert configuration.json("show", "2")["latest_runs"] == [1]


def test_lists_filter_and_compare_along_one_axis(configuration: Command):
    for seconds in ("1", "2", "3"):
        configuration("create", "tiny", "track", "--set", f"seconds={seconds}")
    configuration("group", "some", "1", "3")
    assert [entry["id"] for entry in configuration.json("list")] == [3, 2, 1]
    assert [entry["id"] for entry in configuration.json("list", "--where", "seconds>=2", "--group", "some")] == [3]
    assert configuration.json("groups") == {"some": 2}
    listing = configuration("list", "--show", "seconds", "--limit", "2")
    assert listing.stdout.splitlines()[0].split()[:5] == ["id", "name", "algorithm", "dataset", "seconds"]
    assert "2 of 3 configurations; continue with --after 2" in listing.stderr
    assert [entry["id"] for entry in configuration.json("list", "--after", "2")] == [1]
    assert configuration("group", "some", "1", "3", "--remove").stdout == "some: 0 configurations\n"


def test_changing_and_deleting(configuration: Command):
    configuration("create", "tiny", "track", "--name", "mine")
    changed = configuration("modify", "mine", "--set", "seconds=2")
    assert changed.stdout == "configuration 2 (mine) is new\n"
    assert "configuration 1 (mine) is gone: nothing depended on it" in changed.stderr
    configuration("run", "mine", "--executor", "process")
    again = configuration("modify", "mine", "--set", "seconds=3")
    assert "configuration 2 (mine) stays as it is: it has 1 run" in again.stderr
    assert configuration("delete", "3").stdout == "configuration 3 is deleted\n"
    refused = configuration("delete", "mine")
    assert (refused.exit_code, refused.stdout) == (1, "")
    assert "configuration 2 (mine) has 1 run; a configuration with runs must stay" in refused.stderr


def test_yaml_out_and_in(configuration: Command, tmp_path: Path):
    configuration("create", "tiny", "track", "--set", "seconds=2", "--name", "two")
    text = configuration("export", "two").stdout
    assert configuration("export", "two", "--output", str(tmp_path / "two.yaml")).stdout.startswith("wrote ")
    assert (tmp_path / "two.yaml").read_text() == text
    configuration("delete", "two")
    assert configuration("import", str(tmp_path / "two.yaml")).stdout == "configuration 1 (two) is new\n"
    assert configuration("import", "-", text=text).stdout == "the same as configuration 1 (two)\n"
    published = "slam-hive-algorithm: tiny\nslam-hive-dataset: track\nalgorithm-parameters: {viewer: 0}\n"
    told = configuration("import", "-", "--name", "old", text=published)
    assert told.stdout == "configuration 2 (old) is new\n"
    assert "algorithm-parameters viewer=0 is not taken over" in told.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("show", "7"), "unknown configuration 7"),
        (("show", "9" * 30), "unknown configuration 999"),
        (("show", "mine"), "unknown configuration 'mine'"),
        (("create", "tinny", "track"), "did you mean 'tiny'?"),
        (("create", "tiny", "track", "--set", "second=1"), "did you mean 'seconds'?"),
        (("create", "tiny", "track", "--rate", "nan"), "playback rate nan is not allowed"),
        (("create", "tiny", "track", "--name", "3"), "configuration name '3' is not allowed"),
        (("create", "tiny", "track", "--name", "taken", "--set", "seconds=3"), "the name 'taken' belongs to config"),
        (("copy", "taken", "--step", "rate every=2", "--no-steps"), "--step and --no-steps are given"),
        (("copy", "taken", "--step", "rate hz=99"), "step rate: 99 Hz is above the 10 Hz"),
        (("copy", "taken", "--algorithm", "nope"), "unknown algorithm 'nope'"),
        (("delete", "taken", "9"), "unknown configuration 9"),
        (("list", "--where", "seconds"), "is not NAME=VALUE"),
        (("list", "--where", "second=1"), "did you mean 'seconds'?"),
        (("list", "--after", "x"), "unknown page key 'x'"),
        (("list", "--group", "none"), "unknown group 'none'"),
        (("group", "g", "9"), "unknown configuration 9"),
        (("group", "g", "taken", "--remove"), "configuration 1 is not in the group 'g'"),
        (("import", "/nowhere/x.yaml"), "/nowhere/x.yaml cannot be read"),
        (("import", "/bin/true"), "/bin/true is not UTF-8 text"),
        (("export", "taken", "--output", "/nowhere/x.yaml"), "/nowhere/x.yaml cannot be written"),
        (("run", "taken", "--repeat", "0"), "repeat 0 is not allowed"),
    ],
)
def test_each_mistake_gets_one_line_and_changes_nothing(configuration: Command, arguments: Any, message: str):
    configuration("create", "tiny", "track", "--name", "taken")
    before = configuration.json("list")
    result = configuration(*arguments)
    assert (result.exit_code, result.stdout) == (1, "")
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert configuration.json("list") == before
