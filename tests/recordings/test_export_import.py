"""What is exported and imported again is equal, in each format that can hold it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamhive.base.project import project_root
from slamhive.domain.calibration import CameraIntrinsics, ImuNoise
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.exporters import export_dataset, plan_export
from slamhive.recordings.importers.registry import IMPORTERS, detect_format
from slamhive.recordings.importing import ImportOptions, perform
from slamhive.recordings.room import RoomOptions, render_room
from slamhive.recordings.writers import playable_ns
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import rotation_angles_rad, rotations_from_quats
from tests.recordings.storages import content_of

pytestmark = pytest.mark.integration

KITTI_SCANS = project_root().parent / "shared" / "data" / "kitti00_velodyne_6"
ROUNDING = 2e-9
"""Of ground truth, whose files have nine decimals."""


@dataclass(frozen=True)
class Pair:
    """An exporter, the importer of its format, and what the format keeps of the room: new names by old ones.

    ``body`` is the sensor that becomes the body; None if it stays. ``from_start`` says that times start at 0 s.
    ``options`` and ``source`` are what users give to the importer, and what of the folder they import.
    """

    exporter: str
    importer: str
    sensors: dict[str, str]
    body: str | None = None
    from_start: bool = False
    options: Callable[[Path], ImportOptions] = lambda _folder: ImportOptions()
    source: str = ""


def described(folder: Path) -> ImportOptions:
    """What lies beside a recording."""
    return ImportOptions(calibration=(folder / "dataset.yaml",), groundtruth=folder / "groundtruth.txt")


SENSORS = {name: name for name in ("cam0", "cam1", "depth0", "imu0", "lidar0")}
PAIRS = [
    Pair("ros1", "ros1", SENSORS, options=described, source="room.bag"),
    Pair("ros2", "ros2", SENSORS, options=described, source="room"),
    Pair("mcap", "mcap", SENSORS, options=described, source="room.mcap"),
    Pair("euroc", "euroc", {"cam0": "cam0", "cam1": "cam1", "imu0": "imu0"}),
    Pair("tum-rgbd", "tum-rgbd", {"cam0": "cam0", "depth0": "depth0"}, body="cam0"),
    Pair("ros1", "slam-hive", SENSORS),
    Pair("ros2", "slam-hive", SENSORS),
    Pair("mcap", "slam-hive", SENSORS),
    Pair("vslam-lab", "vslam-lab", {name: name for name in ("cam0", "cam1", "depth0", "imu0")}),
    Pair("kitti", "kitti-odometry", {"cam0": "cam0", "cam1": "cam1"}, body="cam0", from_start=True),
]


def silent(_fraction: float, _text: str) -> None:
    pass


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("datasets") / "room"
    return render_room(folder, RoomOptions(duration_s=0.5, width=64, height=48, workers=1), silent)


def export_import(dataset: Dataset, pair: Pair, folder: Path) -> Dataset:
    target = folder / "exported" / dataset.name
    export_dataset(plan_export(dataset, pair.exporter, partial=True), target, silent)
    source = target / pair.source
    assert detect_format(source) == pair.importer
    return perform(IMPORTERS.get(pair.importer).plan(source, pair.options(target)), folder / dataset.name, silent)


def start_ns(dataset: Dataset, sensor: str) -> int:
    return content_of(dataset.bag_path)[dataset.sensor(sensor).topic][0][0]


@pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: f"{pair.exporter}-{pair.importer}")
def test_what_goes_out_comes_back(room, tmp_path, pair):
    made = export_import(room, pair, tmp_path)
    assert {sensor.name for sensor in made.sensors} == set(pair.sensors.values())
    offset_ns = start_ns(room, next(iter(pair.sensors))) if pair.from_start else 0
    T_body = np.eye(4) if pair.body is None else matrix(room.sensor(pair.body))
    for old, new in pair.sensors.items():
        check_sensor(room.sensor(old), made.sensor(new), T_body)
        assert measured(made, new) == [
            (playable_ns(time_ns - offset_ns), content) for time_ns, content in measured(room, old)
        ], f"messages of {old}"
    check_truth(room, made, T_body, offset_ns * 1e-9)


def matrix(sensor: Sensor) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array(sensor.T_body_sensor).reshape(4, 4)


def check_sensor(old: Sensor, new: Sensor, T_old_new_body: Any) -> None:
    np.testing.assert_allclose(matrix(new), np.linalg.solve(T_old_new_body, matrix(old)), atol=1e-12)
    assert new.kind is old.kind
    if old.kind in {SensorKind.CAMERA, SensorKind.DEPTH}:
        before, after = CameraIntrinsics.of(old), CameraIntrinsics.of(new)
        assert [getattr(after, key) for key in ("width", "height", "fx", "fy", "cx", "cy")] == [
            getattr(before, key) for key in ("width", "height", "fx", "fy", "cx", "cy")
        ]
        assert not any(after.distortion)
        assert new.calibration.get("units_per_m") == old.calibration.get("units_per_m")
    if old.kind is SensorKind.IMU:
        assert ImuNoise.of(new) == ImuNoise.of(old)


def measured(dataset: Dataset, sensor: str) -> list[tuple[int, str]]:
    """Times and content of the messages, without the name of the frame, which is that of the sensor."""
    found = content_of(dataset.bag_path)[dataset.sensor(sensor).topic]
    return [(time_ns, content.split("frame_id=", 1)[1].split("]", 1)[1]) for time_ns, content in found]


def check_truth(old: Dataset, new: Dataset, T_old_new_body: Any, offset_s: float) -> None:
    assert old.groundtruth_path is not None
    assert new.groundtruth_path is not None
    before, after = read_tum(old.groundtruth_path), read_tum(new.groundtruth_path)
    at = np.searchsorted(before.stamps_s, after.stamps_s + offset_s - 1e-7)
    np.testing.assert_allclose(before.stamps_s[at], after.stamps_s + offset_s, atol=1e-9)
    if np.array_equal(T_old_new_body, np.eye(4)):
        assert len(after) == len(before)
        np.testing.assert_allclose(after.positions_m, before.positions_m, atol=ROUNDING)
        assert rotation_angles_rad(after.quats_xyzw, before.quats_xyzw).max() < 1e-7
        return
    T = np.array([np.linalg.inv(pose) for pose in poses_of(before, at)]) @ poses_of(after, np.arange(len(after)))
    np.testing.assert_allclose(T, np.broadcast_to(T_old_new_body, T.shape), atol=1e-7)


def poses_of(trajectory: Any, indices: Any) -> Any:
    poses = np.tile(np.eye(4), (len(indices), 1, 1))
    poses[:, :3, :3] = rotations_from_quats(trajectory.quats_xyzw[indices])
    poses[:, :3, 3] = trajectory.positions_m[indices]
    return poses


@pytest.mark.shared_data
def test_real_scans_of_kitti_come_back(tmp_path):
    if not KITTI_SCANS.is_dir():
        pytest.skip(f"{KITTI_SCANS} is not here (shared/data)")
    first = perform(IMPORTERS.get("kitti-odometry").plan(KITTI_SCANS, ImportOptions()), tmp_path / "scans", silent)
    (tmp_path / "again").mkdir()
    second = export_import(first, Pair("kitti", "kitti-odometry", {}), tmp_path / "again")
    assert second.sensors == first.sensors
    assert content_of(second.bag_path) == content_of(first.bag_path)
    check_truth(first, second, np.eye(4), 0.0)
