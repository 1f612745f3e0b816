"""DPVO under the container contract: one camera in, the camera's trajectory out, of unknown scale. Unverified."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from dpvo.config import cfg
from dpvo.dpvo import DPVO
from dpvo_input import Camera, settings_of

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import weights_file
from slamhive.runtime.trajectory import Poses, poses_of_rows


class Dpvo:
    """Tracks frame by frame. The trajectory has a pose for each frame, and is the one after the last update."""

    def __init__(self, config: RunConfig) -> None:
        self._camera = Camera(config.parameters)
        self._weights = weights_file("dpvo.pth")
        if not torch.cuda.is_available():
            raise InvalidInput("DPVO needs a GPU, and PyTorch finds none", "check the driver and Docker's GPU support")
        torch.manual_seed(config.seed)
        cfg.merge_from_list(settings_of(config.parameters))
        self._slam: DPVO | None = None
        self._stamps_s: list[float] = []

    def process(self, frame: Frame) -> None:
        """Track one frame."""
        image = self._camera.image(frame.image("left"))
        if self._slam is None:
            height, width = image.shape[:2]
            self._slam = DPVO(cfg, str(self._weights), ht=height, wd=width, viz=False)
        pixels = torch.from_numpy(image).permute(2, 0, 1).cuda()
        intrinsics = torch.tensor(self._camera.intrinsics).cuda()
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
        return poses_of_rows(np.array(self._stamps_s), table)

    def about(self) -> dict[str, Any]:
        """The network's framework and the GPU."""
        return {"package": "dpvo", "torch": torch.__version__, "gpu": torch.cuda.get_device_name()}


if __name__ == "__main__":
    sys.exit(run(Dpvo))
