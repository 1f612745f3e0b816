"""Importer of MulRan sequences (Kim, Park, Cho, Jeong, Kim: "MulRan: Multimodal range dataset", ICRA 2020).

Columns are those of the dataset's ``file_player_mulran``, the LiDAR's pose that of its ``calib_base2ouster.txt``. The
files of the Ouster OS1-64 hold 1024 columns of 64 points in the order of time, as the loader of KISS-ICP reads them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import LidarLayout, PointOrder
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array, quaternions_from_rotations, rotation_xyz, transform
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    Loss,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    rate_hz,
)
from slamhive.recordings.streams import gnss_stream, imu_stream, point_stream, read_records, timed_files
from slamhive.recordings.text_lists import read_timed_list
from slamhive.runtime.point_times import PointTimes
from slamhive.trajectory.layout import TimeUnit

_SCANS, _IMU, _GNSS, _POSES = "Ouster", "xsens_imu.csv", "gps.csv", "global_pose.csv"
_FILE_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
_POINT = np.dtype([*_FILE_POINT.descr, ("ring", "<u2"), ("time", "<f4")])
_RINGS, _COLUMNS, _SWEEP_S = 64, 1024, 0.1
_SCAN_BYTES = _RINGS * _COLUMNS * _FILE_POINT.itemsize
_AS_IN_FILE = np.dtype({"names": ["point"], "formats": ["V16"], "offsets": [0], "itemsize": _POINT.itemsize})
_EMPTY_SCAN = np.zeros(_RINGS * _COLUMNS, dtype=_POINT)
"""A scan with ring and time of each point. The first 16 bytes of a point are those of a file, and copied as one."""
_EMPTY_SCAN["ring"] = np.arange(len(_EMPTY_SCAN)) % _RINGS
_EMPTY_SCAN["time"] = np.arange(len(_EMPTY_SCAN)) // _RINGS * (_SWEEP_S / _COLUMNS)
_IMU_COLUMNS = 17
"""Earlier files have eight columns: orientations only."""


class MulranImporter:
    """Ouster scans, IMU samples, GNSS positions and poses of the car to a dataset.

    The body is the car's base. Fields ``ring`` and ``time`` follow from the order of points, so scans with another
    number of points are left out. That the timestamp of a scan is its start is not documented by the dataset.
    """

    title = "MulRan sequence: Ouster/*.bin, xsens_imu.csv, gps.csv, global_pose.csv, also below sensor_data"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The parts of a sequence."""
        has_scans = bool(visible_files(_sensors(path) / _SCANS, "*.bin"))
        found = [f"{_SCANS}/*.bin"] if has_scans else []
        found += [name for name in (_IMU, _POSES) if _find(path, name) is not None]
        return Detection(tuple(found), () if has_scans else (f"{_SCANS}/*.bin",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """Plan the import of the sequence; raises InvalidInput naming the file, the line and the remedy."""
        lidar, notes = _lidar(_sensors(source) / _SCANS)
        imu, poses, gnss = (_find(source, name) for name in (_IMU, _POSES, _GNSS))
        streams = [lidar]
        if imu is not None:
            streams += _imu(imu)
            notes.append("MulRan states no pose of the IMU: it is taken as that of the car's base")
        streams += [] if gnss is None else [_gnss(gnss)]
        truth = None if poses is None else _truth(poses)
        notes += [*matched_truth(truth, streams), "radar images are not imported"]
        return ImportPlan(tuple(streams), truth, _text(source), notes=tuple(notes))


def _sensors(source: Path) -> Path:
    return source / "sensor_data" if (source / "sensor_data").is_dir() else source


def _find(source: Path, name: str) -> Path | None:
    paths = [path for path in (source / name, _sensors(source) / name) if path.is_file()]
    return paths[0] if paths else None


def _lidar(folder: Path) -> tuple[PlannedStream, list[str]]:
    times_ns, paths = timed_files(folder, ".bin", 1)
    whole = [index for index, path in enumerate(paths) if path.stat().st_size == _SCAN_BYTES]
    if len(whole) < 2:
        raise InvalidInput(
            f"{len(whole)} of {len(paths)} files in {folder} have {_RINGS} x {_COLUMNS} points ({_SCAN_BYTES} bytes)",
            "two are needed at least: copy or download the files again",
        )
    times_ns, kept = times_ns[whole], [paths[index] for index in whole]
    layout = LidarLayout(PointTimes(_SWEEP_S, "time"), ring_field="ring", point_order=PointOrder.COLUMNS, beams=_RINGS)
    T_body_lidar = transform(rotation_xyz(*np.deg2rad([0.0001, 0.0003, 179.6654])), [1.7042, -0.021, 1.8047])
    flat = tuple(float(value) for value in T_body_lidar.reshape(-1))
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/points", rate_hz(times_ns), flat, layout.calibration())
    left_out = len(paths) - len(kept)
    reason = f"{left_out} scans do not have {_RINGS} x {_COLUMNS} points and are left out"
    notes: list[str] = [Loss(left_out, len(paths), reason)] if left_out else []
    return point_stream(sensor, times_ns, kept, _read_scan, _POINT.itemsize / _FILE_POINT.itemsize), notes


def _read_scan(path: Path) -> Array:
    """The scan with ring and time; points without return are 0 0 0."""
    raw = read_records(path, _FILE_POINT)
    if raw.nbytes != _SCAN_BYTES:
        raise InvalidInput(f"{path} has {raw.nbytes} bytes, not {_SCAN_BYTES}", "copy or download the file again")
    points: Array = _EMPTY_SCAN.copy()
    points.view(_AS_IN_FILE)["point"] = raw.view("V16")
    return points


def _imu(path: Path) -> list[PlannedStream]:
    """The Xsens MTi-300: timestamp, quaternion, Euler angles, angular rate in rad/s, acceleration in m/s², field."""
    rows = read_timed_list(path, "timestamp, q x y z w, euler x y z, gyro x y z, acc x y z", TimeUnit.NS, columns=8)
    if len(rows.rows[0]) < _IMU_COLUMNS - 1:
        return []
    short = next((index for index, row in enumerate(rows.rows) if len(row) < _IMU_COLUMNS - 1), None)
    if short is not None:
        raise rows.error(short, f"{len(rows.rows[short]) + 1} columns, not {_IMU_COLUMNS}", "correct the line")
    sensor = Sensor("imu0", SensorKind.IMU, "/imu", rate_hz(rows.times_ns))
    return [imu_stream(sensor, rows.times_ns, rows.numbers(7, 6))]


def _gnss(path: Path) -> PlannedStream:
    rows = read_timed_list(path, "timestamp, latitude, longitude, altitude, 9 covariances", TimeUnit.NS, columns=13)
    sensor = Sensor("gnss0", SensorKind.GNSS, "/fix", rate_hz(rows.times_ns))
    return gnss_stream(sensor, rows.times_ns, rows.numbers(0, 3), rows.numbers(3, 9)[:, [0, 4, 8]])


def _truth(path: Path) -> PlannedTruth:
    """Poses of the base: timestamp and a 3x4 matrix by rows, in UTM coordinates."""
    rows = read_timed_list(path, "timestamp and the 12 numbers of a pose", TimeUnit.NS, columns=13)
    poses = rows.numbers(0, 12).reshape(-1, 3, 4)
    R = poses[:, :, :3]
    bent = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2)) > 1e-3
    bent |= np.linalg.det(R) < 0
    if bent.any():
        raise rows.error(int(bent.argmax()), "the matrix is no rotation", "copy or download the file again")
    return PlannedTruth(
        rows.times_ns * 1e-9,
        poses[:, :, 3],
        quaternions_from_rotations(R),
        gravity_aligned=True,
        source="RTK GNSS, fibre optic gyro and LiDAR in one pose graph",
    )


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"MulRan, {source.resolve().name}",
        description="A sequence of the MulRan dataset without its radar; the body is the car's base.",
        licence="CC BY-NC-SA 4.0",
        citation="Kim, Park, Cho, Jeong, Kim: MulRan: Multimodal range dataset for urban place recognition. ICRA 2020",
        source="https://sites.google.com/view/mulran-pr",
        attributes=("real", "outdoor", "car"),
    )
