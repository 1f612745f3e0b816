"""What formats with colour and depth images share: sensors and streams of one camera and its registered depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.bags.bag_writer import NS_PER_S
from slamhive.bags.frame_files import has_colour, read_image
from slamhive.bags.geometry import Array
from slamhive.bags.image_stream import ReadFrame, image_stream
from slamhive.bags.importing import Stream, rate_hz
from slamhive.bags.timed_list import read_timed_list
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind
from slamhive.errors import InvalidInput
from slamhive.trajectory.layout import TimeUnit


@dataclass(frozen=True, eq=False)
class Frames:
    """The images of one camera: timestamps, int64 (n,), and n files."""

    times_ns: Array
    paths: Sequence[Path]


def listed_frames(source: Path, name: str) -> tuple[Frames, tuple[str, ...]]:
    """The images that the list ``name`` names as ``seconds file``, and notes on those that are missing.

    Raises InvalidInput naming the line, or if all are missing.
    """
    rows = read_timed_list(source / name, "timestamp filename", TimeUnit.S)
    kept, paths = rows.files(source)
    return Frames(kept.times_ns, paths), rows.notes(kept)


def nominal_times_ns(numbers: Sequence[int], frames_per_s: float) -> Array:
    """The timestamps of frames of which only the number is known, int64 (n,); raises InvalidInput."""
    if not 0 < frames_per_s <= 10_000:
        raise InvalidInput(f"{frames_per_s:g} frames per second make no sense", "give --frame-rate above 0")
    return np.array([round(number * NS_PER_S / frames_per_s) for number in numbers], dtype=np.int64)


def size_of(path: Path) -> tuple[int, int]:
    """Width and height of an image in pixels; raises InvalidInput."""
    height, width = read_image(path, "mono8").shape
    return int(width), int(height)


def camera_stream(
    name: str,
    frames: Frames,
    intrinsics: CameraIntrinsics,
    T_body_sensor: Matrix4 = IDENTITY4,
    *,
    baseline_m: float = 0.0,
) -> Stream:
    """A camera whose images are grey or coloured as the first one is; raises InvalidInput."""
    encoding = "bgr8" if has_colour(frames.paths[0]) else "mono8"
    sensor = Sensor(
        name,
        SensorKind.CAMERA,
        f"/{name}/image_raw",
        rate_hz(frames.times_ns),
        T_body_sensor,
        intrinsics.calibration(encoding),
    )
    return image_stream(sensor, frames.times_ns, frames.paths, baseline_m=baseline_m)


def depth_stream(camera: Sensor, frames: Frames, units_per_m: float, *, read: ReadFrame = read_image) -> Stream:
    """The depth images that share the pixels of ``camera``; raises InvalidInput.

    Args:
        camera: The camera.
        frames: The depth images.
        units_per_m: The value of one metre.
        read: Reads ``16UC1`` by default; a reader of other files gives ``32FC1``.
    """
    if not 0 < units_per_m < 1e9:
        raise InvalidInput(f"{units_per_m:g} units per metre make no sense", "give --depth-units-per-m above 0")
    encoding = "16UC1" if read is read_image or units_per_m != 1 else "32FC1"
    calibration = CameraIntrinsics.of(camera).calibration(encoding, units_per_m=units_per_m, registered_to=camera.name)
    sensor = Sensor(
        "depth0", SensorKind.DEPTH, "/depth0/image_raw", rate_hz(frames.times_ns), camera.T_body_sensor, calibration
    )
    return image_stream(sensor, frames.times_ns, frames.paths, read=read)
