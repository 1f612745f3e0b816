"""Common parts of formats with colour and depth images: sensors and streams of one camera and its registered depth."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind, is_rigid
from slamhive.recordings.frame_files import has_colour, read_image
from slamhive.recordings.geometry import Array, quaternions_from_rotations
from slamhive.recordings.importing import PlannedStream, PlannedTruth, rate_hz
from slamhive.recordings.streams import ReadFrame, image_stream
from slamhive.recordings.text_lists import read_timed_list
from slamhive.recordings.writers import NS_PER_S
from slamhive.trajectory.layout import TimeUnit
from slamhive.trajectory.table import NumberTable, parse_table, read_bounded


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
) -> PlannedStream:
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


def depth_stream(camera: Sensor, frames: Frames, units_per_m: float, *, read: ReadFrame = read_image) -> PlannedStream:
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


# Frames of which only a number is known: files in the order of the number in their names, at a nominal rate.


_DIGITS = re.compile(r"\d+")


def rectified_intrinsics(A: Array, image: Path) -> CameraIntrinsics:
    """The intrinsics of a rectified camera with the size of ``image``.

    Args:
        A: Its camera matrix (3, 3), or a projection (3, 4) that begins with it.
        image: One of its images; raises InvalidInput if it cannot be read.
    """
    width, height = size_of(image)
    fx, fy, cx, cy = (float(A[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4, rectified=True)


def numbered(folder: Path, *patterns: str) -> dict[int, Path]:
    """The files of the first of ``patterns`` that matches, by the first number in their names; none without a match.

    Raises InvalidInput if two files have one number.
    """
    for pattern in patterns:
        found: dict[int, Path] = {}
        for path in visible_files(folder, pattern):
            digits = _DIGITS.search(path.name)
            if digits is None or len(digits[0]) > 12:
                continue
            if int(digits[0]) in found:
                raise InvalidInput(f"{found[int(digits[0])]} and {path} have the same number", "keep one of them")
            found[int(digits[0])] = path
        if found:
            return dict(sorted(found.items()))
    return {}


def timed(frames: dict[int, Path], frames_per_s: float) -> Frames:
    """The frames with nominal timestamps: number 0 is at 0 s; raises InvalidInput."""
    return Frames(nominal_times_ns(list(frames), frames_per_s), list(frames.values()))


def nominal_note(frames_per_s: float) -> str:
    """Note for users about such timestamps."""
    return f"timestamps are nominal: {frames_per_s:g} frames per second (--frame-rate)"


def read_pose_table(path: Path, columns: int, layout: str) -> Array:
    """The numbers of a pose file, float64 (n, columns); raises InvalidInput."""
    return parse_table(read_bounded(path), str(path), columns, layout).values


def read_frame_poses(path: Path, columns: int, layout: str, numbers: Sequence[int]) -> tuple[list[int], NumberTable]:
    """The poses of numbered frames: line n + 1 is that of frame n, or of the n-th frame from the first one.

    Args:
        path: One pose a line. A blank line stands for a frame whose pose is not known.
        columns: How many numbers a pose has.
        layout: The columns in words, for messages.
        numbers: Of the frames that are there, increasing.

    Returns:
        The frame of each pose, and the poses.

    Raises:
        InvalidInput: A row is bad, or it is in doubt to which frames the lines belong.
    """
    table = parse_table(read_bounded(path), str(path), columns, layout)
    count = int(table.places[-1]) + 1
    if count > numbers[-1]:
        first = 0
    elif count == numbers[-1] - numbers[0] + 1:
        first = numbers[0]
    else:
        raise InvalidInput(
            f"{path} has {count} poses, there are {len(numbers)} images from number {numbers[0]} to {numbers[-1]}",
            f"each needs its pose: line {numbers[-1] + 1} for the last, or as many lines as numbers from the first one",
        )
    return [first + place for place in table.places.tolist()], table


def truth_of_matrices(times_ns: Array, poses: Array, source: str, *, gravity_aligned: bool = False) -> PlannedTruth:
    """Ground truth of poses (n, 4, 4) that are known to be rigid."""
    return PlannedTruth(
        times_ns / 1e9,
        poses[:, :3, 3],
        quaternions_from_rotations(poses[:, :3, :3]),
        gravity_aligned=gravity_aligned,
        source=source,
    )


def is_pose(matrix: Array) -> bool:
    """Tell if a (4, 4) is a rigid transform; formats write NaN, infinity or zeros for poses that are not known."""
    numbers = matrix.reshape(-1).tolist()
    return numbers[12:] == list(IDENTITY4[12:]) and is_rigid(tuple(numbers))
