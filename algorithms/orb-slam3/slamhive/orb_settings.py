"""ORB-SLAM3's settings file from the run's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

from slamhive.runtime.calibration import distortion, transform
from slamhive.runtime.opencv_yaml import matrix, real

TEMPLATE = Path(__file__).with_name("template.yaml")
VIRTUAL_BASELINE_M = 0.08
"""Distance to the imagined second camera of an RGB-D sensor; with ``thDepth`` it says which points count as near."""


def settings_text(values: Mapping[str, Any], roles: set[str], maps: str = "") -> str:
    """The settings for the sensors in ``roles``.

    ``values`` are the parameters of ``config.yaml``, ``maps`` the lines that name maps to load and save.
    """
    fields = {key: _number(value) for key, value in values.items() if isinstance(value, int | float)}
    fields |= {key: real(values[key]) for key in ("left_fx", "left_fy", "left_cx", "left_cy", "scaleFactor")}
    fields["fps"] = str(max(1, round(float(values["left_rate_hz"]))))
    fields["left_distortion"] = _distortion("Camera1", values, "left")
    fields["second_camera"] = _second_camera(values) if "right" in roles else ""
    fields["depth"] = _depth(values) if "depth" in roles else ""
    fields["imu"] = _imu(values) if "imu" in roles else ""
    fields["maps"] = maps
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(fields)


def _second_camera(values: Mapping[str, Any]) -> str:
    lines = [f"Camera2.{key}: {real(values[f'right_{key}'])}" for key in ("fx", "fy", "cx", "cy")]
    lines.append(_distortion("Camera2", values, "right"))
    lines.append(f"Stereo.T_c1_c2: {matrix(transform(values, 'left', 'right'), 'f')}")
    lines.append(f"Stereo.ThDepth: {real(values['thDepth'])}")
    return "\n".join(lines)


def _depth(values: Mapping[str, Any]) -> str:
    return "\n".join(
        [
            f"RGBD.DepthMapFactor: {real(values['depth_units_per_m'])}",
            f"Stereo.b: {real(VIRTUAL_BASELINE_M)}",
            f"Stereo.ThDepth: {real(values['thDepth'])}",
        ]
    )


def _imu(values: Mapping[str, Any]) -> str:
    factor = float(values["imuNoiseFactor"])
    noise = {
        "IMU.NoiseGyro": "imu_gyroscope_noise_density",
        "IMU.NoiseAcc": "imu_accelerometer_noise_density",
        "IMU.GyroWalk": "imu_gyroscope_random_walk",
        "IMU.AccWalk": "imu_accelerometer_random_walk",
    }
    lines = [f"{key}: {real(float(values[name]) * factor)}" for key, name in noise.items()]
    lines.append(f"IMU.Frequency: {real(values['imu_rate_hz'])}")
    lines.append(f"IMU.T_b_c1: {matrix(transform(values, 'imu', 'left'), 'f')}")
    return "\n".join(lines)


def _distortion(camera: str, values: Mapping[str, Any], role: str) -> str:
    names = ("k1", "k2", "p1", "p2", "k3")
    pairs = zip(names, distortion(values, role), strict=False)
    return "\n".join(f"{camera}.{name}: {real(value)}" for name, value in pairs)


def _number(value: float) -> str:
    return str(int(value)) if isinstance(value, bool | int) else real(value)
