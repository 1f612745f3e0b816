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

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import RADTAN, check_model, distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.network_images import blue_first
from slamhive.runtime.paths import weights_file
from slamhive.runtime.trajectory import Poses, poses_of_rows

PROJECT = Path(os.environ.get("MAST3R_SLAM", "/opt/MASt3R-SLAM"))
MODEL = "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric"
WEIGHTS = (f"{MODEL}.pth", f"{MODEL}_retrieval_trainingfree.pth", f"{MODEL}_retrieval_codebook.pkl")
IMAGES = "images"
RATE_HZ = 30.0
"""The program gives the images of a folder timestamps at this rate."""
LAST_LINES = 3


class Mast3rSlam:
    """Writes the images, then runs the program on them."""

    def __init__(self, config: RunConfig) -> None:
        self._values = config.parameters
        checkpoints = {weights_file(name).parent for name in WEIGHTS}.pop()
        self._work = tempfile.TemporaryDirectory(prefix="mast3r-slam-")
        self._folder = Path(self._work.name)
        (self._folder / IMAGES).mkdir()
        (self._folder / "checkpoints").symlink_to(checkpoints)
        (self._folder / "config").symlink_to(PROJECT / "config")
        if self._values["calibrated"]:
            self._write_calibration()
        self._stamps_s: list[float] = []

    def process(self, frame: Frame) -> None:
        """Write every n-th image; OpenCV writes blue first."""
        if frame.number % self._values["every"] == 0:
            path = self._folder / IMAGES / f"{len(self._stamps_s):08d}.png"
            if not cv2.imwrite(str(path), blue_first(frame.image("left"))):
                raise InvalidInput(f"{path} cannot be written", "raise RUN_DISK_MB")
            self._stamps_s.append(frame.stamp_s)

    def finish(self) -> Poses:
        """Run the program; the poses of its keyframes."""
        with self._work:
            self._run()
            found = self._folder / "logs" / f"{IMAGES}.txt"
            return poses_in(found, self._stamps_s) if found.is_file() else Poses(np.empty(0), np.empty((0, 4, 4)))

    def about(self) -> dict[str, Any]:
        """True if it knew the camera."""
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


def poses_in(path: Path, stamps_s: list[float]) -> Poses:
    """The poses that the program saved, at the timestamps of the recording. Raises InvalidInput for other text.

    The program numbers the images through timestamps of its own. Numbers are read back from those.
    """
    by_number = dict(enumerate(stamps_s))
    try:
        table = np.loadtxt(path, ndmin=2).reshape(-1, 8)
        stamps = np.array([by_number[round(own * RATE_HZ)] for own in table[:, 0]])
    except (ValueError, KeyError):
        raise InvalidInput("MASt3R-SLAM saved a trajectory that does not fit the images it was given") from None
    return poses_of_rows(stamps, table[:, 1:])


if __name__ == "__main__":
    sys.exit(run(Mast3rSlam))
