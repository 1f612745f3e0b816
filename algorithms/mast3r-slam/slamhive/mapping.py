"""MASt3R-SLAM under the container contract: one camera, keyframe poses of unknown scale. Unverified.

Its ``main.py`` reads a folder of images. So the images of the recording are written first, and the program runs at the
end.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamhive.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import RADTAN, check_model, distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.paths import WEIGHTS_VARIABLE
from slamhive.runtime.trajectory import Poses, transform_from

PROJECT = Path(os.environ.get("MAST3R_SLAM", "/opt/MASt3R-SLAM"))
IMAGES = "images"
RATE_HZ = 30.0
"""The program gives the images of a folder timestamps at this rate."""
LAST_LINES = 3


class Mast3rSlam:
    """Writes the images, then runs the program on them."""

    def __init__(self, config: RunConfig) -> None:
        self._values = config.parameters
        self._work = tempfile.TemporaryDirectory(prefix="mast3r-slam-")
        self._folder = Path(self._work.name)
        (self._folder / IMAGES).mkdir()
        (self._folder / "checkpoints").symlink_to(os.environ.get(WEIGHTS_VARIABLE, "/slamhive-weights"))
        (self._folder / "config").symlink_to(PROJECT / "config")
        if self._values["calibrated"]:
            self._write_calibration()
        self._stamps_s: list[float] = []

    def process(self, frame: Frame) -> None:
        """Write every n-th image; OpenCV writes blue first."""
        if frame.number % self._values["every"] == 0:
            image = frame.image("left")
            path = self._folder / IMAGES / f"{len(self._stamps_s):08d}.png"
            if not cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1]):
                raise InvalidInput(f"{path} cannot be written", "raise RUN_DISK_MB")
            self._stamps_s.append(frame.stamp_s)

    def finish(self) -> Poses:
        """Run the program; the poses of its keyframes."""
        self._run()
        found = sorted((self._folder / "logs").rglob(f"{IMAGES}.txt"))
        if not found:
            return Poses(np.empty(0), np.empty((0, 4, 4)))
        table = np.loadtxt(found[0], ndmin=2).reshape(-1, 8)
        numbers = np.rint(table[:, 0] * RATE_HZ).astype(int)
        poses = np.array([transform_from(row[1:4], row[4:8]) for row in table]).reshape(-1, 4, 4)
        return Poses(np.array(self._stamps_s)[numbers], poses)

    def about(self) -> dict[str, Any]:
        """Whether it knew the camera."""
        return {"package": "mast3r-slam", "calibrated": bool(self._values["calibrated"]), "offline": True}

    def _write_calibration(self) -> None:
        check_model(self._values, "left", RADTAN, 5, "MASt3R-SLAM")
        numbers = [float(self._values[f"left_{key}"]) for key in ("fx", "fy", "cx", "cy")]
        numbers += distortion(self._values, "left")
        size = f"width: {int(self._values['left_width'])}\nheight: {int(self._values['left_height'])}\n"
        (self._folder / "intrinsics.yaml").write_text(f"{size}calibration: {numbers}\n", encoding="ascii")

    def _run(self) -> None:
        settings = "config/calib.yaml" if self._values["calibrated"] else "config/base.yaml"
        command = [sys.executable, str(PROJECT / "main.py"), "--no-viz", "--dataset", IMAGES, "--config", settings]
        if self._values["calibrated"]:
            command += ["--calib", "intrinsics.yaml"]
        path = os.pathsep.join([str(PROJECT), *filter(None, [os.environ.get("PYTHONPATH")])])
        ended = subprocess.run(
            command,
            cwd=self._folder,
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if ended.returncode != 0:
            raise InvalidInput(f"MASt3R-SLAM failed: {' | '.join(ended.stdout.strip().splitlines()[-LAST_LINES:])}")


if __name__ == "__main__":
    sys.exit(run(Mast3rSlam))
