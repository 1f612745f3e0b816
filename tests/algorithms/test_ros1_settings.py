"""What the systems for ROS 1 are told of real sensors and of ``room``, against values written by hand.

The numbers are those of ``room``'s rig, of KITTI's scans and of EuRoC's ``sensor.yaml`` files.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.runtime.ros1.system import NAMESPACE, Ros1System
from tests.algorithms.algorithm_runs import load_module
from tests.algorithms.recorded_configs import SHARED, SHARED_DATA, config_of, sensors_of_dataset

pytestmark = pytest.mark.quick

KITTI = pytest.param("kitti00_velodyne_6", marks=SHARED_DATA)
SWEEPS = {
    # The room's LiDAR gives ring and time (s, from the timestamp at the start of the sweep).
    "room": {
        "ring_field": "ring",
        "time_field": "time",
        "time_unit_s": 1.0,
        "time_zero_s": 0.0,
        "absolute": False,
        "duration_s": 0.1,
        "stamp_fraction": 0.0,
        "clockwise": False,
    },
    # KITTI's has neither, and its timestamp is the middle of the sweep.
    "kitti00_velodyne_6": {
        "ring_field": "",
        "time_field": "",
        "time_unit_s": 1.0,
        "time_zero_s": 0.0,
        "absolute": False,
        "duration_s": 0.1,
        "stamp_fraction": 0.5,
        "clockwise": False,
    },
}


def system(package: str, dataset: str, **parameters: str) -> Ros1System:
    made: Ros1System = load_module(package, "mapping").make(config_of(package, package, dataset, **parameters))
    return made


@pytest.mark.parametrize("dataset", ["room", KITTI])
@pytest.mark.parametrize("package", ["aloam", "loam", "lego-loam"])
def test_lidar_systems_are_told_how_points_lie_and_which_way_the_lidar_turns(package: str, dataset: str) -> None:
    assert system(package, dataset).parameters[NAMESPACE] == SWEEPS[dataset]
    turned = system(package, dataset, rotation="clockwise")
    assert turned.parameters[NAMESPACE] == {**SWEEPS[dataset], "clockwise": True}


@pytest.mark.parametrize(
    ("dataset", "beams", "lowest_deg", "highest_deg"),
    [("room", 32, -30.0, 30.0), pytest.param("kitti00_velodyne_6", 64, -23.75, 2.6, marks=SHARED_DATA)],
)
def test_lidar_systems_are_told_the_beams_of_the_dataset(
    dataset: str, beams: int, lowest_deg: float, highest_deg: float
) -> None:
    told = system("loam", dataset).parameters["/multiScanRegistration"]
    assert (told["nScanRings"], told["minVerticalAngle"], told["maxVerticalAngle"]) == (beams, lowest_deg, highest_deg)
    own = system("loam", dataset, lowest_deg="-20").parameters["/multiScanRegistration"]
    assert (own["minVerticalAngle"], own["maxVerticalAngle"]) == (-20.0, highest_deg)
    assert system("aloam", dataset).parameters["/scan_line"] == beams
    lego = system("lego-loam", dataset).arguments
    assert (lego["beams"], lego["lowest_deg"]) == (beams, lowest_deg)
    assert lego["ring_distance_deg"] == pytest.approx((highest_deg - lowest_deg) / (beams - 1))


@pytest.mark.parametrize(
    ("package", "dataset", "delay_s"),
    [
        ("loam", "room", 0.1),  # timestamp at the start, pose at the end of the sweep
        ("lego-loam", "room", 0.1),
        ("aloam", "room", 0.05),  # pose at the middle
        ("lio-sam", "room", 0.05),
        pytest.param("loam", "kitti00_velodyne_6", 0.05, marks=SHARED_DATA),  # timestamp at the middle
        pytest.param("aloam", "kitti00_velodyne_6", 0.0, marks=SHARED_DATA),
    ],
)
def test_poses_get_the_time_at_which_they_hold(package: str, dataset: str, delay_s: float) -> None:
    assert system(package, dataset).pose_delay_s == pytest.approx(delay_s)


def test_lio_sam_is_told_the_mounting_and_the_noise_of_the_imu_of_room() -> None:
    told = system("lio-sam", "room").parameters["/lio_sam"]
    noise = [told[key] for key in ("imuAccNoise", "imuGyrNoise", "imuAccBiasN", "imuGyrBiasN")]
    assert noise == [0.002, 0.00017, 0.003, 2e-05]
    assert (told["N_SCAN"], told["Horizon_SCAN"], told["imuGravity"]) == (32, 720, 9.81)
    # The LiDAR is 4 cm behind, 1.5 cm left of and 11 cm above the IMU, turned by yaw 4, pitch -1.5 and roll 1 degrees.
    yaw, pitch, roll = np.deg2rad([4.0, -1.5, 1.0])
    turn_z = [[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]]
    turn_y = [[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]]
    turn_x = [[1, 0, 0], [0, np.cos(roll), -np.sin(roll)], [0, np.sin(roll), np.cos(roll)]]
    R_imu_lidar = np.array(turn_z) @ turn_y @ turn_x
    R_lidar_imu = np.reshape(told["extrinsicRot"], (3, 3))
    np.testing.assert_allclose(R_lidar_imu @ R_imu_lidar, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(R_lidar_imu @ [-0.04, 0.015, 0.11] + told["extrinsicTrans"], 0.0, atol=1e-9)


class File:
    """A settings file as the C++ of the systems reads it."""

    def __init__(self, path: Path) -> None:
        self._root = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)

    def numbers(self, keys: str, group: str = "") -> list[float]:
        node = self._root.getNode(group) if group else self._root
        return [node.getNode(key).real() for key in keys.split()]

    def matrix(self, key: str) -> np.ndarray:
        return np.asarray(self._root.getNode(key).mat())


def written(package: str, module: str, algorithm: str, dataset: str, path: Path, *steps: str) -> File:
    config = config_of(package, algorithm, dataset, *steps)
    if package == "orb-slam2":
        load_module(package, module).write_settings(path, config.parameters, algorithm.removeprefix("orb-slam2-"))
    else:
        load_module(package, module).write_settings(path, config.parameters, config.algorithm_remap)
    return File(path)


T_IMU_CAM0 = [
    [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
    [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
    [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
    [0.0, 0.0, 0.0, 1.0],
]
T_IMU_CAM1 = [
    [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
    [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
    [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
    [0.0, 0.0, 0.0, 1.0],
]
EUROC = pytest.param("euroc_v101_static", marks=SHARED_DATA)
IMU_NOISE = [0.028284271, 0.0023996376, 0.042426407, 0.00027425844]
"""EuRoC's 2.0e-3, 1.6968e-4, 3.0e-3 and 1.9393e-5, each times the root of 200 Hz."""


@pytest.mark.integration
@pytest.mark.parametrize("dataset", [EUROC])
def test_vins_fusion_is_told_the_published_calibration_of_euroc(dataset: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    found = written("vins-fusion", "vins_fusion_settings", "vins-fusion-stereo-inertial", dataset, path)
    np.testing.assert_allclose(found.matrix("body_T_cam0"), T_IMU_CAM0, atol=1e-9)
    np.testing.assert_allclose(found.matrix("body_T_cam1"), T_IMU_CAM1, atol=1e-9)
    assert found.numbers("acc_n gyr_n acc_w gyr_w") == pytest.approx(IMU_NOISE, rel=1e-6)
    assert found.numbers("image_width image_height") == [752, 480]
    left, right = File(tmp_path / "left.yaml"), File(tmp_path / "right.yaml")
    lens = "k1 k2 p1 p2"
    assert left.numbers(lens, "distortion_parameters") == [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
    assert right.numbers(lens, "distortion_parameters") == [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05]
    assert left.numbers("fx fy cx cy", "projection_parameters") == [458.654, 457.296, 367.215, 248.375]
    assert right.numbers("fx fy cx cy", "projection_parameters") == [457.587, 456.134, 379.999, 255.238]


@pytest.mark.integration
@pytest.mark.parametrize("dataset", [EUROC])
def test_vins_mono_is_told_the_published_calibration_of_euroc(dataset: str, tmp_path: Path) -> None:
    found = written("vins-mono", "vins_mono_settings", "vins-mono", dataset, tmp_path / "settings.yaml")
    np.testing.assert_allclose(found.matrix("extrinsicRotation"), np.array(T_IMU_CAM0)[:3, :3], atol=1e-9)
    translation = found.matrix("extrinsicTranslation").ravel()
    np.testing.assert_allclose(translation, [-0.0216401454975, -0.064676986768, 0.00981073058949], atol=1e-9)
    assert found.numbers("acc_n gyr_n acc_w gyr_w") == pytest.approx(IMU_NOISE, rel=1e-6)
    assert found.numbers("fx fy cx cy", "projection_parameters") == [458.654, 457.296, 367.215, 248.375]


def test_vins_is_told_the_calibration_of_room_at_half_size(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    steps = ("resolution scale=0.5", "rate hz=10")
    found = written("vins-fusion", "vins_fusion_settings", "vins-fusion-stereo-inertial", "room", path, *steps)
    assert found.numbers("image_width image_height") == [320, 240]
    left = File(tmp_path / "left.yaml")
    # Pixel centres are whole numbers, so cx becomes (319.5 + 0.5) / 2 - 0.5.
    assert left.numbers("fx fy cx cy", "projection_parameters") == pytest.approx([211.2, 211.2, 159.5, 119.5])
    assert found.matrix("body_T_cam0")[:3, 3].tolist() == pytest.approx([0.09, 0.06, 0.035])


@pytest.mark.parametrize(
    ("mode", "steps", "expected"),
    [
        ("rgbd", (), {"fx": 422.4, "fy": 422.4, "cx": 319.5, "cy": 239.5, "fps": 20, "k1": 0}),
        ("mono", ("resolution scale=0.5",), {"fx": 211.2, "fy": 211.2, "cx": 159.5, "cy": 119.5, "fps": 20}),
    ],
)
def test_orb_slam2_is_told_the_camera_of_room(
    mode: str, steps: tuple[str, ...], expected: dict[str, Any], tmp_path: Path
) -> None:
    path = tmp_path / "settings.yaml"
    found = written("orb-slam2", "orb_slam2_settings", f"orb-slam2-{mode}", "room", path, *steps)
    values = found.numbers(" ".join(f"Camera.{key}" for key in expected))
    assert values == pytest.approx(list(expected.values()), rel=1e-6)


@pytest.mark.parametrize("dataset", [pytest.param("kitti06_stereo_51", marks=SHARED_DATA)])
def test_orb_slam2_is_told_the_published_calibration_of_kitti(dataset: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    found = written("orb-slam2", "orb_slam2_settings", "orb-slam2-stereo", dataset, path)
    assert found.numbers("Camera.width Camera.height") == [1226, 370]
    for side in ("LEFT", "RIGHT"):
        K = np.array([[707.0912, 0.0, 601.8873], [0.0, 707.0912, 183.1104], [0.0, 0.0, 1.0]])
        np.testing.assert_allclose(found.matrix(f"{side}.K"), K, rtol=1e-9)
        assert not found.matrix(f"{side}.D").any()
    # P1 has -379.8145 = -fx * baseline.
    T_right_left = np.eye(4)
    T_right_left[0, 3] = -379.8145 / 707.0912
    np.testing.assert_allclose(found.matrix("T_right_left"), T_right_left, atol=1e-7)


@pytest.mark.parametrize("dataset", [KITTI])
def test_the_beams_of_kitti_are_those_of_its_scans(dataset: str) -> None:
    """Its points lie in rows, one for each laser from the highest, each beginning ahead and turning to the left."""
    stated_deg = sensors_of_dataset(dataset)[0].calibration["vertical_angles_deg"]
    scan = next(iter(sorted((SHARED / dataset / "velodyne").glob("*.bin"))))
    x, y, z = np.fromfile(scan, dtype="<f4").reshape(-1, 4)[:, :3].astype(float).T
    azimuth_deg = np.degrees(np.arctan2(y, x)) % 360
    rows = np.split(np.degrees(np.arctan2(z, np.hypot(x, y))), np.flatnonzero(np.diff(azimuth_deg) < -180) + 1)
    measured_deg = [np.median(row) for row in reversed(rows)]
    # The lasers are not spaced quite evenly; what is stated is even within each block.
    np.testing.assert_allclose(np.array(stated_deg), np.array(measured_deg), atol=0.3)
