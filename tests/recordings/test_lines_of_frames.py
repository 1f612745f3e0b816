"""Formats that pair lines with files: line n belongs to file n, and hidden files are no frames."""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.recordings.importers.registry import detect_format
from slamhive.recordings.importing import PlannedTruth
from slamhive.runtime.messages import to_points
from slamhive.trajectory.kitti import read_kitti, read_kitti_matrices
from tests.cases import case
from tests.recordings.format_world import FORMATS, KITTI_360, convert, plan, recorded, write
from tests.recordings.test_folder_formats import ALL, made

pytestmark = pytest.mark.quick


def stamps_s(seen, topic):
    return [message.header.stamp.sec + message.header.stamp.nanosec * 1e-9 for message in seen[topic]]


def truth_of(source: Path) -> PlannedTruth:
    truth = plan(source).truth
    assert truth is not None
    return truth


def empty_line(path: Path, number: int) -> None:
    lines = path.read_text().splitlines()
    lines[number] = ""
    path.write_text("\n".join(lines) + "\n")


def test_blank_lines_of_kitti_raw_stand_for_missing_scans(tmp_path):
    drive = FORMATS["kitti-raw"](tmp_path)
    empty_line(drive / "velodyne_points/timestamps.txt", 1)
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    made = plan(drive)
    assert made.counts["lidar0"] == 3
    assert not any("velodyne_points" in note for note in made.notes)
    seen = recorded(convert(drive, tmp_path / "made"))
    fractions = [stamp % 1 for stamp in stamps_s(seen, "/points")]
    assert fractions == pytest.approx([0.100123, 0.300123, 0.400123], abs=1e-5)


def test_blank_lines_of_kitti_360_stand_for_missing_scans(tmp_path):
    root = FORMATS["kitti-360"](tmp_path)
    scans = root / "data_3d_raw" / KITTI_360 / "velodyne_points"
    whole = stamps_s(recorded(convert(root, tmp_path / "whole")), "/points")
    empty_line(scans / "timestamps.txt", 1)
    (scans / "data" / f"{1:010d}.bin").unlink()
    found = stamps_s(recorded(convert(root, tmp_path / "made")), "/points")
    assert found == [whole[0], *whole[2:]]


def test_a_file_of_kitti_raw_without_time_is_named(tmp_path):
    drive = FORMATS["kitti-raw"](tmp_path)
    empty_line(drive / "velodyne_points/timestamps.txt", 3)
    assert (
        "1 files of velodyne_points have no time in timestamps.txt and are left out"
        in plan(drive, accept_loss=True).notes
    )


def test_a_real_drive_with_missing_scans_is_on_time(tmp_path):
    source = case("kitti_raw_blank_timestamps") / "in" / "2011_09_26_drive_0009_sync"
    seen = recorded(convert(source, tmp_path / "made"))
    assert len(seen["/points"]) == 17
    first_s = stamps_s(seen, "/imu0")[0]
    for message, stamp_s in zip(seen["/points"], stamps_s(seen, "/points"), strict=True):
        frame = round(float(to_points(message).field("intensity")[0]) * 100)
        assert stamp_s - first_s == pytest.approx(0.1033 * frame, abs=1e-4)


def make_kitti_odometry(folder: Path, frames: list[int], lines: int) -> Path:
    times = [f"{0.1 * line:.1f}" if line in frames else "" for line in range(lines)]
    write(folder / "times.txt", *times)
    write(
        folder / "calib.txt", *(f"P{n}: 20 0 15 0 0 20 11 0 0 0 1 0" for n in range(4)), "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"
    )
    write(folder / "poses.txt", *(f"1 0 0 {line} 0 1 0 0 0 0 1 0" for line in range(lines)))
    (folder / "velodyne").mkdir()
    for frame in frames:
        points = np.full((5, 4), frame / 100, dtype="<f4")
        (folder / f"velodyne/{frame:06d}.bin").write_bytes(points.tobytes())
    return folder


def test_blank_times_of_kitti_odometry_stand_for_missing_scans(tmp_path):
    source = make_kitti_odometry(tmp_path / "07", [0, 1, 4, 5], 6)
    made = plan(source)
    assert made.counts == {"lidar0": 4}
    assert made.truth is not None
    assert made.truth.positions_m[:, 0].tolist() == [0, 1, 4, 5]
    assert made.truth.times_s.tolist() == pytest.approx([0, 0.1, 0.4, 0.5])
    assert any("2 lines of times.txt are blank" in note for note in made.notes)
    (source / "velodyne/000004.bin").rename(source / "velodyne/000003.bin")
    with pytest.raises(InvalidInput, match=r"no frame 4 .* line 5"):
        plan(source)


def test_sensors_of_kitti_odometry_must_have_the_same_frames(tmp_path):
    source = make_kitti_odometry(tmp_path / "07", [0, 1, 2], 3)
    (source / "image_0").mkdir()
    for frame in (0, 1, 3):
        (source / f"image_0/{frame:06d}.png").write_bytes(b"")
    with pytest.raises(InvalidInput, match=r"000003\.png and .*000002\.bin would have the same line"):
        plan(source)


def test_a_blank_pose_of_replica_is_that_of_its_image(tmp_path):
    source = FORMATS["replica"](tmp_path / "source")
    empty_line(source / "traj.txt", 1)
    for path in source.glob("results/*000001*"):
        path.unlink()
    truth = truth_of(source)
    assert truth.times_s.tolist() == pytest.approx([0, 2 / 30, 3 / 30])
    assert truth.positions_m[:, 0].tolist() == [0, 2, 3]


def test_a_blank_pose_of_tartanair_is_that_of_its_image(tmp_path):
    source = FORMATS["tartanair"](tmp_path / "source")
    first, second = (source / "pose_left.txt").read_text().splitlines()
    write(source / "pose_left.txt", first, "", second)
    for path in source.glob("*/000001_*"):
        path.rename(path.with_name(path.name.replace("000001", "000002")))
    truth = truth_of(source)
    assert truth.times_s.tolist() == pytest.approx([0, 0.2])
    assert truth.positions_m[:, 0].tolist() == [0, 1]


def test_poses_of_a_cut_sequence_belong_to_its_images(tmp_path):
    """Images 2 and 3 of four, all poses: line 3 is that of image 2. With two poses, line 1 is."""
    source = FORMATS["replica"](tmp_path / "source")
    for path in [*source.glob("results/*00000[01]*")]:
        path.unlink()
    truth = truth_of(source)
    assert (truth.times_s[0], truth.positions_m[0, 0]) == (0, 0)
    write(source / "traj.txt", *(source / "traj.txt").read_text().splitlines()[2:])
    truth = truth_of(source)
    assert (truth.times_s[0], truth.positions_m[0, 0]) == (pytest.approx(2 / 30), 2)
    write(source / "traj.txt", *(source / "traj.txt").read_text().splitlines()[:1])
    with pytest.raises(InvalidInput, match="1 poses, there are 2 images from number 2 to 3"):
        plan(source)


def test_lines_of_kitti_poses_and_times_are_paired_by_number(tmp_path):
    poses, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    write(poses, *(f"1 0 0 {line} 0 1 0 0 0 0 1 0" if line != 1 else "" for line in range(5)))
    write(times, *(f"{0.1 * line:.1f}" if line != 3 else "" for line in range(5)))
    found = read_kitti(poses, times)
    assert found.stamps_s.tolist() == pytest.approx([0, 0.2, 0.4])
    assert found.positions_m[:, 0].tolist() == [0, 2, 4]
    write(times, "0", "0.1", "0.2", "0.3")
    with pytest.raises(InvalidInput, match=r"4 poses and 1 blank lines, .* has 4 timestamps"):
        read_kitti(poses, times)
    with pytest.raises(InvalidInput, match="before line 3 is blank"):
        read_kitti_matrices(poses)


@pytest.mark.parametrize("name", sorted(ALL))
def test_hidden_files_are_no_frames(tmp_path, name):
    source, options = made(name, tmp_path / "source")
    before = plan(source, **options)
    clutter_beside_all(source if source.is_dir() else source.parent)
    after = plan(source, **options)
    assert (after.counts, after.notes) == (before.counts, before.notes)
    assert detect_format(source) == name


def clutter_beside_all(root: Path) -> None:
    for path in [*root.rglob("*")]:
        if path.is_file():
            path.with_name(f"._{path.name}").write_bytes(b"\0\5\26\7Mac OS X")
    for folder in [root, *(path for path in root.rglob("*") if path.is_dir())]:
        for name in (".DS_Store", "Thumbs.db"):
            (folder / name).write_bytes(b"Bud1")


def test_a_drive_that_macos_copied_is_read(tmp_path):
    with tarfile.open(case("appledouble_kitti_raw") / "in.tar.gz") as archive:
        archive.extractall(tmp_path)
    made = plan(tmp_path / "in" / "2011_09_26_drive_0009_sync")
    assert made.counts["lidar0"] == made.counts["imu0"] == 20
