"""Computes intrinsics of images that were resized, or whose calibration the user states.

Integer pixel coordinates are at pixel centres, so the image's left edge is at -0.5. An image of ``w`` pixels resized to
``w'`` maps the coordinate ``u`` to ``u' = (u + 0.5) s - 0.5`` with ``s = w'/w``, each axis with its own factor. Hence
``fx' = s fx`` and ``cx' = (cx + 0.5) s - 0.5``. Distortion acts before the intrinsics and rectification before the
projection: both stay as they are.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import Sensor
from slamhive.recordings.variants.step import Array

_ROUNDING = 1e-9
"""Several resizes in a row equal one resize up to this."""


def image_size(sensor: Sensor) -> tuple[int, int]:
    """Width and height in pixels of a camera's or depth sensor's images."""
    width, height = sensor.calibration["width"], sensor.calibration["height"]
    assert isinstance(width, int)
    assert isinstance(height, int)
    return width, height


def pixel_map(old_size: tuple[int, int], new_size: tuple[int, int]) -> Array:
    """The (3, 3) matrix that takes homogeneous pixel coordinates of the old image to the new one's."""
    sx, sy = new_size[0] / old_size[0], new_size[1] / old_size[1]
    return np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])


def scale_sensor(sensor: Sensor, new_size: tuple[int, int]) -> Sensor:
    """``sensor`` with images of ``new_size`` (width, height); keys other than size and intrinsics are kept."""
    calibration = sensor.calibration
    fx, fy, cx, cy = _intrinsics(sensor)
    A = pixel_map(image_size(sensor), new_size)
    scaled = {
        "width": new_size[0],
        "height": new_size[1],
        "fx": float(A[0, 0] * fx),
        "fy": float(A[1, 1] * fy),
        "cx": float(A[0, 0] * cx + A[0, 2]),
        "cy": float(A[1, 1] * cy + A[1, 2]),
    }
    return replace(sensor, calibration={**calibration, **scaled})


def intrinsics_map(before: Sensor, after: Sensor) -> Array:
    """The (3, 3) matrix that turns the camera matrix of ``before`` into that of ``after``, on its left side."""
    old, new = _intrinsics(before), _intrinsics(after)
    sx, sy = new[0] / old[0], new[1] / old[1]
    return np.array([[sx, 0.0, new[2] - sx * old[2]], [0.0, sy, new[3] - sy * old[3]], [0.0, 0.0, 1.0]])


def follow_sensor(info: Any, before: Sensor, after: Sensor, topic: str) -> Any:
    """A ``sensor_msgs/CameraInfo`` of ``before`` as one of ``after``: resized, then with the intrinsics stated by hand.

    K and P may differ from ``dataset.yaml`` (P describes rectified images): they keep their relation to it.
    Raises InvalidInput as :func:`scale_camera_info`.
    """
    old_size, new_size = image_size(before), image_size(after)
    if old_size != new_size:
        info = scale_camera_info(info, new_size, topic)
        before = scale_sensor(before, new_size)
    if same_intrinsics(before, after):
        return info
    return _transformed(info, intrinsics_map(before, after))


def same_intrinsics(before: Sensor, after: Sensor) -> bool:
    """Tell if focal lengths and principal point are equal up to rounding."""
    return bool(np.allclose(_intrinsics(before), _intrinsics(after), rtol=_ROUNDING, atol=_ROUNDING))


def scale_camera_info(info: Any, new_size: tuple[int, int], topic: str) -> Any:
    """A ``sensor_msgs/CameraInfo`` for images of ``new_size``: K, P, width and height; D and R are kept.

    Works on messages of ROS 1 (K, P) and ROS 2 (k, p). Raises InvalidInput for binned or cropped images.
    """
    roi = info.roi
    if info.binning_x > 1 or info.binning_y > 1 or roi.x_offset or roi.y_offset or roi.do_rectify:
        raise InvalidInput(
            f"{topic} describes binned or cropped images, which cannot be resized",
            "record full images, or drop the step",
        )
    A = pixel_map((info.width, info.height), new_size)
    if roi.width or roi.height:
        roi = replace(roi, width=new_size[0], height=new_size[1])
    return replace(_transformed(info, A), width=new_size[0], height=new_size[1], roi=roi)


def _transformed(info: Any, A: Array) -> Any:
    """``info`` with K and P multiplied by ``A`` from the left."""
    names = ("K", "P") if hasattr(info, "K") else ("k", "p")
    K, P = (np.asarray(getattr(info, name)).reshape(3, -1) for name in names)
    return replace(info, **{names[0]: (A @ K).reshape(-1), names[1]: (A @ P).reshape(-1)})


def _intrinsics(sensor: Sensor) -> tuple[float, float, float, float]:
    fx, fy, cx, cy = (float(sensor.calibration[key]) for key in ("fx", "fy", "cx", "cy"))  # type: ignore[arg-type]
    return fx, fy, cx, cy
