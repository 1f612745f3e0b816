"""What holds for every format of folders: it is detected, becomes a valid dataset, and equals itself."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.importers.registry import detect_format
from slamhive.trajectory.layout import read_tum
from tests.recordings.format_world import FORMATS, convert, options_of, plan, recorded
from tests.recordings.range_formats import RANGE_FORMATS

pytestmark = pytest.mark.quick
ALL = {**FORMATS, **RANGE_FORMATS}


def made(name: str, folder: Path) -> tuple[Path, dict[str, Any]]:
    source = ALL[name](folder)
    return source, {"accept_loss": True, **options_of(name, source)}


@pytest.mark.integration
@pytest.mark.parametrize("name", ALL)
def test_a_folder_is_detected_and_becomes_the_same_dataset_twice(tmp_path, name):
    source, options = made(name, tmp_path / "source")
    assert detect_format(source) == name
    dataset = convert(source, tmp_path / "a" / "made", **options)
    assert load_dataset(dataset.folder) == dataset
    assert dataset.title
    assert dataset.groundtruth is not None
    truth = read_tum(dataset.folder / "groundtruth.txt")
    seen = recorded(dataset)
    for sensor in dataset.sensors:
        stamps_s = [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in seen[sensor.topic]]
        assert stamps_s == sorted(stamps_s)
        assert truth.stamps_s[0] <= stamps_s[-1]
        assert truth.stamps_s[-1] >= stamps_s[0]
    assert convert(source, tmp_path / "b" / "made", **options).checksum == dataset.checksum


def test_what_is_no_recording_is_refused_with_what_helps(tmp_path):
    drive = FORMATS["kitti-raw"](tmp_path / "day")
    with pytest.raises(InvalidInput, match=f"looks like kitti-raw .* give {drive.name} .kitti-raw. in it, add what"):
        detect_format(drive.parent)
    (tmp_path / "many").mkdir()
    FORMATS["7-scenes"](tmp_path / "many" / "seq-01")
    with pytest.raises(InvalidInput, match=r"many is no recording; give seq-01 \(7-scenes\) in it"):
        detect_format(tmp_path / "many")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "1.txt").write_text("1 0 0 0 0 0 0 1\n")
    with pytest.raises(InvalidInput, match=r"known formats: .*; trajectories come in with `slamhive runs import`"):
        detect_format(tmp_path / "run")
    (tmp_path / "desk.tar.gz").touch()
    with pytest.raises(InvalidInput, match="unpack the archive, and give the file or folder in it"):
        detect_format(tmp_path / "desk.tar.gz")


def test_a_file_that_may_be_the_ground_truth_is_named(tmp_path):
    source = FORMATS["euroc"](tmp_path / "V1_01")
    shutil.rmtree(source / "mav0" / "state_groundtruth_estimate0")
    (source / "groundtruth_tum.txt").touch()
    assert plan(source).notes[-1] == (
        "there is no ground truth: runs get no ATE (--groundtruth FILE adds one; groundtruth_tum.txt may be it)"
    )
