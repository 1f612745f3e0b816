"""VINS-Mono's settings file from the run's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from slamhive.runtime.calibration import transform
from slamhive.runtime.opencv_yaml import opencv_yaml
from slamhive.runtime.vins import camera_settings, estimator_settings, imu_settings


def write_settings(path: Path, values: Mapping[str, Any], topics: Mapping[str, str]) -> None:
    """Write the settings for ``values``, the parameters of ``config.yaml``, and {role: topic}."""
    T_imu_left = transform(values, "imu", "left")
    readout_s = float(values["rolling_shutter_tr"])
    content = {
        "image_topic": topics["left"],
        "imu_topic": topics["imu"],
        "output_path": str(path.parent),
        **camera_settings(values, "left", "VINS-Mono", full=False),
        "extrinsicRotation": T_imu_left[:3, :3],
        "extrinsicTranslation": T_imu_left[:3, 3:],
        **estimator_settings(values),
        **imu_settings(values),
        **{key: values[key] for key in ("freq", "F_threshold", "equalize")},
        "fisheye": 0,
        "rolling_shutter": readout_s > 0,
        "rolling_shutter_tr": readout_s,
        "visualize_camera_size": 0.4,
    }
    path.write_text(opencv_yaml(content), encoding="utf-8")
