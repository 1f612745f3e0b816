"""What the command line says of a dataset."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slamhive.cli import main
from tests.recordings.format_world import make_kitti_360
from tests.recordings.test_kitti_odometry import sequence
from tests.services.tiny_project import environment, make_dataset, make_project

pytestmark = pytest.mark.integration

__all__ = ["sequence"]


@pytest.fixture
def slamhive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    make_project(tmp_path / "project")
    make_dataset(tmp_path / "data")
    for key, value in environment(tmp_path / "project", tmp_path / "data").items():
        monkeypatch.setenv(key, value)

    def call(*arguments: str) -> Result:
        return CliRunner().invoke(main, arguments)

    return call


def test_show_prints_calibration_and_ground_truth(slamhive):
    shown = slamhive("dataset", "show", "track").stdout
    assert "ground truth: groundtruth.txt, z axis up" in shown
    assert "T_body_sensor  1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1" in shown


def test_show_tells_lever_arm_and_uncertainty_of_the_ground_truth(slamhive, tmp_path):
    path = tmp_path / "data" / "datasets" / "track" / "dataset.yaml"
    more = "positions_only: true\n  lever_arm_m: [0.1, 0, -0.2]\n  uncertainty_m: 0.01"
    path.write_text(path.read_text().replace("positions_only: false", more))
    shown = slamhive("dataset", "show", "track").stdout
    assert "z axis up, positions only, lever arm 0.1 0 -0.2 m, uncertainty 0.01 m" in shown


def test_json_holds_extrinsics_gravity_and_attributes(slamhive):
    shown = json.loads(slamhive("dataset", "show", "track", "--json").stdout)
    assert len(shown["sensors"][0]["T_body_sensor"]) == 16
    assert shown["groundtruth"] == {
        "file": "groundtruth.txt",
        "exists": True,
        "gravity_aligned": True,
        "positions_only": False,
        "source": "",
    }
    assert shown["attributes"] == []


def test_a_ground_truth_that_is_not_there_is_said(slamhive, tmp_path):
    (tmp_path / "data" / "datasets" / "track" / "groundtruth.txt").unlink()
    assert slamhive("dataset", "list").stdout.rstrip().endswith("file missing")
    assert "groundtruth.txt, the file is missing, z axis up" in slamhive("dataset", "show", "track").stdout
    assert json.loads(slamhive("dataset", "list", "--json").stdout)[0]["groundtruth"]["exists"] is False


def test_what_is_left_out_stays_on_one_line(slamhive, tmp_path):
    path = tmp_path / "data" / "datasets" / "track" / "dataset.yaml"
    path.write_text(path.read_text().replace("duration_s: ", "duration_s: .inf #"))
    (line,) = [text for text in slamhive("dataset", "list").stderr.splitlines() if "left out" in text]
    assert "dataset.yaml line 9: duration_s: inf is not a finite number" in line


def test_the_format_of_a_recording_is_found_out(slamhive, sequence, tmp_path):
    made = slamhive("dataset", "import", str(sequence), "--name", "found")
    assert made.exit_code == 0, made.stderr
    assert "cam0" in slamhive("dataset", "show", "found").stdout
    (tmp_path / "empty").mkdir()
    refused = slamhive("dataset", "import", str(tmp_path / "empty"), "--name", "other")
    assert refused.exit_code == 1
    assert "is in no format that can be imported; known formats: " in refused.stderr
    assert "kitti-odometry" in refused.stderr
    assert not (tmp_path / "data" / "datasets" / "other").exists()


def test_show_tells_the_motion_and_draws_it(slamhive, tmp_path):
    picture = tmp_path / "track.png"
    shown = slamhive("dataset", "show", "track", "--plot", str(picture))
    assert shown.exit_code == 0, shown.output
    assert "m/s on average" in shown.stdout
    assert picture.read_bytes().startswith(b"\x89PNG")
    motion = json.loads(slamhive("dataset", "show", "track", "--json").stdout)["motion"]
    assert motion["length_m"] > 0
    refused = slamhive("dataset", "show", "track", "--plot", str(tmp_path / "track.bmp"))
    assert refused.exit_code == 1
    assert "use .png, .svg or .pdf" in refused.stderr


def test_export_lists_what_it_leaves_out_and_prints_the_folder(slamhive, sequence, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert slamhive("dataset", "import", str(sequence), "--name", "kitti").exit_code == 0
    refused = slamhive("dataset", "export", "kitti", "--format", "tum-rgbd")
    assert refused.exit_code == 1
    assert "dataset kitti has no depth, which tum-rgbd is about" in refused.stderr
    whole = slamhive("dataset", "export", "kitti", "--format", "mcap")
    assert whole.stdout.strip() == str(tmp_path / "kitti-mcap")
    assert (tmp_path / "kitti-mcap" / "kitti.mcap").is_file()
    again = slamhive("dataset", "export", "kitti", "--format", "mcap")
    assert "kitti-mcap exists already" in again.stderr
    shown = slamhive(
        "dataset", "export", "kitti", "--format", "euroc", "--partial", "--to", str(tmp_path / "e"), "--json"
    )
    assert json.loads(shown.stdout)["left_out"] == ["lidar0 (lidar)"]
    assert (tmp_path / "e" / "mav0" / "cam0" / "data.csv").is_file()


def test_the_first_line_says_that_nobody_tried_a_published_recording(slamhive, sequence, tmp_path):
    source = make_kitti_360(tmp_path)
    first = slamhive("dataset", "import", str(source), "--preview").stdout.splitlines()[0]
    assert "kitti-360 (experimental: transforms as in kitti360scripts, never tried with a published recording)" in first
    shown = json.loads(slamhive("dataset", "import", str(source), "--preview", "--json").stdout)
    assert shown["experimental"].startswith("transforms as in")
    assert "experimental" not in slamhive("dataset", "import", str(sequence), "--preview").stdout
