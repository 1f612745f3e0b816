"""The calibration of a run's sensors by role, from the parameters of ``config.yaml``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput

RADTAN = ("pinhole", "pinhole-radtan")
EQUIDISTANT = ("pinhole-equidistant", "fisheye-kb")

Values = Mapping[str, Any]


def transform(values: Values, from_role: str, to_role: str) -> np.ndarray:
    """``T_from_to``: the pose (4, 4) of one sensor in the frame of another."""
    T_body_from, T_body_to = (
        np.array(values[f"{role}_T_body_sensor"], dtype=np.float64).reshape(4, 4) for role in (from_role, to_role)
    )
    T: np.ndarray = np.linalg.inv(T_body_from) @ T_body_to
    return T


def distortion(values: Values, role: str) -> list[float]:
    """The distortion coefficients of a camera, as its model orders them; empty if its images have none."""
    coefficients = [float(value) for value in values.get(f"{role}_distortion") or []]
    return coefficients if any(coefficients) else []


def camera_matrix(values: Values, role: str) -> np.ndarray:
    """The intrinsics (3, 3) of a camera, in pixels."""
    fx, fy, cx, cy = (float(values[f"{role}_{key}"]) for key in ("fx", "fy", "cx", "cy"))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def check_model(values: Values, role: str, models: tuple[str, ...], most: int, system: str) -> None:
    """Raise InvalidInput where ``system`` cannot describe the lens: only ``models`` with ``most`` coefficients."""
    model = str(values.get(f"{role}_model", RADTAN[0]))
    count = len(distortion(values, role))
    if count and (model not in models or count > most):
        raise InvalidInput(
            f"{system} has no camera model for the images of {role}: {model} with {count} distortion coefficients",
            "rectify the images, or choose another algorithm",
        )
