"""A dataset importer: folders of the TUM RGB-D benchmark, depth images and ground truth, to datasets.

`slamhive dataset import tum-depth FOLDER --name NAME` makes a dataset of one. Copy this file and change what it reads.
"""

from pathlib import Path

import cv2

from slamhive.bags.bag_writer import BagWriter, nanoseconds
from slamhive.bags.detection import Detection
from slamhive.bags.staging import Progress, new_dataset
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput

LIST = "depth.txt"
TRUTH = "groundtruth.txt"


class TumDepthImporter:
    """`depth.txt` lists images as `timestamp depth/NAME.png`; `groundtruth.txt` has the format that SLAM Hive uses."""

    def detect(self, path: Path) -> Detection:
        """Say what speaks for the format and what is missing. `slamhive dataset import auto` asks every importer."""
        names = (LIST, "depth", TRUTH)
        there = {name: (path / name).exists() for name in names}
        return Detection(
            found=tuple(name for name in names if there[name]), missing=tuple(name for name in names if not there[name])
        )

    def convert(self, source: Path, folder: Path, name: str, progress: Progress) -> Dataset:
        """Make the dataset. The folder appears when the block ends well, and not at all after an error."""
        images = read_list(source / LIST)
        needed_bytes = sum((source / file).stat().st_size for _, file in images) * 4
        with new_dataset(folder, needed_bytes) as new:
            with new.recording() as bag:
                sensor = write_images(bag, source, images, progress)
            (new.aside / TRUTH).write_bytes((source / TRUTH).read_bytes())
            return new.seal(  # writes dataset.yaml, and the script that plays the recording
                sensors=(sensor,),
                duration_s=images[-1][0] - images[0][0],
                groundtruth=GroundTruth(TRUTH, gravity_aligned=True),
                title=f"{name}: TUM RGB-D, depth of {source.name}",
                licence="CC BY 4.0",
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


def write_images(bag: BagWriter, source: Path, images: list[tuple[float, str]], progress: Progress) -> Sensor:
    """Write the images to the recording; the sensor that they come from."""
    for number, (timestamp_s, file) in enumerate(images):
        pixels = cv2.imread(str(source / file), cv2.IMREAD_UNCHANGED)
        if pixels is None or pixels.dtype != "uint16":
            raise InvalidInput(f"{source / file} is no image of 16 bits", "copy it again from the benchmark")
        if number == 0:
            sensor = sensor_of(images, *pixels.shape)
        bag.image(sensor, nanoseconds(timestamp_s), pixels, "16UC1")
        progress(number / len(images), file)  # a fraction, and what is being done
    return sensor


def sensor_of(images: list[tuple[float, str]], height: int, width: int) -> Sensor:
    """The depth camera of the benchmark (freiburg3); docs/dataset-format.md explains every key."""
    return Sensor(
        name="depth0",
        kind=SensorKind.DEPTH,
        topic="/depth0/image_raw",
        rate_hz=(len(images) - 1) / (images[-1][0] - images[0][0]),
        calibration={
            "width": width,
            "height": height,
            "fx": 535.4,
            "fy": 539.2,
            "cx": 320.1,
            "cy": 247.6,
            "encoding": "16UC1",
            "units_per_m": 5000.0,
        },
    )


IMPORTER = TumDepthImporter()
