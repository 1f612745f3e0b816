"""ORB-SLAM3's settings file from the run's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

TEMPLATE = Path(__file__).with_name("template.yaml")
VIRTUAL_BASELINE_M = 0.08
"""Distance to the imagined second camera of an RGB-D sensor; with ``thDepth`` it says which points count as near."""


def settings_text(values: Mapping[str, Any], roles: set[str]) -> str:
    """The settings for the sensors in ``roles``; ``values`` are the parameters of ``config.yaml``."""
    fields = {key: _number(value) for key, value in values.items() if isinstance(value, int | float)}
    fields |= {key: _real(values[key]) for key in ("left_fx", "left_fy", "left_cx", "left_cy", "scaleFactor")}
    fields["fps"] = str(max(1, round(float(values["left_rate_hz"]))))
    fields["left_distortion"] = _distortion("Camera1", values, "left")
    fields["second_camera"] = _second_camera(values) if "right" in roles else ""
    fields["depth"] = _depth(values) if "depth" in roles else ""
    fields["imu"] = _imu(values) if "imu" in roles else ""
    return Template(TEMPLATE.read_text(encoding="utf-8")).substitute(fields)


def transform(values: Mapping[str, Any], from_role: str, to_role: str) -> np.ndarray:
    """``T_from_to``: the pose (4, 4) of one sensor in the frame of another."""
    T_body_from, T_body_to = (
        np.array(values[f"{role}_T_body_sensor"], dtype=np.float64).reshape(4, 4) for role in (from_role, to_role)
    )
    return np.linalg.inv(T_body_from) @ T_body_to


def distortion(values: Mapping[str, Any], role: str) -> list[float]:
    """The coefficients k1 k2 p1 p2 (k3) of a camera; empty if its images have none."""
    coefficients = [float(value) for value in values.get(f"{role}_distortion") or []]
    return coefficients if any(coefficients) else []


def _second_camera(values: Mapping[str, Any]) -> str:
    lines = [f"Camera2.{key}: {_real(values[f'right_{key}'])}" for key in ("fx", "fy", "cx", "cy")]
    lines.append(_distortion("Camera2", values, "right"))
    lines.append(_matrix("Stereo.T_c1_c2", transform(values, "left", "right")))
    lines.append(f"Stereo.ThDepth: {_real(values['thDepth'])}")
    return "\n".join(lines)


def _depth(values: Mapping[str, Any]) -> str:
    return "\n".join(
        [
            f"RGBD.DepthMapFactor: {_real(values['depth_units_per_m'])}",
            f"Stereo.b: {_real(VIRTUAL_BASELINE_M)}",
            f"Stereo.ThDepth: {_real(values['thDepth'])}",
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
    lines = [f"{key}: {_real(float(values[name]) * factor)}" for key, name in noise.items()]
    lines.append(f"IMU.Frequency: {_real(values['imu_rate_hz'])}")
    lines.append(_matrix("IMU.T_b_c1", transform(values, "imu", "left")))
    return "\n".join(lines)


def _distortion(camera: str, values: Mapping[str, Any], role: str) -> str:
    names = ("k1", "k2", "p1", "p2", "k3")
    pairs = zip(names, distortion(values, role), strict=False)
    return "\n".join(f"{camera}.{name}: {_real(value)}" for name, value in pairs)


def _matrix(name: str, T: np.ndarray) -> str:
    data = ", ".join(_real(value) for value in T.reshape(-1))
    return f"{name}: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: f\n   data: [{data}]"


def _number(value: float) -> str:
    return str(int(value)) if isinstance(value, bool | int) else _real(value)


def _real(value: Any) -> str:
    """With a decimal point always: ORB-SLAM3 refuses ``500`` where it wants a real number."""
    text = f"{float(value):.12g}"
    if "e" in text:
        mantissa, exponent = text.split("e")
        return f"{mantissa if '.' in mantissa else mantissa + '.0'}e{exponent}"
    return text if "." in text else f"{text}.0"
