"""Common parts of VINS-Mono and VINS-Fusion: start, and settings of cameras (for camodocal), IMU and solver."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from slamhive.runtime.calibration import EQUIDISTANT, RADTAN, check_model, distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.ros1.system import PoseKind, PoseTopic, Ros1System

Values = Mapping[str, Any]
WriteSettings = Callable[[Path, Values, Mapping[str, str]], None]
"""Writes the settings file for the parameters of a run and {role: topic}."""

_RADTAN_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_SHORT_RADTAN = 4
_SOLVER = ("max_solver_time", "max_num_iterations", "keyframe_parallax", "max_cnt", "min_dist")
EXTRINSICS = {"fixed": 0, "refine": 1, "calibrate": 2}


def vins_system(
    config: RunConfig, launch: Path, write_settings: WriteSettings, about: Mapping[str, Any], *, every_frame: bool
) -> Ros1System:
    """The system for this run, without loop closure; raises InvalidInput for a camera that it cannot describe.

    Without ``every_frame`` it leaves out images on purpose, so that an image without a pose was not dropped.
    """
    settings = Path(tempfile.mkdtemp(prefix="vins-")) / "settings.yaml"
    write_settings(settings, config.parameters, config.algorithm_remap)
    return Ros1System(
        launch=launch,
        poses=PoseTopic("/vins_estimator/odometry", PoseKind.ODOMETRY),
        frames="left",
        arguments={"settings": str(settings)},
        every_frame=every_frame,
        about={**about, "loop_closure": False},
    )


def camera_settings(values: Values, role: str, system: str, *, full: bool) -> dict[str, Any]:
    """The camera in ``role``; ``full`` allows eight radial-tangential coefficients. Raises InvalidInput for others."""
    check_model(values, role, RADTAN + EQUIDISTANT, len(_RADTAN_NAMES) if full else _SHORT_RADTAN, system)
    coefficients = distortion(values, role)
    fx, fy, cx, cy = (float(values[f"{role}_{key}"]) for key in ("fx", "fy", "cx", "cy"))
    size = {"image_width": int(values[f"{role}_width"]), "image_height": int(values[f"{role}_height"])}
    if coefficients and values.get(f"{role}_model") in EQUIDISTANT:
        lens = dict(zip(("k2", "k3", "k4", "k5"), coefficients, strict=True))
        projection = {**lens, "mu": fx, "mv": fy, "u0": cx, "v0": cy}
        return {"model_type": "KANNALA_BRANDT", "camera_name": role, **size, "projection_parameters": projection}
    long = len(coefficients) > _SHORT_RADTAN
    names = _RADTAN_NAMES if long else _RADTAN_NAMES[:_SHORT_RADTAN]
    padded = coefficients + [0.0] * (len(names) - len(coefficients))
    return {
        "model_type": "PINHOLE_FULL" if long else "PINHOLE",
        "camera_name": role,
        **size,
        "distortion_parameters": dict(zip(names, padded, strict=True)),
        "projection_parameters": {"fx": fx, "fy": fy, "cx": cx, "cy": cy},
    }


def imu_settings(values: Values) -> dict[str, float]:
    """Noise of the IMU and gravity.

    VINS wants the standard deviation of one sample, which is the density times the root of the rate.
    """
    factor = float(values["imuNoiseFactor"]) * math.sqrt(float(values["imu_rate_hz"]))
    noise = {
        "acc_n": "imu_accelerometer_noise_density",
        "gyr_n": "imu_gyroscope_noise_density",
        "acc_w": "imu_accelerometer_random_walk",
        "gyr_w": "imu_gyroscope_random_walk",
    }
    return {**{key: float(values[name]) * factor for key, name in noise.items()}, "g_norm": float(values["g_norm"])}


def estimator_settings(values: Values) -> dict[str, Any]:
    """Feature tracker, solver and what is estimated besides the poses.

    The time offset is that of the dataset's calibration, plus what the user adds.
    """
    return {
        **{key: values[key] for key in _SOLVER},
        "estimate_extrinsic": EXTRINSICS[values.get("estimate_extrinsic", "fixed")],
        "estimate_td": bool(values.get("estimate_td", False)),
        "td": float(values.get("left_time_offset_s", 0.0)) + float(values.get("td", 0.0)),
        "show_track": 0,
    }
