"""VINS-Fusion's settings files from the run's configuration: one for the estimator, one for each camera."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.runtime.calibration import transform
from slamhive.runtime.opencv_yaml import opencv_yaml
from slamhive.runtime.vins import camera_settings, estimator_settings, imu_settings

CAMERAS = ("left", "right")


def write_settings(path: Path, values: Mapping[str, Any], topics: Mapping[str, str]) -> None:
    """Write the settings for ``values``, the parameters of ``config.yaml``, and {role: topic}; cameras beside them.

    The body that VINS-Fusion tracks is the IMU, without one the left camera.
    """
    body = "imu" if "imu" in topics else "left"
    cameras = [role for role in CAMERAS if role in topics]
    content: dict[str, Any] = {
        "imu": body == "imu",
        "num_of_cam": len(cameras),
        "output_path": str(path.parent),
        "image_width": int(values["left_width"]),
        "image_height": int(values["left_height"]),
        **estimator_settings(values),
        **{key: values[key] for key in ("multiple_thread", "feature_every", "flow_back")},
    }
    for number, role in enumerate(cameras):
        T_body_camera = np.eye(4) if role == body else transform(values, body, role)
        content |= {
            f"image{number}_topic": topics[role],
            f"cam{number}_calib": f"{role}.yaml",
            f"body_T_cam{number}": T_body_camera,
        }
        camera = camera_settings(values, role, "VINS-Fusion", full=True)
        path.with_name(f"{role}.yaml").write_text(opencv_yaml(camera), encoding="utf-8")
    if body == "imu":
        content |= {"imu_topic": topics["imu"], **imu_settings(values)}
    path.write_text(opencv_yaml(content), encoding="utf-8")
