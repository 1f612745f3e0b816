"""Exports to a sequence of KITTI odometry (Geiger, Lenz, Urtasun 2012): ``image_0``, ``velodyne``, ``calib.txt``, ....

A frame has one image of each camera, one scan and one pose. Cameras are rectified: they look in one direction.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind
from slamhive.recordings.exporters.base import (
    ELSEWHERE,
    ExportedTruth,
    ExportPlan,
    ImageSink,
    Work,
    export_frames,
    image_bytes,
    left_out,
    message_counts,
    read_truth,
    truth_left_out,
)
from slamhive.recordings.frame_files import POINT_TYPE
from slamhive.recordings.geometry import Array
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.recordings.staging import Progress
from slamhive.recordings.variants.payloads import CODECS, POINTS
from slamhive.trajectory.transforms import rotations_from_quats

_GREY, _COLOUR = (0, 1), (2, 3)
"""The numbers of the cameras: two grey ones, two of colour."""
_PARALLEL_TOLERANCE = 1e-6
_SAME_TIME_NS = 1_000
"""Poses belong to a frame if their times agree within a microsecond: nothing is interpolated."""
_SAME_FRAME = 0.75
"""Of the time between two frames: sweeps may be stamped at their start, half a frame before the images."""
_SCAN_BYTES = 2_500_000
_AXES = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class _Chosen:
    """The cameras by number, the LiDAR, and the poses of the frames, as far as the format holds them."""

    cameras: dict[int, Sensor]
    lidar: Sensor | None
    poses: Array | None

    @property
    def all(self) -> tuple[Sensor, ...]:
        return (*self.cameras.values(), *([] if self.lidar is None else [self.lidar]))

    @property
    def reference(self) -> Sensor:
        """The sensor whose timestamps are those of the frames."""
        return self.all[0]

    @property
    def T_body_camera0(self) -> Matrix4:
        """Where the frame of the poses is: camera 0, or the body where there is no camera."""
        return self.reference.T_body_sensor if self.cameras else IDENTITY4


class KittiExporter:
    """Rectified cameras and a LiDAR that record together. Poses are those of camera 0, times start at 0 s."""

    def plan(self, dataset: Dataset) -> ExportPlan:
        """Raises InvalidInput for a dataset with neither camera nor LiDAR, or with cameras that are not rectified."""
        counts = message_counts(dataset)
        chosen = _choose(dataset, counts)
        times_ns = _times_ns(dataset, chosen.reference)
        truth = read_truth(dataset)
        poses = None if truth is None else _poses(truth.of_sensor(chosen.T_body_camera0), times_ns)
        missing = left_out(dataset, chosen.all) + truth_left_out(dataset)
        if truth is not None and poses is None:
            missing += ("the ground truth (not a pose for every frame)",)
        if chosen.lidar is not None and chosen.lidar.calibration.get("point_time_field"):
            missing += (f"the times of the points of {chosen.lidar.name}",)
        needed_bytes = sum(counts[camera.name] * image_bytes(camera) for camera in chosen.cameras.values())
        needed_bytes += 0 if chosen.lidar is None else counts[chosen.lidar.name] * _SCAN_BYTES
        chosen = _Chosen(chosen.cameras, chosen.lidar, poses)
        notes = () if times_ns[0] == 0 else (f"Times start at 0 s, which was {times_ns[0] / 1e9:.9f} s.",)
        return ExportPlan(partial(_write, dataset, chosen, times_ns), needed_bytes, missing, notes)


def _choose(dataset: Dataset, counts: dict[str, int]) -> _Chosen:
    """The cameras and the LiDAR that have as many messages as the first of them."""
    known = (*dataset.of_kind(SensorKind.CAMERA), *dataset.of_kind(SensorKind.LIDAR))
    if not known:
        raise InvalidInput(
            f"dataset {dataset.name} has neither camera nor LiDAR, which kitti is about", "export to mcap"
        )
    together = [sensor for sensor in known if counts[sensor.name] == counts[known[0].name]]
    cameras: dict[int, Sensor] = {}
    for sensor in together:
        if sensor.kind is SensorKind.CAMERA:
            first = known[0]
            seen = CameraIntrinsics.of(sensor)
            if not seen.rectified or any(seen.distortion):
                raise InvalidInput(f"the images of {sensor.name} are not rectified, and those of kitti are", ELSEWHERE)
            turn = _between(first.T_body_sensor, sensor)[:3, :3]
            if np.abs(turn - np.eye(3)).max() > _PARALLEL_TOLERANCE:
                raise InvalidInput(
                    f"{sensor.name} looks in another direction than {first.name}; those of kitti do not", ELSEWHERE
                )
            number = next((place for place in _numbers(sensor) if place not in cameras), None)
            if number is not None:
                cameras[number] = sensor
    lidar = next((sensor for sensor in together if sensor.kind is SensorKind.LIDAR), None)
    return _Chosen(dict(sorted(cameras.items())), lidar, None)


def _numbers(camera: Sensor) -> tuple[int, ...]:
    return _GREY if str(camera.calibration.get("encoding", "")).startswith("mono") else _COLOUR


def _between(T_body_first: Matrix4, second: Sensor) -> Array:
    """``T_first_second`` (4, 4)."""
    first, other = (np.array(T).reshape(4, 4) for T in (T_body_first, second.T_body_sensor))
    return np.linalg.solve(first, other)


def _times_ns(dataset: Dataset, sensor: Sensor) -> Array:
    """The timestamps of a sensor's messages, in the order of the recording."""
    path, times = dataset.bag_path, []
    with open_bag(path) as reader:
        for connection, _, raw in messages(reader, path, [sensor.topic]):
            stamp = decode(reader, path, connection, raw).header.stamp
            times.append(stamp.sec * 1_000_000_000 + stamp.nanosec)
    return np.array(times, dtype=np.int64)


def _poses(truth: ExportedTruth, times_ns: Array) -> Array | None:
    """A pose (3, 4) for each time, None if one has none."""
    after = np.clip(np.searchsorted(truth.times_ns, times_ns), 1, len(truth.times_ns) - 1)
    nearer = truth.times_ns[after] - times_ns < times_ns - truth.times_ns[after - 1]
    found = np.where(nearer, after, after - 1)
    if np.abs(truth.times_ns[found] - times_ns).max() > _SAME_TIME_NS:
        return None
    R = rotations_from_quats(truth.quats_xyzw[found])
    return np.concatenate((R, truth.positions_m[found][:, :, None]), axis=2)


@dataclass(eq=False)
class _ScanSink:
    """Scans as files of x, y, z and intensity, float32; points without a finite position are left out."""

    sensor: Sensor
    folder: Path

    def __post_init__(self) -> None:
        self.timestamps_ns: list[int] = []
        self.folder.mkdir(parents=True)

    def take(self, timestamp_ns: int, message: Any) -> Work:
        """Write a scan, in a thread."""
        path = self.folder / f"{len(self.timestamps_ns):06d}.bin"
        self.timestamps_ns.append(timestamp_ns)
        return partial(_write_scan, path, message, self.sensor.topic)


def _write_scan(path: Path, message: Any, topic: str) -> None:
    points = CODECS[POINTS].decode(message, topic)
    names = points.dtype.names or ()
    missing = [name for name in (*_AXES, "intensity") if name not in names]
    if missing:
        raise InvalidInput(f"{topic}: its points have no {', '.join(missing)}, which kitti needs", ELSEWHERE)
    scan = np.empty(len(points), POINT_TYPE)
    for name in (*_AXES, "intensity"):
        scan[name] = points[name]
    finite = np.isfinite(scan.view("<f4").reshape(-1, 4)).all(axis=1)
    path.write_bytes(scan[finite].tobytes())


def _write(dataset: Dataset, chosen: _Chosen, times_ns: Array, folder: Path, progress: Progress) -> None:
    sinks: dict[str, ImageSink | _ScanSink] = {
        camera.name: ImageSink(camera, folder / f"image_{number}", lambda _, index: f"{index:06d}.png")
        for number, camera in chosen.cameras.items()
    }
    if chosen.lidar is not None:
        sinks[chosen.lidar.name] = _ScanSink(chosen.lidar, folder / "velodyne")
    export_frames(dataset, sinks, progress)
    for sink in sinks.values():
        # A message far from the frame of its number says that one is missing before it.
        apart_ns = np.abs(np.array(sink.timestamps_ns, dtype=np.int64) - times_ns)
        frame_ns = float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else np.inf
        far = np.flatnonzero(apart_ns > _SAME_FRAME * frame_ns)
        if len(far):
            raise InvalidInput(
                f"message {far[0]} of {sink.sensor.name} is {apart_ns[far[0]] / 1e9:.3f} s from frame {far[0]}: "
                "the sensors do not record together, as those of kitti do",
                ELSEWHERE,
            )
    _write_lines(folder / "times.txt", (f"{time_ns / 1e9:.9f}" for time_ns in (times_ns - times_ns[0]).tolist()))
    _write_lines(folder / "calib.txt", _calibration(chosen))
    if chosen.poses is not None:
        _write_lines(folder / "poses.txt", (_row(pose) for pose in chosen.poses))


def _calibration(chosen: _Chosen) -> list[str]:
    """``P0`` to ``P3`` = K [I | t], where camera 0 sees x + t where the camera sees x; ``Tr`` = ``T_cam0_lidar``."""
    lines = []
    for number, camera in chosen.cameras.items():
        seen = CameraIntrinsics.of(camera)
        K = np.array([[seen.fx, 0.0, seen.cx], [0.0, seen.fy, seen.cy], [0.0, 0.0, 1.0]])
        offset_m = 0.0 - _between(chosen.T_body_camera0, camera)[:3, 3]
        lines.append(f"P{number}: {_row(np.column_stack((K, K @ offset_m)))}")
    if chosen.lidar is not None:
        lines.append(f"Tr: {_row(_between(chosen.T_body_camera0, chosen.lidar)[:3])}")
    return lines


def _row(matrix: Array) -> str:
    return " ".join(repr(float(value)) for value in matrix.reshape(-1))


def _write_lines(path: Path, lines: Iterable[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="ascii")
