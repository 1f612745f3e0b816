"""``slamhive dataset check``: the table, the JSON and the exit code."""

from __future__ import annotations

import json

import pytest

from slamhive.packages.dataset_file import load_dataset
from tests.cli.test_cli_datasets import slamhive
from tests.services.recorded_track import make_recorded_track

pytestmark = pytest.mark.integration

__all__ = ["slamhive"]


@pytest.fixture
def recorded(slamhive, tmp_path):
    make_recorded_track(tmp_path / "data", "recorded")
    return slamhive


def test_findings_are_a_table_and_an_error_is_exit_code_1(recorded):
    result = recorded("dataset", "check", "recorded")
    assert result.exit_code == 1
    (line,) = [line for line in result.stdout.splitlines() if "lidar-motion" in line]
    assert line.startswith("error")
    assert "could not be done; --json says why" in result.stderr


def test_json_says_what_was_found_and_what_could_not_be_checked(recorded, tmp_path):
    result = recorded("dataset", "check", "recorded", "--json")
    report = json.loads(result.stdout)
    assert result.exit_code == 1
    assert report["checksum"] == load_dataset(tmp_path / "data" / "datasets" / "recorded").checksum
    finding = next(entry for entry in report["findings"] if entry["check"] == "lidar-motion")
    assert finding["about"] == "lidar"
    assert finding["unit"] == "times the allowed difference"
    assert {"check": "stereo-geometry", "about": "cameras", "reason": "the dataset has no stereo pair"} in report[
        "not_checked"
    ]


def test_a_dataset_without_a_recording_is_refused_in_one_line(slamhive, tmp_path):
    path = tmp_path / "data" / "datasets" / "track" / "dataset.yaml"
    path.write_text("".join(line for line in path.read_text().splitlines(True) if not line.startswith("bag:")))
    result = slamhive("dataset", "check", "track")
    assert result.exit_code == 1
    assert "error: dataset track is a ground truth without a recording" in result.stderr
