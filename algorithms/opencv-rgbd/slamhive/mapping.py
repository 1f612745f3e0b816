"""OpenCV's RGB-D odometry under the container contract: images with depth in, the camera's trajectory out."""

from __future__ import annotations

import sys
from typing import Any

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import camera_matrix, distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.messages import to_grey
from slamhive.runtime.trajectory import Poses

KINDS = {"rgb": cv2.ODOMETRY_TYPE_RGB, "depth": cv2.ODOMETRY_TYPE_DEPTH, "rgbd": cv2.ODOMETRY_TYPE_RGB_DEPTH}


class RgbdOdometry:
    """Aligns each frame with the one before it. Where this fails, the camera counts as still."""

    def __init__(self, config: RunConfig) -> None:
        values = config.parameters
        if distortion(values, "left"):
            raise InvalidInput("OpenCV's odometry needs undistorted images", "rectify the images of the camera")
        self._units_per_m = float(values["depth_units_per_m"])
        self._odometry = cv2.Odometry(KINDS[values["method"]], settings_of(values), cv2.ODOMETRY_ALGO_TYPE_COMMON)
        self._last: cv2.OdometryFrame | None = None
        self._T_world_camera = np.eye(4)
        self._stamps_s: list[float] = []
        self._poses: list[np.ndarray] = []

    def process(self, frame: Frame) -> bool:
        """Align the frame with the last one; a frame that cannot be aligned has no pose."""
        now = self._prepared(frame)
        found = True
        if self._last is not None:
            found, T_last_now = self._odometry.compute(now, self._last)
            if found:
                self._T_world_camera = self._T_world_camera @ T_last_now
        self._last = now
        if found:
            self._stamps_s.append(frame.stamp_s)
            self._poses.append(self._T_world_camera.copy())
        return bool(found)

    def finish(self) -> Poses:
        """The poses of the camera."""
        return Poses(np.array(self._stamps_s), np.array(self._poses).reshape(-1, 4, 4))

    def about(self) -> dict[str, Any]:
        """The version of OpenCV."""
        return {"package": "opencv-python-headless", "version": cv2.__version__}

    def _prepared(self, frame: Frame) -> cv2.OdometryFrame:
        depth_m = frame.image("depth").astype(np.float32) / np.float32(self._units_per_m)
        depth_m[depth_m <= 0] = np.nan
        prepared = cv2.OdometryFrame(depth_m, to_grey(frame.image("left")))
        self._odometry.prepareFrame(prepared)
        return prepared


def settings_of(values: dict[str, Any]) -> cv2.OdometrySettings:
    """OpenCV's settings with the parameters of the run."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera_matrix(values, "left").astype(np.float32))
    settings.setMinDepth(values["min_depth"])
    settings.setMaxDepth(values["max_depth"])
    settings.setMaxDepthDiff(values["max_depth_difference"])
    settings.setMaxPointsPart(values["points_share"])
    settings.setMaxTranslation(values["max_translation"])
    settings.setMaxRotation(values["max_rotation"])
    return settings


if __name__ == "__main__":
    sys.exit(run(RgbdOdometry))
