"""Importer of KITTI odometry sequences (Geiger, Lenz, Urtasun 2012)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.bags.bag_writer import BagWriter, nanoseconds
from slamhive.bags.detection import Detection
from slamhive.bags.frame_files import read_image, read_velodyne
from slamhive.bags.geometry import Array, quaternions_from_rotations, transform
from slamhive.bags.image_stream import OVERHEAD_BYTES, image_stream
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan, PlannedTruth, Stream, rate_hz
from slamhive.bags.kitti_sequence import KittiSequence, detect_kitti, read_sequence, velodyne_layout
from slamhive.domain.calibration import CameraIntrinsics
from slamhive.domain.sensors import Sensor, SensorKind

_FIRST_COLOUR_CAMERA = 2


class KittiOdometryImporter:
    """Rectified grey and colour images, Velodyne scans, times, calibration and poses of camera 0 to a dataset.

    The body frame is that of camera 0. Scans of this benchmark are corrected for motion already and carry no time per
    point. Colour images (``image_2``, ``image_3``) become ``bgr8``, grey ones ``mono8``.
    """

    title = "KITTI odometry sequence: PNG images, Velodyne scans, calib.txt, times.txt, poses"
    options: frozenset[str] = frozenset()
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The parts of a sequence in ``path``."""
        return detect_kitti(path)

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:  # noqa: ARG002 - it takes no options
        """What the sequence becomes; raises InvalidInput naming the file, the line or frame, and the remedy."""
        sequence = read_sequence(source)
        streams = [_camera_stream(sequence, number) for number in sequence.images]
        lidar = _lidar(sequence)
        if lidar is not None:
            streams.append(_lidar_stream(sequence, lidar))
        return ImportPlan(tuple(streams), _truth(sequence), _text(sequence), notes=sequence.notes)


def _camera_stream(sequence: KittiSequence, number: int) -> Stream:
    """Intrinsics from P = K [I | t]; camera 0 sees x + t where camera ``number`` sees x, so it sits at -t."""
    P, paths = sequence.projections[number], sequence.images[number]
    encoding = "bgr8" if number >= _FIRST_COLOUR_CAMERA else "mono8"
    height, width = read_image(paths[0], encoding).shape[:2]
    intrinsics = CameraIntrinsics(
        width=int(width),
        height=int(height),
        fx=float(P[0, 0]),
        fy=float(P[1, 1]),
        cx=float(P[0, 2]),
        cy=float(P[1, 2]),
        distortion=(0.0, 0.0, 0.0, 0.0),
        rectified=True,
    )
    position_m = 0.0 - np.linalg.solve(P[:, :3], P[:, 3])
    sensor = Sensor(
        f"cam{number}",
        SensorKind.CAMERA,
        f"/cam{number}/image_raw",
        rate_hz(_times_ns(sequence)),
        tuple(float(value) for value in transform(np.eye(3), position_m).reshape(-1)),
        intrinsics.calibration(encoding),
    )
    return image_stream(sensor, _times_ns(sequence), paths, baseline_m=float(position_m[0]))


def _lidar_stream(sequence: KittiSequence, lidar: Sensor) -> Stream:
    times_ns, scans = _times_ns(sequence), sequence.scans

    def write(bag: BagWriter, index: int) -> None:
        stamp_ns = int(times_ns[index])
        bag.points(lidar, stamp_ns, stamp_ns, read_velodyne(scans[index]))

    return Stream(lidar, times_ns, write, sum(path.stat().st_size for path in scans) // len(scans) + OVERHEAD_BYTES)


def _times_ns(sequence: KittiSequence) -> Array:
    return np.array([nanoseconds(float(time_s)) for time_s in sequence.times_s], dtype=np.int64)


def _lidar(sequence: KittiSequence) -> Sensor | None:
    """The Velodyne HDL-64E, its timestamp the instant it faced forward, when the cameras were triggered."""
    if sequence.T_cam0_lidar is None:
        return None
    return Sensor(
        "lidar0",
        SensorKind.LIDAR,
        "/points",
        rate_hz(_times_ns(sequence)),
        tuple(float(value) for value in sequence.T_cam0_lidar.reshape(-1)),
        velodyne_layout().calibration(),
    )


def _truth(sequence: KittiSequence) -> PlannedTruth | None:
    poses = sequence.poses
    if poses is None or sequence.pose_times_s is None:
        return None
    quats_xyzw = quaternions_from_rotations(poses[:, :, :3])
    return PlannedTruth(
        sequence.pose_times_s, poses[:, :, 3], quats_xyzw, gravity_aligned=False, source="GNSS and IMU (RTK)"
    )


def _text(sequence: KittiSequence) -> DatasetText:
    return DatasetText(
        title=f"KITTI odometry, {sequence.source.resolve().name}",
        description=f"{len(sequence.times_s)} frames of the KITTI odometry benchmark; the body is camera 0.",
        licence="CC BY-NC-SA 3.0",
        citation="Geiger, Lenz, Urtasun: Are we ready for autonomous driving? The KITTI benchmark suite. CVPR 2012",
        source="https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
        attributes=("real", "outdoor", "car"),
    )
