"""Streams of images: one file a message, decoded to raw pixels, all of one size."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import Matrix4, Sensor, SensorKind
from slamhive.recordings.frame_files import pixel_bytes, read_image
from slamhive.recordings.geometry import Array
from slamhive.recordings.importing import PlannedStream
from slamhive.recordings.text_lists import Track
from slamhive.recordings.writers import BagWriter

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
) -> PlannedStream:
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
    return PlannedStream(sensor, times_ns, write, message_bytes)


def check_size(path: Path, pixels: Array, owner: str, intrinsics: CameraIntrinsics) -> None:
    """Raise InvalidInput if ``pixels`` (h, w, ...) of the file ``path`` do not have the size of the calibration."""
    if pixels.shape[:2] != (intrinsics.height, intrinsics.width):
        raise InvalidInput(
            f"frame {path} is {pixels.shape[1]}x{pixels.shape[0]} pixels, "
            f"the calibration of {owner} says {intrinsics.width}x{intrinsics.height}",
            "all frames of a camera must have the size of its calibration: is this frame from another sequence?",
        )


# Streams of IMU samples.


_IMU_BYTES = 400


def imu_stream(sensor: Sensor, times_ns: Array, samples: Array) -> PlannedStream:
    """The messages of an IMU; ``samples`` (n, 6) are angular rates in rad/s and accelerations in m/s²."""

    def write(bag: BagWriter, index: int) -> None:
        bag.imu(sensor, int(times_ns[index]), samples[index, :3], samples[index, 3:])

    return PlannedStream(sensor, times_ns, write, _IMU_BYTES)


# Streams of GNSS positions.


_FIX_BYTES = 250


def gnss_stream(sensor: Sensor, times_ns: Array, positions: Array, variances_m2: Array | None = None) -> PlannedStream:
    """The messages of a receiver.

    Args:
        sensor: The receiver.
        times_ns: Int64 (n,).
        positions: Latitude and longitude in degrees, altitude in m, (n, 3).
        variances_m2: Of east, north and up (n, 3); None if they are not known.
    """

    def write(bag: BagWriter, index: int) -> None:
        variances = None if variances_m2 is None else variances_m2[index]
        bag.nav_sat_fix(sensor, int(times_ns[index]), positions[index], variances)

    return PlannedStream(sensor, times_ns, write, _FIX_BYTES)


# Poses and laser scans in a plane: streams of 2D laser scanners and of wheel odometry.


_ODOMETRY_BYTES = 750
_SCAN_BYTES = 150


def pose_quats_xyzw(yaws_rad: Array) -> Array:
    """Unit quaternions (n, 4) of rotations by ``yaws_rad`` (n,) around z."""
    zeros = np.zeros(len(yaws_rad))
    return np.stack([zeros, zeros, np.sin(yaws_rad / 2), np.cos(yaws_rad / 2)], axis=1)


def planar_transform(x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> Matrix4:
    """A transform that turns around z only."""
    c, s = float(np.cos(yaw_rad)), float(np.sin(yaw_rad))
    return (c, -s, 0.0, x_m, s, c, 0.0, y_m, 0.0, 0.0, 1.0, z_m, 0.0, 0.0, 0.0, 1.0)


def odometry_stream(sensor: Sensor, times_ns: Array, poses: Array, twists: Array | None = None) -> PlannedStream:
    """The messages of planar odometry.

    Args:
        sensor: The wheels.
        times_ns: Int64 (n,).
        poses: x, y in m and yaw in rad, (n, 3).
        twists: Forward velocity in m/s and yaw rate in rad/s, (n, 2); None if they are not known.
    """
    quats_xyzw = pose_quats_xyzw(poses[:, 2])

    def write(bag: BagWriter, index: int) -> None:
        pose = np.concatenate([poses[index, :2], [0.0], quats_xyzw[index]])
        twist = np.zeros(6)
        if twists is not None:
            twist[[0, 5]] = twists[index]
        bag.odometry(sensor, int(times_ns[index]), pose, twist)

    return PlannedStream(sensor, times_ns, write, _ODOMETRY_BYTES)


def laser_stream(sensor: Sensor, track: Track, scans: Callable[[], Iterator[Array]], count: int) -> PlannedStream:
    """The messages of a laser scanner whose file is read a second time while the recording is written.

    Scans that stand before earlier ones wait in memory, so memory grows with how late scans are, not with the file.

    Args:
        sensor: The scanner.
        track: The times of all scans of the file.
        scans: Starts reading the ranges (``count``,) in m of all scans of the file.
        count: Ranges of a scan.
    """
    times_ns, kept = track.times_ns, track.kept.tolist()
    wanted = frozenset(kept)
    reading: list[Iterator[tuple[int, Array]]] = []
    waiting: dict[int, Array] = {}

    def write(bag: BagWriter, index: int) -> None:
        if index == 0:
            reading[:] = [enumerate(scans())]
            waiting.clear()
        while kept[index] not in waiting:
            number, ranges_m = next(reading[0], (-1, None))
            if ranges_m is None:
                break
            if number in wanted:
                waiting[number] = ranges_m
        ranges_m = waiting.pop(kept[index], None)
        if ranges_m is None or len(ranges_m) != count:
            raise InvalidInput(f"scan {index} of {sensor.name} changed while it was imported", "import again")
        bag.laser_scan(sensor, int(times_ns[index]), ranges_m)

    return PlannedStream(sensor, times_ns, write, _SCAN_BYTES + 4 * count)


# Streams of LiDAR scans that lie in one file each, named by their timestamps.


_OVERHEAD_BYTES = 1000
_MOST_NS = 2**31 * 10**9
_REMEDY = "copy or download the file again"


def timed_files(folder: Path, suffix: str, ns_per_unit: int) -> tuple[Array, list[Path]]:
    """The files of ``folder`` in the order of the whole numbers that name them.

    Returns:
        Their times in ns, int64 (n,), and the files.

    Raises:
        InvalidInput: A name is no timestamp, or there are fewer than two files.
    """
    found: dict[int, Path] = {}
    for path in visible_files(folder, f"*{suffix}"):
        if not (path.stem.isascii() and path.stem.isdigit()) or int(path.stem) * ns_per_unit >= _MOST_NS:
            raise InvalidInput(f"{path} is not named by a timestamp", "remove the file, or give it its name again")
        found[int(path.stem) * ns_per_unit] = path
    if len(found) < 2:
        raise InvalidInput(f"{folder} has {len(found)} files *{suffix}", "two are needed at least")
    times = sorted(found)
    return np.array(times, dtype=np.int64), [found[time] for time in times]


def point_stream(
    sensor: Sensor, times_ns: Array, paths: list[Path], read: Callable[[Path], Array], point_bytes: float
) -> PlannedStream:
    """The messages of a LiDAR; ``read`` gives a structured array, ``point_bytes`` is its size per byte of a file."""

    def write(bag: BagWriter, index: int) -> None:
        stamp_ns = int(times_ns[index])
        bag.points(sensor, stamp_ns, stamp_ns, read(paths[index]))

    size = sum(path.stat().st_size for path in paths) / len(paths)
    return PlannedStream(sensor, times_ns, write, int(size * point_bytes) + _OVERHEAD_BYTES)


def read_records(path: Path, record: np.dtype[np.void]) -> Array:
    """The records of a binary file; raises InvalidInput unless it holds a whole number of them, one at least."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}", _REMEDY) from None
    if not data or len(data) % record.itemsize:
        names = ", ".join(record.names or ())
        raise InvalidInput(f"{path} has {len(data)} bytes, not a multiple of {record.itemsize} ({names})", _REMEDY)
    records: Array = np.frombuffer(data, dtype=record)
    return records
