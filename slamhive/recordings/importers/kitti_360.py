"""Importer of KITTI-360 (Liao, Xie, Geiger, "KITTI-360: A novel dataset and benchmarks", TPAMI 2023).

Layout and transforms: https://www.cvlibs.net/datasets/kitti-360/documentation.php and ``kitti360scripts``. The body is
the frame of ``poses.txt``, that of the GNSS and IMU unit with x to the front, y to the right and z down.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import LidarLayout, Rotation
from slamhive.domain.sensors import Sensor, SensorKind, is_rigid
from slamhive.recordings.frame_files import read_velodyne
from slamhive.recordings.geometry import Array, flat, quaternions_from_rotations, transform
from slamhive.recordings.importers.kitti import (
    clocked_files,
    keyed_numbers,
    packet_gnss,
    packet_imu,
    read_clock,
    read_packet,
)
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
from slamhive.recordings.rgbd import Frames, camera_stream, read_pose_table, rectified_intrinsics
from slamhive.recordings.streams import point_stream
from slamhive.recordings.writers import NS_PER_S
from slamhive.runtime.point_times import PointTimes, SweepInstant

_CALIBRATION, _IMAGES, _SCANS, _POSES = "calibration", "data_2d_raw", "data_3d_raw", "data_poses"
_RECTIFIED = (0, 1)
"""The perspective cameras; images of the fisheye cameras 2 and 3 follow a model of mirrors that algorithms lack."""
_UNIT_TO_BODY = np.diag([1.0, -1.0, -1.0])
"""Packets have y to the left and z up; ``postprocessPoses`` of the development kit turns poses by the same matrix."""
_FRAME_AND_POSE = 13


class Kitti360Importer:
    """Rectified images, Velodyne scans, GNSS and IMU packets and poses to a dataset.

    Scans carry no time per point. Poses exist where the car moved.
    """

    title = "KITTI-360: calibration, data_poses, and data_2d_raw or data_3d_raw"
    options = frozenset({"sequence"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The folders of the download."""
        found = [name for name in (_CALIBRATION, _POSES, _IMAGES, _SCANS) if (path / name).is_dir()]
        needed = [_CALIBRATION, _POSES] + ([] if {_IMAGES, _SCANS} & set(found) else [f"{_IMAGES} or {_SCANS}"])
        return Detection(tuple(found), tuple(name for name in needed if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of a sequence; raises InvalidInput naming the file, the line or key, and the remedy."""
        sequence = _sequence(source, options.sequence)
        notes = [
            "timestamps are taken as UTC: the recordings do not say their time zone",
            "the fisheye cameras and the SICK scanner are left out",
        ]
        images, scans, poses = (source / part / sequence for part in (_IMAGES, _SCANS, _POSES))
        calibration = source / _CALIBRATION
        streams = [
            _camera(images / f"image_{number:02d}", calibration, number, notes)
            for number in _RECTIFIED
            if (images / f"image_{number:02d}").is_dir()
        ]
        if (scans / "velodyne_points").is_dir():
            streams.append(_lidar(scans / "velodyne_points", calibration, notes))
        if (poses / "oxts").is_dir():
            times_ns, files = clocked_files(poses / "oxts", "*.txt", notes)
            rows = np.array([read_packet(path) for path in files])
            T_body_unit = flat(transform(_UNIT_TO_BODY, np.zeros(3)))
            streams += [packet_imu(times_ns, rows, T_body_unit), packet_gnss(times_ns, rows)]
        if not streams:
            raise InvalidInput(f"{source} has no recording of {sequence}", f"unpack its {_IMAGES} or {_SCANS}")
        # Cameras expose when the scanner faces forward, so all sensors share the timestamps of frames.
        clocks = [images / f"image_{number:02d}" / "timestamps.txt" for number in _RECTIFIED]
        clocks.append(scans / "velodyne_points" / "timestamps.txt")
        found = next((path for path in clocks if path.is_file()), None)
        if found is None:
            raise InvalidInput(f"{clocks[0]} is missing, and so are those of the other sensors", "complete the folder")
        truth = _truth(poses / "poses.txt", read_clock(found))
        notes.extend(matched_truth(truth, streams))
        return ImportPlan(tuple(streams), truth, _text(sequence), notes=tuple(notes))


def _sequence(source: Path, wanted: str | None) -> str:
    """The sequence to import; raises InvalidInput if it is not there, or not said where there are several."""
    names = [path.parent.name for path in visible_files(source / _POSES, "*/poses.txt")]
    if wanted is None and len(names) == 1:
        return names[0]
    if wanted in names:
        return str(wanted)
    problem = f"{source / _POSES} has {len(names)} sequences with poses.txt"
    if wanted is not None:
        problem += f", none called {wanted!r}"
    raise InvalidInput(problem, f"name one with --sequence: {', '.join(names)}" if names else "unpack the poses")


def _camera(folder: Path, calibration: Path, number: int, notes: list[str]) -> PlannedStream:
    path = calibration / "perspective.txt"
    numbers = keyed_numbers(path)
    P = numbers(f"P_rect_{number:02d}", 12).reshape(3, 4)
    R = numbers(f"R_rect_{number:02d}", 9).reshape(3, 3)
    if not (0 < P[0, 0] < 1e6 and 0 < P[1, 1] < 1e6) or not is_rigid(flat(transform(R, np.zeros(3)))):
        raise InvalidInput(f"{path}: P_rect_{number:02d} or R_rect_{number:02d} makes no sense", "copy the file again")
    times_ns, paths = clocked_files(folder, "*.png", notes, "data_rect")
    intrinsics = rectified_intrinsics(P, paths[0])
    # R_rect turns the camera's own frame into the rectified one.
    T_body_camera = _T_body_camera(calibration, number) @ np.linalg.inv(transform(R, np.zeros(3)))
    baseline_m = float(-P[0, 3] / P[0, 0])
    return camera_stream(
        f"cam{number}", Frames(times_ns, paths), intrinsics, flat(T_body_camera), baseline_m=baseline_m
    )


def _lidar(folder: Path, calibration: Path, notes: list[str]) -> PlannedStream:
    """The HDL-64E: the timestamp of a scan is the instant at which it faced forward."""
    path = calibration / "calib_cam_to_velo.txt"
    T_lidar_cam0 = _transform_of(read_pose_table(path, 12, "12 numbers of a transform")[0], path, "its row")
    times_ns, files = clocked_files(folder, "*.bin", notes)
    layout = LidarLayout(
        PointTimes(scan_duration_s=0.1, stamp=SweepInstant.MIDDLE),
        beams=64,
        minimum_range_m=0.9,
        maximum_range_m=120.0,
        rotation=Rotation.COUNTER_CLOCKWISE,
    )
    T_body_lidar = _T_body_camera(calibration, 0) @ np.linalg.inv(T_lidar_cam0)
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/points", rate_hz(times_ns), flat(T_body_lidar), layout.calibration())
    return point_stream(sensor, times_ns, files, read_velodyne, 1.0)


def _T_body_camera(calibration: Path, number: int) -> Array:
    path = calibration / "calib_cam_to_pose.txt"
    return _transform_of(keyed_numbers(path)(f"image_{number:02d}", 12), path, f"image_{number:02d}")


def _transform_of(numbers: Array, path: Path, place: str) -> Array:
    """The transform (4, 4) of the 12 numbers of its first three rows; raises InvalidInput if it is not rigid."""
    upper = numbers.reshape(3, 4)
    T = transform(upper[:, :3], upper[:, 3])
    if not is_rigid(flat(T)):
        raise InvalidInput(f"{path}: {place} is no rigid transform", "copy the file again")
    return T


def _truth(path: Path, clock_ns: dict[int, int]) -> PlannedTruth:
    """Poses of the body in metres of a Mercator projection, z up; each row begins with the number of its frame."""
    rows = read_pose_table(path, _FRAME_AND_POSE, "the number of a frame and 12 numbers of a transform")
    frames = rows[:, 0].astype(np.int64)
    unknown = next((int(frame) for frame in frames if int(frame) not in clock_ns), None)
    if unknown is not None or (np.diff(frames) <= 0).any():
        problem = "frames do not increase" if unknown is None else f"frame {unknown} has no timestamp"
        raise InvalidInput(f"{path}: {problem}", "complete timestamps.txt, or copy the file again")
    poses = np.array([_transform_of(row[1:], path, f"the pose of frame {int(row[0])}") for row in rows])
    times_s = np.array([clock_ns[int(frame)] for frame in frames]) / NS_PER_S
    quats_xyzw = quaternions_from_rotations(poses[:, :3, :3])
    return PlannedTruth(
        times_s, poses[:, :3, 3], quats_xyzw, gravity_aligned=True, source="GNSS, IMU and laser scans, optimised"
    )


def _text(sequence: str) -> DatasetText:
    return DatasetText(
        title=f"KITTI-360, {sequence}",
        description="A drive of KITTI-360; the body is the GNSS and IMU unit.",
        licence="CC BY-NC-SA 3.0",
        citation="Liao, Xie, Geiger: KITTI-360: A novel dataset and benchmarks for urban scene understanding in 2D "
        "and 3D. TPAMI 2023",
        source="https://www.cvlibs.net/datasets/kitti-360/",
        attributes=("real", "outdoor", "car"),
    )
