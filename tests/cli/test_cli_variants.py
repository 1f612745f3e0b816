"""``slamhive variants``: what it prints, in words and in JSON, and its exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.services.recorded_track import make_recorded_track
from tests.services.tiny_project import environment, make_project

pytestmark = pytest.mark.integration


@pytest.fixture
def slamhive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make_project(tmp_path / "project")
    make_recorded_track(tmp_path / "data")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)

    def call(*arguments: str) -> Result:
        return CliRunner().invoke(main, ["variants", *arguments])

    return call


def test_steps_and_their_options():
    def call(*arguments: str) -> Result:
        return CliRunner().invoke(main, ["variants", "steps", *arguments])

    listed = call().stdout
    assert "gaussian_noise" in listed
    assert "time_offset" in listed
    shown = call("fog").stdout
    assert "visibility_m" in shown
    assert "required" in shown
    kinds = {entry["kind"]: entry for entry in json.loads(call("--json").stdout)}
    assert {option["name"]: option["unit"] for option in kinds["fog"]["options"]}["visibility_m"] == "m"
    assert "unknown pre-processing step 'frog'; did you mean 'fog'?" in call("frog").stderr


def test_the_life_of_a_variant(slamhive, tmp_path):
    assert "no variants" in slamhive("list").stderr
    made = json.loads(slamhive("make", "track", "--step", "rate every=2", "--json").stdout)
    assert (made["dataset"], made["in_use"]) == ("track", False)
    assert made["steps"] == [{"kind": "rate", "sensors": ["lidar"], "options": {"every": 2}}]
    again = slamhive("make", "track", "--step", "rate@lidar every=2")
    assert made["key"] in again.stdout
    (listed,) = json.loads(slamhive("list", "--dataset", "track", "--json").stdout)
    assert (listed["key"], listed["size_bytes"]) == (made["key"], made["size_bytes"])
    assert json.loads(slamhive("list", "--dataset", "other", "--json").stdout) == []
    assert "rate of lidar (every 2)" in slamhive("list").stdout
    whole = slamhive("verify")
    assert (whole.exit_code, whole.stdout) == (0, "1 of 1 variants are whole\n")

    bag = tmp_path / "data" / "variants" / made["key"] / "track.bag"
    content = bytearray(bag.read_bytes())
    content[-1] ^= 1
    bag.write_bytes(content)
    damaged = slamhive("verify", made["key"][:6])
    assert damaged.exit_code == 1
    assert "track.bag has changed since it was written" in damaged.stdout
    (problem,) = json.loads(slamhive("verify", "--json").stdout)
    assert problem["problem"] == "track.bag has changed since it was written"

    dropped = json.loads(slamhive("drop", made["key"][:6], "--json").stdout)
    assert dropped == {"dropped": [made["key"]], "in_use": []}
    assert json.loads(slamhive("list", "--json").stdout) == []


def test_drop_takes_all_of_a_dataset(slamhive):
    for every in (2, 3):
        slamhive("make", "track", "--step", f"rate every={every}")
    assert slamhive("drop", "--dataset", "other").stdout.startswith("0 variants removed")
    assert slamhive("drop", "--all").stdout.startswith("2 variants removed")


def test_mistakes_are_one_line(slamhive):
    expected = {
        ("make", "track"): "these steps change nothing in track",
        ("make", "track", "--step", "rate every=1"): "these steps change nothing in track",
        ("make", "nowhere", "--step", "rate every=2"): "unknown dataset 'nowhere'",
        ("make", "track", "--step", "rate hz=11"): "11 Hz is above the 10 Hz of lidar (/points)",
        ("make", "track", "--step", "resolution@lidar scale=.5"): "resolution cannot be used on lidar",
        ("drop",): "no variant is named",
        ("drop", "abc"): "unknown variant 'abc'",
        ("drop", "abc", "--all"): "keys and a choice of many exclude each other",
        ("verify", "abc"): "unknown variant 'abc'",
    }
    for arguments, message in expected.items():
        result = slamhive(*arguments)
        assert result.exit_code == 1, arguments
        assert message in result.stderr, result.stderr
        assert len(result.stderr.splitlines()) == 1


def test_a_run_takes_steps(slamhive):
    result = CliRunner().invoke(main, ["run", "tiny", "track", "--step", "point_range maximum_m=5", "--json"])
    (run,) = json.loads(result.stdout)
    assert run["variant"] == [
        {"kind": "point_range", "sensors": ["lidar"], "options": {"maximum_m": 5.0, "minimum_m": 0.0}}
    ]


def test_a_dataset_takes_its_variants_along(slamhive):
    slamhive("make", "track", "--step", "rate every=2")
    assert CliRunner().invoke(main, ["dataset", "remove", "track", "--yes"]).exit_code == 0
    assert json.loads(slamhive("list", "--json").stdout) == []
