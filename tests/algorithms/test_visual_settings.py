"""The settings files that the visual ROS 1 packages write, compared with settings written by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.runtime.config import RunConfig
from slamhive.runtime.vins import estimator_settings
from tests.algorithms.algorithm_runs import load_module

T_IMU_LEFT = [0.0, -1, 0, -0.02, 1, 0, 0, -0.06, 0, 0, 1, 0.01, 0, 0, 0, 1]
"""The cameras of EuRoC are turned like that; its files were made for 200 Hz."""
T_IMU_RIGHT = [0.0, -1, 0, -0.02, 1, 0, 0, 0.05, 0, 0, 1, 0.01, 0, 0, 0, 1]
EUROC: dict[str, Any] = {
    **{f"{role}_{key}": value for role in ("left", "right") for key, value in (("width", 752), ("height", 480))},
    **{f"{role}_model": "pinhole-radtan" for role in ("left", "right")},
    **dict(zip(("left_fx", "left_fy", "left_cx", "left_cy"), (458.654, 457.296, 367.215, 248.375), strict=True)),
    **dict(zip(("right_fx", "right_fy", "right_cx", "right_cy"), (457.587, 456.134, 379.999, 255.238), strict=True)),
    "left_distortion": [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    "right_distortion": [-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05],
    "left_rate_hz": 20.0,
    "left_T_body_sensor": T_IMU_LEFT,
    "right_T_body_sensor": T_IMU_RIGHT,
    "imu_T_body_sensor": np.eye(4).reshape(-1).tolist(),
    "imu_rate_hz": 200.0,
    "imu_gyroscope_noise_density": 1.6968e-4,
    "imu_accelerometer_noise_density": 2.0e-3,
    "imu_gyroscope_random_walk": 1.9393e-5,
    "imu_accelerometer_random_walk": 3.0e-3,
}
TRACKING = {"max_cnt": 150, "min_dist": 30, "max_solver_time": 0.04, "max_num_iterations": 8, "keyframe_parallax": 10.0}
INERTIAL = {**TRACKING, "imuNoiseFactor": 1.0, "g_norm": 9.81, "estimate_extrinsic": "refine", "estimate_td": True}
MONO = {**INERTIAL, "td": 0.01, "freq": 10, "F_threshold": 1.0, "equalize": True, "rolling_shutter_tr": 0.0}
FUSION = {**INERTIAL, "td": 0.01, "multiple_thread": True, "feature_every": 2, "flow_back": True}
ORB = {"nFeatures": 1200, "scaleFactor": 1.2, "nLevels": 8, "iniThFAST": 20, "minThFAST": 7, "thDepth": 40.0}


class Settings:
    """A file as the C++ of the systems reads it."""

    def __init__(self, path: Path) -> None:
        self._file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)

    def numbers(self, *keys: str, group: str = "") -> list[float]:
        nodes = [self._file.getNode(group).getNode(key) if group else self._file.getNode(key) for key in keys]
        assert not any(node.empty() for node in nodes), keys
        return [node.real() for node in nodes]

    def text(self, key: str) -> str:
        return str(self._file.getNode(key).string())

    def matrix(self, key: str) -> np.ndarray:
        return np.asarray(self._file.getNode(key).mat())


def test_vins_gets_the_time_offset_of_the_camera() -> None:
    values = {**EUROC, **MONO, "left_time_offset_s": 0.0814}
    assert estimator_settings(values)["td"] == pytest.approx(0.0914)
    assert estimator_settings({**values, "td": 0.0})["td"] == 0.0814


def test_vins_mono_gets_the_calibration_of_the_dataset(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    topics = {"left": "/left", "imu": "/imu"}
    load_module("vins-mono", "vins_mono_settings").write_settings(path, {**EUROC, **MONO}, topics)
    found = Settings(path)
    assert (found.text("model_type"), found.text("image_topic"), found.text("imu_topic")) == (
        "PINHOLE",
        "/left",
        "/imu",
    )
    assert found.numbers("k1", "k2", "p1", "p2", group="distortion_parameters") == EUROC["left_distortion"]
    assert found.numbers("fx", "fy", "cx", "cy", group="projection_parameters") == [458.654, 457.296, 367.215, 248.375]
    assert np.allclose(found.matrix("extrinsicRotation"), [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert np.allclose(found.matrix("extrinsicTranslation"), [[-0.02], [-0.06], [0.01]])
    # Densities times the root of 200 Hz.
    noise = [2.0e-3 * 200**0.5, 1.6968e-4 * 200**0.5, 3.0e-3 * 200**0.5, 1.9393e-5 * 200**0.5]
    assert found.numbers("acc_n", "gyr_n", "acc_w", "gyr_w") == pytest.approx(noise)
    assert found.numbers("estimate_extrinsic", "estimate_td", "td", "rolling_shutter") == [1, 1, 0.01, 0]


def test_vins_mono_refuses_a_lens_of_five_coefficients(tmp_path: Path) -> None:
    values = {**EUROC, **MONO, "left_distortion": [0.1, 0.2, 0.0, 0.0, 0.3]}
    with pytest.raises(InvalidInput, match="VINS-Mono has no camera model for the images of left"):
        load_module("vins-mono", "vins_mono_settings").write_settings(
            tmp_path / "s.yaml", values, {"left": "/l", "imu": "/i"}
        )


def test_vins_fusion_gets_one_file_for_each_camera(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    topics = {"left": "/left", "right": "/right", "imu": "/imu"}
    fisheye = {"right_model": "fisheye-kb", "right_distortion": [0.1, 0.2, 0.3, 0.4]}
    load_module("vins-fusion", "vins_fusion_settings").write_settings(path, {**EUROC, **FUSION, **fisheye}, topics)
    found, left, right = Settings(path), Settings(tmp_path / "left.yaml"), Settings(tmp_path / "right.yaml")
    assert found.numbers("imu", "num_of_cam", "feature_every", "multiple_thread") == [1, 2, 2, 1]
    assert [found.text(key) for key in ("image1_topic", "cam1_calib")] == ["/right", "right.yaml"]
    assert np.allclose(found.matrix("body_T_cam1"), np.array(T_IMU_RIGHT).reshape(4, 4))
    assert left.text("model_type") == "PINHOLE"
    assert right.text("model_type") == "KANNALA_BRANDT"
    lens = right.numbers("k2", "k3", "k4", "k5", "mu", "u0", group="projection_parameters")
    assert lens == [0.1, 0.2, 0.3, 0.4, 457.587, 379.999]


def test_the_body_of_vins_fusion_without_imu_is_the_left_camera(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    values = {key: value for key, value in {**EUROC, **TRACKING, **FUSION}.items() if not key.startswith("imu")}
    load_module("vins-fusion", "vins_fusion_settings").write_settings(
        path, values, {"left": "/left", "right": "/right"}
    )
    found = Settings(path)
    assert found.numbers("imu", "num_of_cam") == [0, 2]
    assert np.array_equal(found.matrix("body_T_cam0"), np.eye(4))
    assert np.allclose(found.matrix("body_T_cam1")[:3, 3], [0.11, 0, 0])


@pytest.mark.parametrize(
    ("package", "changes", "every"),
    [
        ("vins-fusion", {}, False),
        ("vins-fusion", {"feature_every": 1}, True),
        ("vins-fusion", {"multiple_thread": False}, True),  # then feature_every has no effect
        ("vins-mono", {}, False),
        ("vins-mono", {"freq": 0}, True),
    ],
)
def test_images_that_vins_leaves_out_on_purpose_are_not_dropped(
    monkeypatch: pytest.MonkeyPatch, package: str, changes: dict[str, Any], every: bool
) -> None:
    monkeypatch.syspath_prepend(project_root() / "algorithms" / package / "slamhive")
    values = {**EUROC, **(MONO if package == "vins-mono" else FUSION), **changes}
    config = RunConfig(
        package, "room", algorithm_parameters=values, algorithm_remap={"left": "/l", "right": "/r", "imu": "/i"}
    )
    assert load_module(package, "mapping").make(config).every_frame is every


def test_orb_slam2_rectifies_what_is_not_rectified(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    module = load_module("orb-slam2", "orb_slam2_settings")
    module.write_settings(path, {**EUROC, **ORB}, "stereo")
    found = Settings(path)
    assert np.allclose(found.matrix("T_right_left")[:3, 3], [-0.11, 0, 0])
    assert found.matrix("LEFT.D").reshape(-1).tolist() == EUROC["left_distortion"]
    assert found.matrix("RIGHT.K")[0].tolist() == [457.587, 0, 379.999]
    assert "Camera.fx" not in path.read_text()


def test_orb_slam2_gets_lens_and_depth(tmp_path: Path) -> None:
    path = tmp_path / "settings.yaml"
    module = load_module("orb-slam2", "orb_slam2_settings")
    module.write_settings(path, {**EUROC, **ORB, "depth_units_per_m": 1000}, "rgbd")
    found = Settings(path)
    lens = [f"Camera.{key}" for key in ("fx", "k1", "p2", "k3", "fps")]
    assert found.numbers(*lens) == [458.654, -0.28340811, 1.76187114e-05, 0, 20]
    assert found.numbers("DepthMapFactor", "ThDepth") == [1000, 40]
    assert found.numbers("Camera.bf") == [pytest.approx(458.654 * 0.08)]
    with pytest.raises(InvalidInput, match="ORB-SLAM2 has no camera model for the images of left: fisheye-kb"):
        module.write_settings(path, {**EUROC, **ORB, "left_model": "fisheye-kb"}, "mono")
