"""COLMAP under the container contract: structure from motion of all images at once, after the recording has ended."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from slamhive.base.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import EQUIDISTANT, RADTAN, check_model, distortion
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.messages import to_grey
from slamhive.runtime.trajectory import Poses

INTRINSICS = ("fx", "fy", "cx", "cy")
FEWEST_IMAGES = 3


class Colmap:
    """Keeps every n-th image, and reconstructs them when the recording has ended.

    The largest reconstruction counts: others have worlds of their own.
    """

    def __init__(self, config: RunConfig) -> None:
        self._values = config.parameters
        self._seed = config.seed
        self._camera_model, self._camera_parameters = camera_of(self._values)
        self._work = tempfile.TemporaryDirectory(prefix="colmap-")
        self._folder = Path(self._work.name)
        self._images = self._folder / "images"
        self._images.mkdir()
        self._stamps_s: dict[str, float] = {}

    def process(self, frame: Frame) -> None:
        """Keep the image if it is one of those that are reconstructed."""
        if frame.number % self._values["every"] == 0:
            name = f"{frame.number:08d}.png"
            grey = np.ascontiguousarray(to_grey(frame.image("left")))
            if not pycolmap.Bitmap.from_array(grey).write(str(self._images / name)):
                raise InvalidInput(f"image {name} cannot be written to {self._images}", "raise RUN_DISK_MB")
            self._stamps_s[name] = frame.stamp_s

    def finish(self) -> Poses:
        """Reconstruct; the images of the largest reconstruction have poses."""
        if len(self._stamps_s) < FEWEST_IMAGES:
            return Poses(np.empty(0), np.empty((0, 4, 4)))
        pycolmap.set_random_seed(self._seed)
        database = self._folder / "database.db"
        self._extract(database)
        self._match(database)
        found = self._reconstruct(database).values()
        images = max(found, key=lambda entry: entry.num_reg_images()).images.values() if found else []
        poses = {self._stamps_s[image.name]: T_world_camera(image) for image in images if image.has_pose}
        return Poses(np.array(list(poses)), np.array(list(poses.values())).reshape(-1, 4, 4))

    def about(self) -> dict[str, Any]:
        """The package that ran."""
        return {"package": "pycolmap", "version": pycolmap.__version__, "offline": True}

    def _extract(self, database: Path) -> None:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = self._camera_model
        reader.camera_params = ",".join(map(repr, self._camera_parameters))
        options = pycolmap.FeatureExtractionOptions()
        options.num_threads = self._values["threads"]
        options.sift.max_num_features = self._values["features"]
        options.sift.first_octave = -1 if self._values["double_size"] else 0
        pycolmap.extract_features(
            database,
            self._images,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )

    def _match(self, database: Path) -> None:
        pairs = pycolmap.SequentialPairingOptions()
        pairs.overlap = self._values["overlap"]
        pairs.quadratic_overlap = self._values["quadratic_overlap"]
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = self._values["threads"]
        pycolmap.match_sequential(database, matching_options=options, pairing_options=pairs, device=pycolmap.Device.cpu)

    def _reconstruct(self, database: Path) -> dict[int, pycolmap.Reconstruction]:
        """Each reconstruction by its number. The intrinsics of the dataset are kept."""
        output = self._folder / "sparse"
        output.mkdir()
        if self._values["mapper"] == "global":
            whole = pycolmap.GlobalPipelineOptions()
            whole.num_threads, whole.random_seed = self._values["threads"], self._seed
            whole.mapper.bundle_adjustment.refine_focal_length = False
            whole.mapper.bundle_adjustment.refine_extra_params = False
            return pycolmap.global_mapping(database, self._images, output, whole)
        steps = pycolmap.IncrementalPipelineOptions()
        steps.num_threads, steps.random_seed = self._values["threads"], self._seed
        steps.ba_refine_focal_length = steps.ba_refine_extra_params = False
        steps.mapper.abs_pose_refine_focal_length = steps.mapper.abs_pose_refine_extra_params = False
        return pycolmap.incremental_mapping(database, self._images, output, steps)


def camera_of(values: dict[str, Any]) -> tuple[str, list[float]]:
    """COLMAP's camera model and its parameters. Raises InvalidInput for a lens that it cannot describe."""
    intrinsics = [float(values[f"left_{key}"]) for key in INTRINSICS]
    coefficients = distortion(values, "left")
    if not coefficients:
        return "PINHOLE", intrinsics
    check_model(values, "left", (*RADTAN, *EQUIDISTANT), 4, "COLMAP")
    fisheye = values.get("left_model") in EQUIDISTANT
    return ("OPENCV_FISHEYE" if fisheye else "OPENCV"), [*intrinsics, *coefficients, *[0.0] * (4 - len(coefficients))]


def T_world_camera(image: pycolmap.Image) -> np.ndarray:
    """The pose (4, 4) of an image."""
    T = np.eye(4)
    T[:3] = image.cam_from_world().inverse().matrix()
    return T


if __name__ == "__main__":
    sys.exit(run(Colmap))
