"""A dataset importer: folders of the TUM RGB-D benchmark, depth images and ground truth, to datasets.

`slamhive dataset import FOLDER --format tum-depth` makes a dataset of one. Copy this file and change what it reads.
"""

from pathlib import Path

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    rate_hz,
)
from slamhive.recordings.writers import BagWriter, nanoseconds
from slamhive.trajectory.layout import read_tum

LIST = "depth.txt"
TRUTH = "groundtruth.txt"


class TumDepthImporter:
    """`depth.txt` lists images as `timestamp depth/NAME.png`; `groundtruth.txt` has the format that SLAM Hive uses."""

    title = "TUM RGB-D, depth images alone"
    options = frozenset({"depth_units_per_m"})
    """The options of `slamhive dataset import` that this format takes; others are refused."""

    refines = frozenset({"tum-rgbd"})
    """Where the format tum-rgbd fits too, this one is chosen."""

    def detect(self, path: Path) -> Detection:
        """Say what speaks for the format and what is missing. Without `--format`, every importer is asked."""
        names = (LIST, "depth", TRUTH)
        there = {name: (path / name).exists() for name in names}
        return Detection(
            found=tuple(name for name in names if there[name]), missing=tuple(name for name in names if not there[name])
        )

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Say what the folder becomes. Users see this before anything is written; images are read one by one later."""
        images = read_list(source / LIST)
        truth = read_tum(source / TRUTH)
        stream = depth_stream(source, images, options.depth_units_per_m or 5000.0)
        return ImportPlan(
            recording=(stream,),
            truth=PlannedTruth(
                truth.stamps_s,
                truth.positions_m,
                truth.quats_xyzw,
                gravity_aligned=True,
                source="motion capture",
            ),
            text=DatasetText(title=f"TUM RGB-D, depth of {source.name}", licence="CC BY 4.0"),
        )


def read_list(path: Path) -> list[tuple[float, str]]:
    """Timestamps in s, and files. A mistake becomes an InvalidInput that names the file, the line and the value."""
    images = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if line.strip() and not line.startswith("#"):
            try:
                timestamp, file = line.split()
                images.append((float(timestamp), file))
            except ValueError:
                raise InvalidInput(f"{path}:{number}: {line!r} is no 'timestamp file'", "correct the line") from None
    if len(images) < 2:
        raise InvalidInput(f"{path} lists {len(images)} images, a recording takes at least 2")
    return images


def depth_stream(source: Path, images: list[tuple[float, str]], units_per_m: float) -> PlannedStream:
    """The messages of the depth camera: their timestamps, and how one of them is written."""
    times_ns = np.array([nanoseconds(timestamp_s) for timestamp_s, _ in images])
    height, width = read_depth(source / images[0][1]).shape
    sensor = Sensor(
        name="depth0",
        kind=SensorKind.DEPTH,
        topic="/depth0/image_raw",
        rate_hz=rate_hz(times_ns),
        calibration={  # the camera freiburg3 of the benchmark; docs/dataset-format.md explains every key
            "width": width,
            "height": height,
            "fx": 535.4,
            "fy": 539.2,
            "cx": 320.1,
            "cy": 247.6,
            "encoding": "16UC1",
            "units_per_m": units_per_m,
        },
    )

    def write(bag: BagWriter, index: int) -> None:
        bag.image(sensor, int(times_ns[index]), read_depth(source / images[index][1]), "16UC1")

    return PlannedStream(sensor, times_ns, write, message_bytes=2 * width * height)


def read_depth(path: Path) -> np.ndarray:
    """The depth image at `path`, (h, w) uint16."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        raise InvalidInput(f"{path} is no image of 16 bits", "copy it again from the benchmark")
    return pixels


IMPORTER = TumDepthImporter()
