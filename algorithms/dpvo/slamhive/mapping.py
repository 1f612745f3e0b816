"""DPVO under the container contract: one camera in, the camera's trajectory out, of unknown scale. Unverified."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from dpvo.config import cfg
from dpvo.dpvo import DPVO

from slamhive.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import RADTAN, camera_matrix, check_model, distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import WEIGHTS_VARIABLE
from slamhive.runtime.trajectory import Poses, transform_from

SETTINGS = {
    "patches": "PATCHES_PER_FRAME",
    "buffer_size": "BUFFER_SIZE",
    "removal_window": "REMOVAL_WINDOW",
    "optimization_window": "OPTIMIZATION_WINDOW",
    "patch_lifetime": "PATCH_LIFETIME",
    "keyframe_threshold": "KEYFRAME_THRESH",
    "mixed_precision": "MIXED_PRECISION",
}
MULTIPLE_PX = 16
"""Height and width of the network's images are multiples of this."""


class Dpvo:
    """Tracks frame by frame. The trajectory has a pose for each frame, and is the one after the last update."""

    def __init__(self, config: RunConfig) -> None:
        self._values = config.parameters
        check_model(self._values, "left", RADTAN, 5, "DPVO")
        self._K = camera_matrix(self._values, "left")
        self._distortion = np.array(distortion(self._values, "left"))
        torch.manual_seed(config.seed)
        cfg.merge_from_list([part for key, name in SETTINGS.items() for part in (name, self._values[key])])
        self._weights = Path(os.environ.get(WEIGHTS_VARIABLE, "/slamhive-weights")) / "dpvo.pth"
        if not torch.cuda.is_available():
            raise InvalidInput("DPVO needs a GPU, and PyTorch finds none", "check the driver and Docker's GPU support")
        self._slam: DPVO | None = None
        self._stamps_s: list[float] = []

    def process(self, frame: Frame) -> None:
        """Track one frame."""
        image = self._image(frame)
        if self._slam is None:
            height, width = image.shape[:2]
            self._slam = DPVO(cfg, str(self._weights), ht=height, wd=width, viz=False)
        pixels = torch.from_numpy(image).permute(2, 0, 1).cuda()
        intrinsics = torch.tensor([self._K[0, 0], self._K[1, 1], self._K[0, 2], self._K[1, 2]]).cuda()
        with torch.no_grad():
            # The times are for the motion model, which needs differences only.
            self._slam(frame.stamp_s - self._stamps_s[0] if self._stamps_s else 0.0, pixels, intrinsics)
        self._stamps_s.append(frame.stamp_s)

    def finish(self) -> Poses:
        """The poses of all frames, after DPVO's last updates."""
        if self._slam is None or not self._slam.is_initialized:
            return Poses(np.empty(0), np.empty((0, 4, 4)))
        with torch.no_grad():
            table, _ = self._slam.terminate()
        poses = np.array([transform_from(row[:3], row[3:7]) for row in table])
        return Poses(np.array(self._stamps_s), poses)

    def about(self) -> dict[str, Any]:
        """The network's framework and the GPU."""
        return {"package": "dpvo", "torch": torch.__version__, "gpu": torch.cuda.get_device_name()}

    def _image(self, frame: Frame) -> np.ndarray:
        """The undistorted image, blue first as OpenCV reads it, cut to a size that the network takes."""
        image = frame.image("left")
        colour = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image[..., ::-1]
        colour = np.ascontiguousarray(colour)
        if len(self._distortion):
            colour = cv2.undistort(colour, self._K, self._distortion)
        height, width = (size - size % MULTIPLE_PX for size in colour.shape[:2])
        return np.ascontiguousarray(colour[:height, :width])


if __name__ == "__main__":
    sys.exit(run(Dpvo))
