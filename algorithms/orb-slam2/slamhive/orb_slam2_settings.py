"""ORB-SLAM2's settings file from the run's configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.runtime.calibration import RADTAN, camera_matrix, check_model, distortion, transform
from slamhive.runtime.opencv_yaml import opencv_yaml

VIRTUAL_BASELINE_M = 0.08
"""Distance to the imagined second camera of an RGB-D sensor; with ``thDepth`` it says which points count as near."""
_LENS = ("k1", "k2", "p1", "p2", "k3")
_MOST_COEFFICIENTS = 8
_EXTRACTOR = ("nFeatures", "scaleFactor", "nLevels", "iniThFAST", "minThFAST")


def write_settings(path: Path, values: Mapping[str, Any], mode: str) -> None:
    """Write the settings for ``values``, the parameters of ``config.yaml``.

    Stereo images are rectified by the node, which adds the intrinsics of the rectified pair to the file.
    """
    content = {
        "Camera.width": int(values["left_width"]),
        "Camera.height": int(values["left_height"]),
        "Camera.fps": float(values["left_rate_hz"]),
        "Camera.RGB": 1,
        **{f"ORBextractor.{key}": values[key] for key in _EXTRACTOR},
        **(_pair(values) if mode == "stereo" else _left(values)),
    }
    if mode == "rgbd":
        content["Camera.bf"] = float(values["left_fx"]) * VIRTUAL_BASELINE_M
        content["DepthMapFactor"] = float(values["depth_units_per_m"])
    if mode != "mono":
        content["ThDepth"] = float(values["thDepth"])
    path.write_text(opencv_yaml(content), encoding="utf-8")


def _left(values: Mapping[str, Any]) -> dict[str, float]:
    check_model(values, "left", RADTAN, len(_LENS), "ORB-SLAM2")
    lens = dict.fromkeys(_LENS, 0.0) | dict(zip(_LENS, distortion(values, "left"), strict=False))
    return {f"Camera.{key}": float(values[f"left_{key}"]) for key in ("fx", "fy", "cx", "cy")} | {
        f"Camera.{key}": value for key, value in lens.items()
    }


def _pair(values: Mapping[str, Any]) -> dict[str, Any]:
    content: dict[str, Any] = {"T_right_left": transform(values, "right", "left")}
    for role, name in (("left", "LEFT"), ("right", "RIGHT")):
        check_model(values, role, RADTAN, _MOST_COEFFICIENTS, "ORB-SLAM2")
        content[f"{name}.K"] = camera_matrix(values, role)
        content[f"{name}.D"] = np.array([distortion(values, role) or [0.0] * len(_LENS)])
    # Upstream reads the lens of the rectified camera, which has none.
    return content | {f"Camera.{key}": 0.0 for key in _LENS}
