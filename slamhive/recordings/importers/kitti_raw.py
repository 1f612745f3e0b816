"""Importer of KITTI's raw data, synchronised (Geiger et al., "Vision meets robotics: The KITTI dataset", IJRR 2013).

Layout and formulas: https://www.cvlibs.net/datasets/kitti/raw_data.php and the raw-data development kit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind, is_rigid
from slamhive.recordings.frame_files import read_velodyne
from slamhive.recordings.geometry import Array, quaternions_from_rotations, rotation_xyz, transform
from slamhive.recordings.ground_truth import matched_truth
from slamhive.recordings.importers.kitti_odometry import velodyne_layout
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    Loss,
    PlannedStream,
    PlannedTruth,
    rate_hz,
)
from slamhive.recordings.rgbd import Frames, camera_stream, numbered, read_pose_table, size_of
from slamhive.recordings.ros1_writer import NS_PER_S
from slamhive.recordings.streams import gnss_stream, imu_stream, point_stream
from slamhive.recordings.text_lists import read_lines

_CAMERAS, _VELODYNE, _OXTS = ("image_00", "image_01", "image_02", "image_03"), "velodyne_points", "oxts"
_CALIBRATION = ("calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt")
_EARTH_RADIUS_M = 6378137.0
"""That of the development kit's Mercator projection (``latlonToMercator.m``)."""
_OXTS_COLUMNS = 30
_LAT, _LON, _ALT, _ROLL, _PITCH, _YAW = range(6)
_FORCE, _RATE = slice(11, 14), slice(17, 20)
"""``ax ay az`` and ``wx wy wz``: x forward, y left, z up."""


class KittiRawImporter:
    """Rectified images, Velodyne scans, IMU samples and poses from GNSS and IMU to a dataset; the body is the IMU.

    The IMU of the synchronised recordings has one sample a frame, 10 Hz. Scans carry no time per point.
    """

    title = "KITTI raw drive, synchronised: image_00 to image_03, velodyne_points, oxts, calib_*.txt"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The folders of the drive; calibration lies in it or beside it."""
        found = [name for name in (*_CAMERAS, _VELODYNE, _OXTS) if (path / name / "data").is_dir()]
        found += [name for name in _CALIBRATION if _calibration_file(path, name).is_file()]
        needed = (_OXTS, *_CALIBRATION)
        return Detection(tuple(found), tuple(name for name in needed if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """Plan the import of the drive; raises InvalidInput naming the file, the line or key, and the remedy."""
        notes: list[str] = ["timestamps are taken as UTC: the recordings do not say their time zone"]
        # From the IMU to the rectified camera 0: R_rect_00 · velo_to_cam · imu_to_velo.
        rectifying = transform(_calibration(source, _CALIBRATION[0])("R_rect_00", 9).reshape(3, 3), np.zeros(3))
        if not is_rigid(_flat(rectifying)):
            raise InvalidInput(f"{_calibration_file(source, _CALIBRATION[0])}: R_rect_00 is no rotation")
        rectified_imu = np.asarray(rectifying @ _rigid(source, _CALIBRATION[1]) @ _rigid(source, _CALIBRATION[2]))
        streams: list[PlannedStream] = []
        for number, name in enumerate(_CAMERAS):
            if (source / name / "data").is_dir():
                streams.append(_camera(source, number, rectified_imu, notes))
        if (source / _VELODYNE / "data").is_dir():
            streams.append(_lidar(source, notes))
        times_ns, files = clocked_files(source / _OXTS, "*.txt", notes)
        rows = np.array([read_packet(path) for path in files])
        streams.append(packet_imu(times_ns, rows))
        streams.append(packet_gnss(times_ns, rows))
        truth = _truth(times_ns, rows)
        notes.extend(matched_truth(truth, streams))
        return ImportPlan(tuple(streams), truth, _text(source), notes=tuple(notes))


def _calibration_file(source: Path, name: str) -> Path:
    own = source / name
    return own if own.is_file() else source.resolve().parent / name


def _calibration(source: Path, name: str) -> Callable[[str, int], Array]:
    """A reader of a calibration file of the drive."""
    return keyed_numbers(_calibration_file(source, name))


def keyed_numbers(path: Path) -> Callable[[str, int], Array]:
    """A reader of ``KEY: numbers`` lines: the finite numbers (n,) of a key; it raises InvalidInput."""
    entries = dict(line.split(":", 1) for line in read_lines(path) if ":" in line)

    def numbers(key: str, count: int) -> Array:
        if key not in entries:
            raise InvalidInput(f"{path} lacks {key}", "take the file from the calibration of the same day")
        try:
            values = np.array(entries[key].split(), dtype=np.float64)
        except ValueError:
            raise InvalidInput(f"{path}: {key} is {entries[key].strip()[:60]!r}, no numbers") from None
        if values.shape != (count,) or not np.isfinite(values).all():
            raise InvalidInput(f"{path}: {key} has {values.size} numbers", f"expected {count} finite numbers")
        return values

    return numbers


def _rigid(source: Path, name: str) -> Array:
    numbers = _calibration(source, name)
    T = transform(numbers("R", 9).reshape(3, 3), numbers("T", 3))
    if not is_rigid(_flat(T)):
        raise InvalidInput(f"{_calibration_file(source, name)}: R is no rotation", "copy the file again")
    return T


def _camera(source: Path, number: int, T_rectified_imu: Array, notes: list[str]) -> PlannedStream:
    """A rectified camera: P = K [I | t] sees x + t where camera 0 sees x, so it sits at -t."""
    P = _calibration(source, _CALIBRATION[0])(f"P_rect_{number:02d}", 12).reshape(3, 4)
    if not (0 < P[0, 0] < 1e6 and 0 < P[1, 1] < 1e6) or abs(np.linalg.det(P[:, :3])) < 1e-9:
        raise InvalidInput(f"P_rect_{number:02d} has focal lengths {P[0, 0]:g}, {P[1, 1]:g}", "copy the file again")
    times_ns, paths = clocked_files(source / f"image_{number:02d}", "*.png", notes)
    width, height = size_of(paths[0])
    fx, fy, cx, cy = (float(P[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4, rectified=True)
    position_m = 0.0 - np.linalg.solve(P[:, :3], P[:, 3])
    T_body_camera = np.linalg.inv(T_rectified_imu) @ transform(np.eye(3), position_m)
    frames = Frames(times_ns, paths)
    baseline_m = float(position_m[0])
    return camera_stream(f"cam{number}", frames, intrinsics, _flat(T_body_camera), baseline_m=baseline_m)


def _lidar(source: Path, notes: list[str]) -> PlannedStream:
    times_ns, paths = clocked_files(source / _VELODYNE, "*.bin", notes)
    T_body_lidar = _flat(np.linalg.inv(_rigid(source, _CALIBRATION[2])))
    rate = rate_hz(times_ns)
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/points", rate, T_body_lidar, velodyne_layout().calibration())
    return point_stream(sensor, times_ns, paths, read_velodyne, 1.0)


def read_clock(path: Path) -> dict[int, int]:
    """{Number of a frame: its timestamp in ns since 1970}; line n + 1 of ``timestamps.txt`` is that of frame n.

    A blank line stands for a frame that was not recorded; the lines after it belong to the frames after it.
    """
    return {
        number: _clock_ns(line, f"{path}, line {number + 1}")
        for number, line in enumerate(read_lines(path))
        if line.strip()
    }


def clocked_files(folder: Path, pattern: str, notes: list[str], data: str = "data") -> tuple[Array, list[Path]]:
    """The files of a sensor in the folder ``data`` below ``folder``, with the timestamps (n,) in ns beside it.

    Files without a timestamp, and timestamps without a file, become losses in ``notes``.
    """
    path = folder / "timestamps.txt"
    times_ns = read_clock(path)
    there = numbered(folder / data, pattern)
    files = {number: file for number, file in there.items() if number in times_ns}
    if not files:
        raise InvalidInput(f"{folder / data} has no {pattern} with a line in {path.name}", "complete the folder")
    if len(files) < len(times_ns):
        missing = len(times_ns) - len(files)
        note = f"{missing} of the {len(times_ns)} files of {folder.name} are missing and left out"
        notes.append(Loss(missing, len(times_ns), note))
    if len(files) < len(there):
        untimed = len(there) - len(files)
        note = f"{untimed} files of {folder.name} have no time in {path.name} and are left out"
        notes.append(Loss(untimed, len(there), note))
    chosen = np.array([times_ns[number] for number in files], dtype=np.int64)
    late = np.flatnonzero(np.diff(chosen) <= 0)
    if len(late):
        line = list(files)[int(late[0]) + 1] + 1
        raise InvalidInput(f"{path}, line {line}: the timestamp is not after the one before", "times must increase")
    return chosen, list(files.values())


def _clock_ns(line: str, place: str) -> int:
    """``2011-09-26 13:02:25.951199337`` in ns since 1970."""
    clock, _, fraction = line.strip().partition(".")
    try:
        moment = datetime.strptime(clock, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC)
        time_ns = int(moment.timestamp()) * NS_PER_S + int(fraction[:9].ljust(9, "0"))
    except ValueError:
        time_ns = -1
    if not 0 <= time_ns < 2**31 * NS_PER_S:
        raise InvalidInput(f"{place}: {line[:40]!r} is no time", "expected 2011-09-26 13:02:25.951199337") from None
    return time_ns


def read_packet(path: Path) -> Array:
    """The 30 numbers of a packet of the GNSS and IMU unit; raises InvalidInput."""
    values: Array = read_pose_table(path, _OXTS_COLUMNS, "30 numbers of a GNSS and IMU packet")[0]
    if not np.isfinite(values).all() or abs(values[_LAT]) >= 89 or np.abs(values[:20]).max() > 1e6:
        raise InvalidInput(f"{path}: its numbers make no sense", "copy the file again")
    return values


def packet_imu(times_ns: Array, rows: Array, T_body_imu: Matrix4 = IDENTITY4) -> PlannedStream:
    """Angular rates and accelerations of the packets."""
    sensor = Sensor("imu0", SensorKind.IMU, "/imu0", rate_hz(times_ns), T_body_imu)
    return imu_stream(sensor, times_ns, np.column_stack((rows[:, _RATE], rows[:, _FORCE])))


def packet_gnss(times_ns: Array, rows: Array) -> PlannedStream:
    """Latitude, longitude and altitude of the IMU, to which the receiver's positions are reduced."""
    sensor = Sensor("gnss0", SensorKind.GNSS, "/gnss0", rate_hz(times_ns))
    return gnss_stream(sensor, times_ns, rows[:, _LAT : _ALT + 1])


def _truth(times_ns: Array, rows: Array) -> PlannedTruth:
    """Positions by Mercator projection scaled at the first latitude, relative to the first; z points up."""
    scale = math.cos(math.radians(rows[0, _LAT]))
    x_m = scale * _EARTH_RADIUS_M * np.radians(rows[:, _LON])
    y_m = scale * _EARTH_RADIUS_M * np.log(np.tan(np.radians(90 + rows[:, _LAT]) / 2))
    positions_m = np.column_stack((x_m, y_m, rows[:, _ALT]))
    quats_xyzw = quaternions_from_rotations(rotation_xyz(rows[:, _ROLL], rows[:, _PITCH], rows[:, _YAW]))
    return PlannedTruth(
        times_ns / NS_PER_S, positions_m - positions_m[0], quats_xyzw, gravity_aligned=True, source="GNSS and IMU (RTK)"
    )


def _flat(T: Array) -> Matrix4:
    return tuple(float(value) for value in T.reshape(-1))


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"KITTI raw, {source.resolve().name}",
        description="A synchronised drive of the KITTI raw data; the body is the IMU.",
        licence="CC BY-NC-SA 3.0",
        citation="Geiger, Lenz, Stiller, Urtasun: Vision meets robotics: The KITTI dataset. IJRR 2013",
        source="https://www.cvlibs.net/datasets/kitti/raw_data.php",
        attributes=("real", "outdoor", "car"),
    )
