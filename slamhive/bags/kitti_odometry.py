"""Importer of KITTI odometry sequences (Geiger, Lenz, Urtasun 2012)."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.bags.bag_writer import nanoseconds
from slamhive.bags.detection import Detection
from slamhive.bags.frame_files import read_png, read_velodyne
from slamhive.bags.geometry import Array, quaternions_from_rotations, transform
from slamhive.bags.kitti_sequence import KittiSequence, detect_kitti, read_sequence
from slamhive.bags.staging import GROUND_TRUTH_FILE, NewDataset, Progress, new_dataset
from slamhive.domain.dataset import Dataset, GroundTruth
from slamhive.domain.names import check_name
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput

_LOG = logging.getLogger(__name__)
_FIRST_COLOUR_CAMERA = 2


@dataclass(frozen=True, slots=True)
class _Camera:
    """A camera of the sequence: its number, its sensor, how far it sits right of camera 0."""

    number: int
    sensor: Sensor
    baseline_m: float

    @property
    def colour(self) -> bool:
        return self.number >= _FIRST_COLOUR_CAMERA

    @property
    def encoding(self) -> str:
        return str(self.sensor.calibration["encoding"])


class KittiOdometryImporter:
    """Rectified grey and colour images, Velodyne scans, times, calibration and poses of camera 0 to a dataset.

    The body frame is that of camera 0. Scans of this benchmark are corrected for motion already and carry no time per
    point. Colour images (``image_2``, ``image_3``) become ``bgr8``, grey ones ``mono8``.
    """

    def detect(self, path: Path) -> Detection:
        """The parts of a sequence in ``path``."""
        return detect_kitti(path)

    def convert(self, source: Path, folder: Path, name: str, progress: Progress) -> Dataset:
        """Make the dataset ``name`` in ``folder``, complete or not at all.

        Raises:
            InvalidInput: naming the file, the line or frame, what was found, and the remedy.
            Conflict: the dataset exists.
            Unavailable: not enough disk space.
        """
        check_name("dataset", name)
        sequence = read_sequence(source)
        cameras = [_camera(sequence, number) for number in sequence.images]
        lidar = _lidar(sequence)
        with new_dataset(folder, _expected_bytes(sequence, cameras)) as new:
            _record(new, sequence, cameras, lidar, progress)
            if sequence.poses is not None:
                poses = sequence.poses
                new.write_ground_truth(sequence.times_s, poses[:, :, 3], quaternions_from_rotations(poses[:, :, :3]))
            progress(0.97, "computing the checksum")
            sensors = (*(camera.sensor for camera in cameras), *([lidar] if lidar else []))
            dataset = new.seal(sensors=sensors, **_description(sequence))
        _LOG.info("imported %s as dataset %s", source, name)
        progress(1.0, "done")
        return dataset


def _record(
    new: NewDataset, sequence: KittiSequence, cameras: list[_Camera], lidar: Sensor | None, progress: Progress
) -> None:
    frames = len(sequence.times_s)
    with new.recording() as bag:
        for index, time_s in enumerate(sequence.times_s):
            stamp_ns = nanoseconds(float(time_s))
            for camera in cameras:
                pixels = _pixels(sequence.images[camera.number][index], camera)
                bag.camera_info(camera.sensor, f"/{camera.sensor.name}/camera_info", stamp_ns, camera.baseline_m)
                bag.image(camera.sensor, stamp_ns, pixels, camera.encoding)
            if lidar is not None:
                bag.points(lidar, stamp_ns, stamp_ns, read_velodyne(sequence.scans[index]))
            progress(0.95 * (index + 1) / frames, f"converting frame {index + 1} of {frames}")


def _pixels(path: Path, camera: _Camera) -> Array:
    pixels = read_png(path, colour=camera.colour)
    expected = (camera.sensor.calibration["height"], camera.sensor.calibration["width"])
    if pixels.shape[:2] != expected:
        raise InvalidInput(
            f"frame {path} is {pixels.shape[1]}x{pixels.shape[0]} pixels, "
            f"the first of its camera {expected[1]}x{expected[0]}",
            "all frames of a camera must have one size: is this frame from another sequence?",
        )
    return pixels


def _camera(sequence: KittiSequence, number: int) -> _Camera:
    """Intrinsics from P = K [I | t]; camera 0 sees x + t where camera ``number`` sees x, so it sits at -t."""
    P = sequence.projections[number]
    colour = number >= _FIRST_COLOUR_CAMERA
    height, width = read_png(sequence.images[number][0], colour=colour).shape[:2]
    position_m = 0.0 - np.linalg.solve(P[:, :3], P[:, 3])
    sensor = Sensor(
        f"cam{number}",
        SensorKind.CAMERA,
        f"/cam{number}/image_raw",
        _rate_hz(sequence),
        tuple(float(value) for value in transform(np.eye(3), position_m).reshape(-1)),
        {
            "width": int(width),
            "height": int(height),
            "fx": float(P[0, 0]),
            "fy": float(P[1, 1]),
            "cx": float(P[0, 2]),
            "cy": float(P[1, 2]),
            "encoding": "bgr8" if colour else "mono8",
            "model": "pinhole",
            "distortion": (0.0, 0.0, 0.0, 0.0),
            "rectified": True,
        },
    )
    return _Camera(number, sensor, float(position_m[0]))


def _lidar(sequence: KittiSequence) -> Sensor | None:
    """The Velodyne HDL-64E, its timestamp the instant it faced forward, when the cameras were triggered."""
    if sequence.T_cam0_lidar is None:
        return None
    return Sensor(
        "lidar0",
        SensorKind.LIDAR,
        "/points",
        _rate_hz(sequence),
        tuple(float(value) for value in sequence.T_cam0_lidar.reshape(-1)),
        {
            "beams": 64,
            "minimum_range_m": 0.9,
            "maximum_range_m": 120.0,
            "point_time_field": "",
            "point_time_unit": "ns",
            "stamp": "middle",
            "scan_duration_s": 0.1,
        },
    )


def _description(sequence: KittiSequence) -> dict[str, Any]:
    has_truth = sequence.poses is not None
    return {
        "duration_s": float(sequence.times_s[-1] - sequence.times_s[0]),
        "groundtruth": GroundTruth(GROUND_TRUTH_FILE, gravity_aligned=False) if has_truth else None,
        "title": f"KITTI odometry, {sequence.source.resolve().name}",
        "description": f"{len(sequence.times_s)} frames of the KITTI odometry benchmark; the body is camera 0.",
        "licence": "CC BY-NC-SA 3.0",
        "source": "https://www.cvlibs.net/datasets/kitti/eval_odometry.php",
        "attributes": ("real", "outdoor", "car"),
    }


def _rate_hz(sequence: KittiSequence) -> float:
    times_s = sequence.times_s
    return round(float((len(times_s) - 1) / (times_s[-1] - times_s[0])), 6)


def _expected_bytes(sequence: KittiSequence, cameras: list[_Camera]) -> int:
    frames = len(sequence.times_s)
    image_bytes = 0
    for camera in cameras:
        width, height = camera.sensor.calibration["width"], camera.sensor.calibration["height"]
        image_bytes += int(width) * int(height) * (3 if camera.colour else 1)  # type: ignore[arg-type]
    scan_bytes = sum(path.stat().st_size for path in sequence.scans)
    return frames * (image_bytes + 2000) + scan_bytes
