"""Streams of images: one file a message, decoded to raw pixels, all of one size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from slamhive.bags.bag_writer import BagWriter
from slamhive.bags.frame_files import pixel_bytes, read_image
from slamhive.bags.geometry import Array
from slamhive.bags.importing import Stream
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput

OVERHEAD_BYTES = 1000
"""Of a message: header, camera info, index."""

ReadFrame = Callable[[Path, str], Array]
"""Reads the pixels of a file in an encoding."""


def image_stream(
    sensor: Sensor,
    times_ns: Array,
    paths: Sequence[Path],
    *,
    baseline_m: float = 0.0,
    read: ReadFrame = read_image,
) -> Stream:
    """The images of a camera or depth camera; a camera's ``CameraInfo`` comes with each.

    Args:
        sensor: Its calibration holds size and encoding.
        times_ns: When each image was taken, (n,), increasing.
        paths: The n files.
        baseline_m: How far a rectified camera is right of its left partner.
        read: Reads a file that is no image, for instance an array.

    Raises:
        InvalidInput: The first image cannot be read, or has another size than the calibration. Later ones are checked
            when they are written.
    """
    intrinsics, encoding = CameraIntrinsics.of(sensor), str(sensor.calibration["encoding"])

    def pixels_of(path: Path) -> Array:
        pixels = read(path, encoding)
        check_size(path, pixels, sensor.name, intrinsics)
        return pixels

    def write(bag: BagWriter, index: int) -> None:
        pixels, stamp_ns = pixels_of(paths[index]), int(times_ns[index])
        if sensor.kind is SensorKind.CAMERA:
            bag.camera_info(sensor, f"/{sensor.name}/camera_info", stamp_ns, baseline_m)
        bag.image(sensor, stamp_ns, pixels, encoding)

    pixels_of(paths[0])
    message_bytes = intrinsics.width * intrinsics.height * pixel_bytes(encoding) + OVERHEAD_BYTES
    return Stream(sensor, times_ns, write, message_bytes)


def check_size(path: Path, pixels: Array, owner: str, intrinsics: CameraIntrinsics) -> None:
    """Raise InvalidInput if ``pixels`` (h, w, ...) of the file ``path`` do not have the size of the calibration."""
    if pixels.shape[:2] != (intrinsics.height, intrinsics.width):
        raise InvalidInput(
            f"frame {path} is {pixels.shape[1]}x{pixels.shape[0]} pixels, "
            f"the calibration of {owner} says {intrinsics.width}x{intrinsics.height}",
            "all frames of a camera must have the size of its calibration: is this frame from another sequence?",
        )
