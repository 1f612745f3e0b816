"""Importer of NCLT sessions (Carlevaris-Bianco, Ushani, Eustice, IJRR 2016).

Columns and units are those of the dataset's own readers (``read_vel_sync.py``, ``read_ms25.py``, ``read_gps.py``),
extrinsics those of its paper as ``ethz-asl/nclt_tools`` lists them. The body of NCLT has x to the front, y to the right
and z down. Here body, world and LiDAR are turned: z points up. The scans of ``velodyne_sync`` are in NCLT's body frame,
as ``project_vel_to_cam.py`` uses them. They are moved back to the LiDAR, because packages expect its centre as the
origin.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import LidarLayout
from slamhive.domain.sensors import Matrix4, Sensor, SensorKind
from slamhive.recordings.geometry import Array, flat, quaternions_from_rotations, rotation_xyz, transform
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    rate_hz,
)
from slamhive.recordings.streams import gnss_stream, imu_stream, point_stream, read_records, timed_files
from slamhive.recordings.text_lists import TimedList, read_timed_list
from slamhive.runtime.point_times import PointTimes, SweepInstant
from slamhive.trajectory.layout import TimeUnit

_SCANS, _IMU, _GNSS = "velodyne_sync", "ms25.csv", "gps.csv"
_NS_PER_US = 1000
_FILE_POINT = np.dtype([("x", "<u2"), ("y", "<u2"), ("z", "<u2"), ("intensity", "u1"), ("laser", "u1")])
_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("laser", "<u2")])
_SCALE_M, _OFFSET_M = 0.005, -100.0
_UP = np.diag([1.0, -1.0, -1.0])
_LIDAR_POSITION_M, _LIDAR_ANGLES_DEG = (0.002, -0.004, -0.957), (0.807, 0.166, -90.703)
_T_nclt_lidar = transform(rotation_xyz(*np.deg2rad(_LIDAR_ANGLES_DEG)), list(_LIDAR_POSITION_M))
_FIRST_FIX = 2
"""The least ``mode`` of a row of ``gps.csv`` with a position."""


class NcltImporter:
    """Velodyne scans, IMU samples, GNSS positions and ground truth to a dataset.

    The scans of ``velodyne_sync`` have no time for each point. ``velodyne_hits.bin`` holds packets, no scans, and is
    not read.
    """

    title = "NCLT session: velodyne_sync/*.bin, ms25.csv, gps.csv, groundtruth_*.csv"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The parts of a session."""
        found = [name for name in (_IMU, _GNSS) if (path / name).is_file()]
        has_scans = bool(visible_files(path / _SCANS, "*.bin"))
        found += [f"{_SCANS}/*.bin"] if has_scans else []
        missing = () if has_scans else (f"{_SCANS}/*.bin",)
        return Detection(tuple(found), missing)

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """Plan the import of the session; raises InvalidInput naming the file, the line and the remedy."""
        streams = [_lidar(source / _SCANS)]
        streams += [_imu(source / _IMU)] if (source / _IMU).is_file() else []
        streams += [_gnss(source / _GNSS)] if (source / _GNSS).is_file() else []
        beside = visible_files(source.parent, f"groundtruth_{source.name}.csv")
        truths = sorted({*visible_files(source, "groundtruth_*.csv"), *beside})
        if len(truths) > 1:
            raise InvalidInput(f"{source} has {len(truths)} files groundtruth_*.csv", "leave the one of the session")
        truth = _truth(truths[0]) if truths else None
        notes = matched_truth(truth, streams)
        covariances = [path for path in visible_files(source, "cov_*.csv") if path.is_file()]
        if truth is not None and len(covariances) == 1:
            sigmas_m = _sigmas_m(covariances[0], truth.times_s)
            truth, middle_m = replace(truth, sigmas_m=sigmas_m), float(np.median(sigmas_m))
            notes += (f"{covariances[0].name} is the uncertainty of the ground truth: {middle_m:.3g} m (median)",)
        elif len(covariances) > 1:
            raise InvalidInput(f"{source} has {len(covariances)} files cov_*.csv", "leave the one of the session")
        return ImportPlan(tuple(streams), truth, _text(source), notes=notes)


def _lidar(folder: Path) -> PlannedStream:
    """The HDL-32E; with the timestamp of a scan as its middle, poses of scans without times belong to the timestamp."""
    times_ns, paths = timed_files(folder, ".bin", _NS_PER_US)
    layout = LidarLayout(PointTimes(scan_duration_s=0.1, stamp=SweepInstant.MIDDLE), beams=32, maximum_range_m=100.0)
    T_body_lidar = transform(_UP, [0.0, 0.0, 0.0]) @ _T_nclt_lidar @ transform(_UP, [0.0, 0.0, 0.0])
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/points", rate_hz(times_ns), flat(T_body_lidar), layout.calibration())
    return point_stream(sensor, times_ns, paths, _read_scan, _POINT.itemsize / _FILE_POINT.itemsize)


def _read_scan(path: Path) -> Array:
    """The points in the LiDAR's frame, x forward and z up. Arrays hold one axis after the other, which is fastest."""
    hits = read_records(path, _FILE_POINT)
    body_m = np.stack([hits[axis] for axis in "xyz"]) * _SCALE_M
    body_m += _OFFSET_M
    body_m -= _T_nclt_lidar[:3, 3:]
    points: Array = np.empty(len(hits), dtype=_POINT)
    points["x"], points["y"], points["z"] = (_T_nclt_lidar[:3, :3] @ _UP).T @ body_m
    points["intensity"], points["laser"] = hits["intensity"], hits["laser"]
    return points


def _imu(path: Path) -> PlannedStream:
    """The Microstrain 3DM-GX3-45: timestamp, magnetic field, acceleration in m/s², angular rate in rad/s."""
    rows = read_timed_list(path, "utime, mag x y z, accel x y z, rot r p h", TimeUnit.US, columns=10)
    sensor = Sensor(
        "imu0", SensorKind.IMU, "/imu", rate_hz(rows.times_ns), _T_body((-0.11, -0.18, -0.71), (0.0, 0.0, 0.0))
    )
    return imu_stream(sensor, rows.times_ns, np.hstack([rows.numbers(6, 3), rows.numbers(3, 3)]))


def _gnss(path: Path) -> PlannedStream:
    """Rows with a position: utime, mode, satellites, latitude and longitude in rad, altitude in m, track, speed."""
    rows = read_timed_list(path, "utime, mode, satellites, latitude, longitude, altitude", TimeUnit.US, columns=6)
    fixed = _finite_rows(rows, 2, 3)
    fixed = fixed.take([index for index, mode in enumerate(fixed.numbers(0, 1)[:, 0]) if mode >= _FIRST_FIX])
    if len(fixed) < 2:
        raise InvalidInput(f"{path} has no positions", "remove the file if the receiver had no fix")
    radians = fixed.numbers(2, 3)
    sensor = Sensor(
        "gnss0", SensorKind.GNSS, "/fix", rate_hz(fixed.times_ns), _T_body((0.0, -0.25, -0.51), (0.0, 0.0, 0.0))
    )
    return gnss_stream(sensor, fixed.times_ns, np.column_stack([np.rad2deg(radians[:, :2]), radians[:, 2]]))


def _truth(path: Path) -> PlannedTruth:
    """Poses: utime, x, y, z in m, roll, pitch, heading in rad; the first rows may be NaN."""
    rows = _finite_rows(read_timed_list(path, "utime, x, y, z, roll, pitch, heading", TimeUnit.US), 0, 6)
    values = rows.numbers(0, 6)
    R_world_body = _UP @ rotation_xyz(*values[:, 3:].T) @ _UP
    return PlannedTruth(
        rows.times_ns * 1e-9,
        values[:, :3] @ _UP,
        quaternions_from_rotations(R_world_body),
        gravity_aligned=True,
        source="RTK GNSS, odometry and LiDAR in one pose graph",
    )


def _sigmas_m(path: Path, times_s: Array) -> Array:
    """Standard deviations of x, y, z in m at ``times_s`` (n,), interpolated; shape (n, 3).

    Rows: utime, and the upper triangle of the covariance of x, y, z, roll, pitch, heading by rows, as nclt2ros reads.
    """
    rows = _finite_rows(read_timed_list(path, "utime and 21 covariances", TimeUnit.US, columns=22), 0, 21)
    variances_m2 = rows.numbers(0, 21)[:, [0, 6, 11]]
    if (variances_m2 < 0).any():
        row = int((variances_m2 < 0).any(axis=1).argmax())
        raise rows.error(row, "a variance is negative", "copy or download the file again")
    sigmas_m = np.sqrt(variances_m2)
    return np.column_stack([np.interp(times_s, rows.times_ns * 1e-9, sigmas_m[:, axis]) for axis in range(3)])


def _finite_rows(rows: TimedList, start: int, count: int) -> TimedList:
    unknown = {"nan", "-nan", "inf", "-inf"}
    kept = [
        index
        for index, row in enumerate(rows.rows)
        if not unknown & {word.lower() for word in row[start : start + count]}
    ]
    if not kept:
        raise InvalidInput(f"{rows.path} has no finite row", "copy or download the file again")
    return rows.take(kept)


def _T_body(position_m: tuple[float, float, float], angles_deg: tuple[float, float, float]) -> Matrix4:
    T_nclt = transform(rotation_xyz(*np.deg2rad(angles_deg)), list(position_m))
    return flat(transform(_UP, [0.0, 0.0, 0.0]) @ T_nclt)


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"NCLT, {source.resolve().name}",
        description="A session of the North Campus Long-Term dataset; the body is the Segway's base, z up.",
        licence="ODbL 1.0",
        citation="Carlevaris-Bianco, Ushani, Eustice: University of Michigan North Campus long-term vision and lidar "
        "dataset. IJRR 35(9), 2016",
        source="https://robots.engin.umich.edu/nclt",
        attributes=("real", "outdoor", "indoor"),
    )
