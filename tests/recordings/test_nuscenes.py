"""Scenes of nuScenes: the tables are followed to files, poses and calibration."""

import json

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import LidarLayout
from slamhive.recordings.importers import nuscenes
from slamhive.runtime.messages import to_points
from slamhive.runtime.point_times import SweepInstant
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import rotations_from_quats
from tests.recordings.format_world import NUSCENES_SCENE, convert, cut, plan, recorded, rewrite, write
from tests.recordings.range_formats import NUSCENES_START_US, make_nuscenes

pytestmark = pytest.mark.quick


def test_a_scene_has_the_poses_and_points_of_the_development_kit(tmp_path):
    """The numbers are those of nuscenes-devkit 1.2.0 on the same files: ``ego_pose`` times ``calibrated_sensor``."""
    dataset = convert(make_nuscenes(tmp_path / "given"), tmp_path / "made", sequence=NUSCENES_SCENE)
    assert [sensor.name for sensor in dataset.sensors] == ["cam0", "cam3", "lidar0"]
    truth = read_tum(dataset.folder / "groundtruth.txt")
    assert len(truth.stamps_s) == 8
    scan = 3
    T_map_body = np.eye(4)
    T_map_body[:3, :3] = rotations_from_quats(truth.quats_xyzw)[scan]
    T_map_body[:3, 3] = truth.positions_m[scan]
    T_body_lidar = np.array(dataset.sensor("lidar0").T_body_sensor).reshape(4, 4)
    assert truth.stamps_s[scan] == pytest.approx(1532402927.75)
    assert (T_map_body @ T_body_lidar)[:3] == pytest.approx(np.array([
        [0.551193615, 0.834377372, 0, 603.925784],
        [-0.834377372, 0.551193615, 0, 1597.39105],
        [0, 0, 1, 2],
    ]), abs=1e-8, rel=1e-8)  # fmt: skip
    seen = recorded(dataset)
    cloud = to_points(seen["/points"][scan])
    assert [*cloud.points_m[2], cloud.field("intensity")[2]] == pytest.approx([1.0, 1.1, 1.2, 1.3])
    assert cloud.field("ring").tolist() == [0, 1, 2, 3, 4, 5]
    assert LidarLayout.of(dataset.sensor("lidar0")).times.stamp is SweepInstant.END
    # The car turned by 0.2 rad and moved by 2 m until the third image.
    turn = np.array([[np.cos(0.2), -np.sin(0.2), 0], [np.sin(0.2), np.cos(0.2), 0], [0, 0, 1]])
    T_body_camera = np.array(dataset.sensor("cam0").T_body_sensor).reshape(4, 4)
    assert turn @ T_body_camera[:3, :3] == pytest.approx(np.array([
        [0.198669331, 0, 0.980066578], [-0.980066578, 0, 0.198669331], [0, -1, 0]
    ]), abs=1e-8)  # fmt: skip
    assert turn @ T_body_camera[:3, 3] + [602, 1598, 0.5] == pytest.approx([603.940266, 1598.49535, 2.0])
    stamp = seen["/cam0/image_raw"][2].header.stamp
    assert stamp.sec * 10**6 + stamp.nanosec // 1000 == NUSCENES_START_US + 207_000


def test_a_scene_is_named_where_there_are_several(tmp_path):
    root = make_nuscenes(tmp_path / "given")
    with pytest.raises(InvalidInput, match=r"has 2 scenes; name one with --sequence: scene-0061, scene-0103"):
        plan(root)
    with pytest.raises(InvalidInput, match=r"none called 'x'"):
        plan(root, sequence="x")
    with pytest.raises(InvalidInput, match="no camera or LiDAR belongs to scene scene-0103"):
        plan(root, sequence="scene-0103")


def test_files_that_are_not_unpacked_are_a_loss_or_leave_the_sensor_out(tmp_path):
    root = make_nuscenes(tmp_path / "given")
    for path in root.glob("*/CAM_BACK/*"):
        path.unlink()
    found = plan(root, sequence=NUSCENES_SCENE)
    assert "CAM_BACK is left out: none of its 4 files is there" in found.notes
    next(root.glob("sweeps/CAM_FRONT/*")).unlink()
    with pytest.raises(InvalidInput, match=r"1 of 4 files of CAM_FRONT are missing.*25% is lost"):
        plan(root, sequence=NUSCENES_SCENE)
    assert plan(root, sequence=NUSCENES_SCENE, accept_loss=True).counts == {"cam0": 3, "lidar0": 8}


def test_a_table_is_read_in_pieces_as_it_is_read_at_once(tmp_path, monkeypatch):
    root = make_nuscenes(tmp_path / "given")
    path = root / "v1.0-mini" / "sample_data.json"
    monkeypatch.setattr(nuscenes, "_CHUNK_CHARACTERS", 7)
    assert list(nuscenes._objects(path)) == json.loads(path.read_text())


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        (rewrite("v1.0-mini/sample_data.json", r'"samples/', '"../samples/'), "is no file below the dataset"),
        (rewrite("v1.0-mini/sample_data.json", r'"samples/', '"/etc/'), "is no file below the dataset"),
        (rewrite("v1.0-mini/sample_data.json", '"timestamp": 1', '"timestamp": "1'), "is no list of records"),
        (rewrite("v1.0-mini/sample_data.json", '"timestamp": 1', '"time": 1'), "record 1 has no proper timestamp"),
        (rewrite("v1.0-mini/sample_data.json", r"(?s)\]\s*$", ""), "sample_data.json is no list of records"),
        (rewrite("v1.0-mini/sample.json", r"(?s).*", "{}"), "sample.json is no list of records"),
        (rewrite("v1.0-mini/sample.json", r"(?s).*", "[1]"), "sample.json is no list of records"),
        (lambda root: (root / "v1.0-mini/sensor.json").unlink(), "sensor.json cannot be read: No such file"),
        (rewrite("v1.0-mini/ego_pose.json", '"d03"', '"gone"'), "ego_pose.json lacks 1 of 8 poses"),
        (rewrite("v1.0-mini/ego_pose.json", r"\n600\.0", "\nNaN"), "translation of pose 'd00' is not 3 finite numbers"),
        (rewrite("v1.0-mini/calibrated_sensor.json", "0.8", "1.8"), "quaternion of .* LIDAR_TOP has norm"),
        (rewrite("v1.0-mini/calibrated_sensor.json", r"20\.0", "0.0"), "CAM_FRONT has focal lengths 0, 20.5"),
        (rewrite("v1.0-mini/calibrated_sensor.json", r"20\.5,", '"a",'), "camera_intrinsic of CAM_FRONT is not 9"),
        (cut(f"samples/LIDAR_TOP/n015-{NUSCENES_START_US}.pcd.bin", 30), "has 30 bytes, not a multiple of 20"),
    ],
)
def test_a_mistake_in_a_scene_is_one_clear_line(tmp_path, damage, problem):
    source = make_nuscenes(tmp_path / "given")
    damage(source)
    with pytest.raises(InvalidInput, match=problem) as caught:
        convert(source, tmp_path / "made", sequence=NUSCENES_SCENE)
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "made").exists()


def test_a_version_that_is_there_twice_is_said(tmp_path):
    root = make_nuscenes(tmp_path / "given")
    write(root / "v1.0-trainval" / "scene.json", json.dumps([{"token": "t", "name": NUSCENES_SCENE}]))
    with pytest.raises(InvalidInput, match="scene scene-0061 is in several versions"):
        plan(root, sequence=NUSCENES_SCENE)
