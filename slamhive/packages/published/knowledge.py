"""Meanings of parameter names in the systems of the field, and the values that their upstream examples have."""

from __future__ import annotations

import re
from collections.abc import Collection

_CAMERA = {
    **{key: key for key in ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "width", "height")},
    "image_width": "width",
    "image_height": "height",
    "fps": "rate_hz",
    "image_frequency": "rate_hz",
    "k": "camera_matrix",
    "d": "distortion",
}
_DEPTH = {"depthmapfactor": "depth_units_per_m", "depth_factor": "depth_units_per_m"}
_IMU = {
    "noiseacc": "accelerometer_noise_density",
    "noisegyro": "gyroscope_noise_density",
    "accwalk": "accelerometer_random_walk",
    "gyrowalk": "gyroscope_random_walk",
    "imu_frequency": "rate_hz",
    "imu_rate": "rate_hz",
}
_LIDAR = {
    "n_scan": "beams",
    "scan_line": "beams",
    "horizon_scan": "points_per_ring",
    "minimum_range": "minimum_range_m",
}
_POSES = {
    "body_t_cam0": "imu.T(left)",
    "body_t_cam1": "imu.T(right)",
    "t_b_c1": "imu.T(left)",
    "t_b_c0": "imu.T(left)",
    "tbc": "imu.T(left)",
    "bf": "left.bf(right)",
}
_SIDES = (
    ("right", re.compile(r"^(?:cam1|right|camera1|image1)_?(?=[a-z])")),
    ("left", re.compile(r"^(?:cam0|left|camera0|camera|image0)_?(?=[a-z])")),
)
_WHOLE = frozenset({"width", "height", "beams", "points_per_ring"})
_MATRICES = frozenset({"camera_matrix", "distortion", "T"})

_EXAMPLES: dict[str, tuple[str, dict[str, int | float]]] = {
    "ORB-SLAM2 and ORB-SLAM3": (
        "nFeatures",
        {
            "nFeatures": 1000,
            "scaleFactor": 1.2,
            "nLevels": 8,
            "iniThFAST": 20,
            "minThFAST": 7,
            "ThDepth": 35.0,
            "RGB": 1,
            "KeyFrameSize": 0.05,
            "KeyFrameLineWidth": 1,
            "GraphLineWidth": 0.9,
            "PointSize": 2,
            "CameraSize": 0.08,
            "CameraLineWidth": 3,
            "ViewpointX": 0,
            "ViewpointY": -0.7,
            "ViewpointZ": -1.8,
            "ViewpointF": 500,
        },
    ),
    "VINS-Mono and VINS-Fusion": (
        "max_cnt",
        {
            "max_cnt": 150,
            "min_dist": 30,
            "freq": 10,
            "F_threshold": 1.0,
            "show_track": 0,
            "flow_back": 1,
            "max_solver_time": 0.04,
            "max_num_iterations": 8,
            "keyframe_parallax": 10.0,
            "estimate_extrinsic": 0,
            "acc_n": 0.1,
            "gyr_n": 0.01,
            "acc_w": 0.001,
            "gyr_w": 0.0001,
            "estimate_td": 0,
            "td": 0.0,
            "g_norm": 9.81007,
            "equalize": 1,
            "fisheye": 0,
            "loop_closure": 1,
        },
    ),
}
_GENERAL = {"nFeatures": "features", "max_cnt": "features"}


def source_of(name: str, roles: Collection[str]) -> tuple[str, str] | None:
    """The property of a sensor that a parameter means (``left.fx``), and the type of its value; None if none.

    Args:
        name: The parameter, for instance ``cam1_fx``, ``LEFT_K`` or ``acc_n``.
        roles: The roles of the mode; a property of another role is none.
    """
    lower = name.lower()
    if lower in _POSES:
        wanted = set(re.findall(r"left|right|imu", _POSES[lower]))
        if wanted <= set(roles):
            return _POSES[lower], "float" if lower == "bf" else "matrix"
        return None
    sides = ((role, lower[found.end() :]) for role, form in _SIDES if (found := form.match(lower)))
    side, key = next(sides, ("", lower))
    if len(key) == 1 and not side:
        return None
    for role, known in ((side or "left", _CAMERA), ("depth", _DEPTH), ("imu", _IMU), ("points", _LIDAR)):
        if key in known and role in roles:
            return f"{role}.{known[key]}", _type_of(known[key])
    return None


def example_of(name: str, names: Collection[str]) -> tuple[int | float, str] | None:
    """The value of a parameter in the example files of the system that ``names`` belong to, and that system."""
    for system, (mark, values) in _EXAMPLES.items():
        if mark in names and name in values:
            return values[name], system
    return None


def general_name(name: str) -> str | None:
    """The name of a parameter across algorithms."""
    return _GENERAL.get(name)


def _type_of(key: str) -> str:
    if key in _MATRICES:
        return "matrix"
    return "int" if key in _WHOLE else "float"
