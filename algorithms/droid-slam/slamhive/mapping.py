"""DROID-SLAM under the container contract: one camera or a stereo pair. Unverified."""

from __future__ import annotations

import os
import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from droid import Droid
from torch.nn.functional import interpolate

from slamhive.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import camera_matrix, distortion, transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import WEIGHTS_VARIABLE
from slamhive.runtime.trajectory import Poses, transform_from

MULTIPLE_PX = 8
"""Height and width of the network's images are multiples of this."""
ASSUMED_BASELINE_M = 0.1
"""Upstream's geometry of a stereo pair (``projective_ops.py``); its script for EuRoC scales by 1.10."""
FIXED = {"disable_vis": True, "upsample": False, "frontend_nms": 1, "frontend_radius": 2, "backend_radius": 2}


class DroidSlam:
    """Tracks frame by frame; after the last one, two passes of global optimisation and a pose for each frame."""

    def __init__(self, config: RunConfig) -> None:
        self._values = values = config.parameters
        self._roles = ("left", "right") if "right" in config.algorithm_remap else ("left",)
        if any(distortion(values, role) for role in self._roles):
            raise InvalidInput("DROID-SLAM needs undistorted images", "rectify the images of the cameras")
        if not torch.cuda.is_available():
            problem = "DROID-SLAM needs a GPU, and PyTorch finds none"
            raise InvalidInput(problem, "check the driver and Docker's GPU support")
        self._size, self._intrinsics = scaled(values)
        torch.manual_seed(config.seed)
        weights = Path(os.environ.get(WEIGHTS_VARIABLE, "/slamhive-weights")) / "droid.pth"
        self._droid = Droid(
            Namespace(
                **FIXED,
                weights=str(weights),
                image_size=list(self._size),
                stereo=len(self._roles) == 2,
                **{key: value for key, value in values.items() if key in PARAMETERS},
            )
        )
        self._stamps_s: list[float] = []
        self._images: list[np.ndarray] = []

    def process(self, frame: Frame) -> None:
        """Track one frame. Its left image is kept in memory: at the end, all frames get a pose from it."""
        images = np.stack([self._image(frame, role) for role in self._roles])
        self._droid.track(len(self._stamps_s), torch.from_numpy(images), intrinsics=self._intrinsics)
        self._stamps_s.append(frame.stamp_s)
        self._images.append(images[:1])

    def finish(self) -> Poses:
        """Optimise everything. DROID-SLAM cannot end without enough keyframes, then there is no pose."""
        if not self._droid.frontend.is_initialized:
            return Poses(np.empty(0), np.empty((0, 4, 4)))
        table = self._droid.terminate(self._stream())
        if "right" in self._roles:
            baseline_m = float(np.linalg.norm(transform(self._values, "left", "right")[:3, 3]))
            table[:, :3] *= baseline_m / ASSUMED_BASELINE_M
        poses = np.array([transform_from(row[:3], row[3:7]) for row in table])
        return Poses(np.array(self._stamps_s), poses)

    def about(self) -> dict[str, Any]:
        """The network's framework and the GPU."""
        return {"package": "droid-slam", "torch": torch.__version__, "gpu": torch.cuda.get_device_name()}

    def _image(self, frame: Frame, role: str) -> np.ndarray:
        """(3, h, w) uint8, blue first as OpenCV reads images, in the size that the network gets."""
        image = frame.image(role)
        colour = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., ::-1]
        pixels = torch.from_numpy(np.ascontiguousarray(colour)).permute(2, 0, 1)[None].float()
        resized = interpolate(pixels, self._size, mode="bilinear", align_corners=False)
        array: np.ndarray = resized[0].round().to(torch.uint8).numpy()
        return array

    def _stream(self) -> Iterator[tuple[int, torch.Tensor, torch.Tensor]]:
        for number, images in enumerate(self._images):
            yield number, torch.from_numpy(images), self._intrinsics


PARAMETERS = (
    "buffer",
    "beta",
    "filter_thresh",
    "warmup",
    "keyframe_thresh",
    "frontend_thresh",
    "frontend_window",
    "backend_thresh",
    "backend_nms",
)


def scaled(values: dict[str, Any]) -> tuple[tuple[int, int], torch.Tensor]:
    """Height and width near ``pixels`` in all, and the intrinsics fx, fy, cx, cy that fit them."""
    height, width = int(values["left_height"]), int(values["left_width"])
    factor = np.sqrt(values["pixels"] / (height * width))
    size = tuple(max(MULTIPLE_PX, int(side * factor) // MULTIPLE_PX * MULTIPLE_PX) for side in (height, width))
    K = camera_matrix(values, "left")
    x, y = size[1] / width, size[0] / height
    return (size[0], size[1]), torch.tensor([K[0, 0] * x, K[1, 1] * y, K[0, 2] * x, K[1, 2] * y])


if __name__ == "__main__":
    sys.exit(run(DroidSlam))
