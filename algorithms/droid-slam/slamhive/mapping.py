"""DROID-SLAM under the container contract: one camera or a stereo pair. Unverified."""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from droid import Droid
from droid_input import Cameras, arguments_of

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import weights_file
from slamhive.runtime.trajectory import Poses, poses_of_rows


class DroidSlam:
    """Tracks frame by frame; after the last one, two passes of global optimisation and a pose for each frame."""

    def __init__(self, config: RunConfig) -> None:
        self._roles = ("left", "right") if "right" in config.algorithm_remap else ("left",)
        self._cameras = Cameras(config.parameters, self._roles)
        weights = weights_file("droid.pth")
        if not torch.cuda.is_available():
            problem = "DROID-SLAM needs a GPU, and PyTorch finds none"
            raise InvalidInput(problem, "check the driver and Docker's GPU support")
        self._intrinsics = torch.tensor(self._cameras.intrinsics)
        torch.manual_seed(config.seed)
        stereo = len(self._roles) == 2
        self._droid = Droid(
            Namespace(**arguments_of(config.parameters, str(weights), self._cameras.size, stereo=stereo))
        )
        self._stamps_s: list[float] = []
        self._images: list[np.ndarray] = []

    def process(self, frame: Frame) -> None:
        """Track one frame. Its left image is kept in memory: at the end, all frames get a pose from it."""
        images = self._cameras.images([frame.image(role) for role in self._roles])
        self._droid.track(len(self._stamps_s), torch.from_numpy(images), intrinsics=self._intrinsics)
        self._stamps_s.append(frame.stamp_s)
        self._images.append(images[:1])

    def finish(self) -> Poses:
        """Optimise everything. DROID-SLAM cannot end without enough keyframes, then there is no pose."""
        if not self._droid.frontend.is_initialized:
            return Poses(np.empty(0), np.empty((0, 4, 4)))
        table = self._droid.terminate(self._stream())
        return poses_of_rows(
            np.array(self._stamps_s), self._cameras.in_metres(table) if "right" in self._roles else table
        )

    def about(self) -> dict[str, Any]:
        """The network's framework and the GPU."""
        return {"package": "droid-slam", "torch": torch.__version__, "gpu": torch.cuda.get_device_name()}

    def _stream(self) -> Iterator[tuple[int, torch.Tensor, torch.Tensor]]:
        for number, images in enumerate(self._images):
            yield number, torch.from_numpy(images), self._intrinsics


if __name__ == "__main__":
    sys.exit(run(DroidSlam))
