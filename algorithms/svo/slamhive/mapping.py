"""SVO under the container contract: one camera in, the camera's trajectory out, of unknown scale."""

from __future__ import annotations

import ctypes
import os
import sys
from importlib.metadata import version
from typing import Any

import numpy as np
import svo_cpp

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.messages import to_grey
from slamhive.runtime.trajectory import Poses, transform_from

SETTINGS = (
    "max_fts",
    "quality_min_fts",
    "quality_max_drop_fts",
    "init_min_disparity",
    "triang_min_corner_score",
    "reproj_thresh",
    "max_n_kfs",
    "grid_size",
    "n_pyr_levels",
)
AGREEMENT_M = 1e-9


class Svo:
    """Tracks frame by frame. A frame has a pose once the map is initialised, and while SVO does not relocalise."""

    def __init__(self, config: RunConfig) -> None:
        values = config.parameters
        if distortion(values, "left"):
            raise InvalidInput("this package of SVO needs undistorted images", "rectify the images of the camera")
        svo_cpp.set_svo_config({key: values[key] for key in SETTINGS})
        size_and_intrinsics = [float(values[f"left_{key}"]) for key in ("width", "height", "fx", "fy", "cx", "cy")]
        # SVO keeps a bare pointer to the camera.
        self._camera = svo_cpp.PinholeCamera(*size_and_intrinsics)
        self._svo = svo_cpp.SVO(self._camera)
        self._svo.start()
        self._stamps_s: list[float] = []
        self._poses: list[np.ndarray] = []

    def process(self, frame: Frame) -> bool:
        """Track one frame."""
        self._svo.addImage(np.ascontiguousarray(to_grey(frame.image("left"))), frame.stamp_s)
        if self._svo.stage() != svo_cpp.Stage.DEFAULT_FRAME:
            return False
        T_camera_world = transform_of(self._svo.lastFrame().T_f_w)
        if not np.isfinite(T_camera_world).all():
            return False
        self._stamps_s.append(frame.stamp_s)
        self._poses.append(np.linalg.inv(T_camera_world))
        return True

    def finish(self) -> Poses:
        """The poses as they were when their frames were tracked."""
        return Poses(np.array(self._stamps_s), np.array(self._poses).reshape(-1, 4, 4))

    def about(self) -> dict[str, Any]:
        """The package that ran."""
        return {"package": "svo-cpp", "version": version("svo-cpp")}


def transform_of(pose: svo_cpp.SE3d) -> np.ndarray:
    """The 4x4 matrix of a pose; not finite if SVO diverged.

    The bindings return the translation, but cannot convert the quaternion (``unit_quaternion`` raises TypeError). It is
    read where the Python object points to: a Sophus ``SE3d`` is the quaternion x y z w, then the translation. Both
    translations, this and that of the inverse, must agree with what the bindings return.
    """
    address = ctypes.c_void_p.from_address(id(pose) + object.__basicsize__).value
    if address is None:
        raise InvalidInput("svo_cpp holds its poses differently than in version 1.5.0", "install svo-cpp==1.5.0")
    numbers = np.array((ctypes.c_double * 7).from_address(address))
    if not np.isfinite(numbers).all():
        return np.full((4, 4), np.nan)
    norm = float(np.linalg.norm(numbers[:4]))
    if not 0.999 < norm < 1.001:
        raise InvalidInput("svo_cpp holds its poses differently than in version 1.5.0", "install svo-cpp==1.5.0")
    T: np.ndarray = transform_from(numbers[4:], numbers[:4])
    inverse_m = np.ravel(pose.inverse().translation())
    off_m = [T[:3, 3] - np.ravel(pose.translation()), -T[:3, :3].T @ T[:3, 3] - inverse_m]
    if np.abs(off_m).max() > AGREEMENT_M + 1e-6 * np.abs(inverse_m).max():
        raise InvalidInput("svo_cpp holds its poses differently than in version 1.5.0", "install svo-cpp==1.5.0")
    return T


def silence() -> None:
    """Leave what the library prints, several lines a frame, out of the log; our own lines stay."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in ("stdout", "stderr"):
        descriptor = getattr(sys, stream).fileno()
        setattr(sys, stream, os.fdopen(os.dup(descriptor), "w", buffering=1))
        os.dup2(nowhere, descriptor)
    os.close(nowhere)


if __name__ == "__main__":
    silence()
    sys.exit(run(Svo))
