"""Importer of OpenLORIS-Scene (Shi et al., "Are we ready for service robots?", ICRA 2020).

https://lifelong-robotic-vision.github.io/dataset/scene: lists as in TUM RGB-D, ``sensors.yaml`` and
``trans_matrix.yaml`` in OpenCV's YAML. Intrinsics are in the order fx cx fy cy; a transform maps from the
child frame to the parent.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics, CameraModel
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array, flat
from slamhive.recordings.importers.calibration import CalibrationFile, read_calibration_file
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    matched_truth,
    rate_hz,
    tum_truth,
)
from slamhive.recordings.rgbd import Frames, camera_stream, depth_stream, listed_frames
from slamhive.recordings.streams import imu_stream
from slamhive.recordings.text_lists import read_timed_list
from slamhive.trajectory.layout import TimeUnit

_BODY, _SENSORS, _TRANSFORMS = "base_link", "sensors.yaml", "trans_matrix.yaml"
_COLOUR, _DEPTH, _TRUTH = "color.txt", "aligned_depth.txt", "groundtruth.txt"
_CAMERA_FRAME, _ACCELERATIONS, _RATES = "d400_color_optical_frame", "d400_accelerometer", "d400_gyroscope"
_UNITS_PER_M = 1000.0
_FISHEYES = {"fisheye1": "t265_fisheye1_optical_frame", "fisheye2": "t265_fisheye2_optical_frame"}


class OpenLorisImporter:
    """Colour, registered depth, fisheye images and IMU of a robot to a dataset; the body is ``base_link``.

    The IMU of the D400 measures angular rates and accelerations at different times. Accelerations are interpolated
    at the times of the rates.
    """

    title = "OpenLORIS-Scene sequence: color.txt, aligned_depth.txt, sensors.yaml, trans_matrix.yaml"
    options = frozenset({"depth_units_per_m", "groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The lists and calibration of the sequence."""
        names = (_COLOUR, _DEPTH, _SENSORS, _TRANSFORMS)
        found = tuple(name for name in names if (path / name).is_file())
        return Detection(found, tuple(name for name in names if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the sequence; raises InvalidInput naming the file, the line or key, and the remedy."""
        sensors, transforms = (read_calibration_file(source / name) for name in (_SENSORS, _TRANSFORMS))
        colour, notes = listed_frames(source, _COLOUR)
        stream = _camera(sensors, transforms, ("cam0", _CAMERA_FRAME), colour)
        depth, remarks = listed_frames(source, _DEPTH)
        streams = [stream, depth_stream(stream.sensor, depth, options.depth_units_per_m or _UNITS_PER_M)]
        notes += remarks
        for number, (name, frame) in enumerate(_FISHEYES.items(), start=1):
            if (source / f"{name}.txt").is_file():
                frames, remarks = listed_frames(source, f"{name}.txt")
                streams.append(_camera(sensors, transforms, (f"cam{number}", frame), frames))
                notes += remarks
        if all((source / f"{name}.txt").is_file() for name in (_ACCELERATIONS, _RATES)):
            streams.append(_imu(source, transforms))
            notes += ("accelerations are interpolated at the times of the angular rates; noise is not known",)
        path = options.groundtruth or source / _TRUTH
        known = options.groundtruth is not None or path.is_file()
        truth = tum_truth(path, "motion capture or 2D LiDAR SLAM, by scene", gravity_aligned=True) if known else None
        return ImportPlan(tuple(streams), truth, _text(source), notes=(*notes, *matched_truth(truth, streams)))


def _camera(
    sensors: CalibrationFile, transforms: CalibrationFile, name_and_frame: tuple[str, str], frames: Frames
) -> PlannedStream:
    name, frame = name_and_frame
    part = sensors.part(frame)
    width, height = part.size("width", "height")
    fx, cx, fy, cy = part.numbers("intrinsics", 4)
    distortion = part.numbers("distortion_coefficients") if "distortion_coefficients" in part.content else ()
    if not any(distortion):
        intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4)
    elif frame in _FISHEYES.values():
        intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy, CameraModel.FISHEYE_KB, distortion[:4])
    else:
        intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy, CameraModel.PINHOLE_RADTAN, distortion)
    T_body_camera = flat(_T_body(transforms, frame))
    return camera_stream(name, frames, intrinsics, T_body_camera)


def _T_body(transforms: CalibrationFile, frame: str) -> Array:
    """The transform from ``frame`` to the body along the chain of its parents; raises InvalidInput."""
    parents = {part.word("child_frame"): part for part in transforms.parts("trans_matrix")}
    T = np.eye(4)
    for _ in range(len(parents) + 1):
        if frame == _BODY:
            return T
        if frame not in parents:
            break
        T = parents[frame].rigid("matrix") @ T
        frame = parents[frame].word("parent_frame")
    raise InvalidInput(f"{transforms.name}: no chain of transforms leads from {frame} to {_BODY}", "complete the file")


def _imu(source: Path, transforms: CalibrationFile) -> PlannedStream:
    rates = read_timed_list(source / f"{_RATES}.txt", "timestamp wx wy wz", TimeUnit.S)
    accelerations = read_timed_list(source / f"{_ACCELERATIONS}.txt", "timestamp ax ay az", TimeUnit.S)
    measured, start_ns = accelerations.numbers(0, 3), int(rates.times_ns[0])
    inside = (rates.times_ns >= accelerations.times_ns[0]) & (rates.times_ns <= accelerations.times_ns[-1])
    times_ns = rates.times_ns[inside]
    at, known_at = times_ns - start_ns, accelerations.times_ns - start_ns
    interpolated = np.column_stack([np.interp(at, known_at, column) for column in measured.T])
    T_body_imu = flat(_T_body(transforms, _RATES))
    sensor = Sensor("imu0", SensorKind.IMU, "/imu0", rate_hz(times_ns), T_body_imu)
    return imu_stream(sensor, times_ns, np.column_stack((rates.numbers(0, 3)[inside], interpolated)))


def _text(source: Path) -> DatasetText:
    return DatasetText(
        title=f"OpenLORIS-Scene, {source.resolve().name}",
        description="Colour, depth and fisheye images and IMU of a service robot; the body is its base.",
        licence="see the terms of OpenLORIS-Scene",
        citation="Shi et al.: Are we ready for service robots? The OpenLORIS-Scene datasets. ICRA 2020",
        source="https://lifelong-robotic-vision.github.io/dataset/scene",
        attributes=("real", "indoor", "robot"),
    )
