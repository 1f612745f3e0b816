"""Importer of the folders that VSLAM-LAB makes of every dataset (Fontan et al.): https://github.com/VSLAM-LAB/VSLAM-LAB.

``rgb.csv`` (``ts_rgb_0 (ns),path_rgb_0,...``), ``imu_0.csv``, ``groundtruth.csv`` and ``calibration.yaml``.
"""

from __future__ import annotations

from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import flat
from slamhive.recordings.importers.calibration import CalibrationFile, read_calibration_file
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    rate_hz,
    tum_truth,
)
from slamhive.recordings.rgbd import Frames, camera_stream, depth_stream
from slamhive.recordings.streams import imu_stream
from slamhive.recordings.text_lists import listed_truth, parse_timed_list, read_lines, read_timed_list
from slamhive.trajectory.layout import TimeUnit

_IMAGES, _CAMERAS, _SAMPLES, _TRUTH = "rgb.csv", "calibration.yaml", "imu_0.csv", "groundtruth.csv"
_MODELS = {"radtan": CameraModel.PINHOLE_RADTAN, "equid": CameraModel.FISHEYE_KB}
_NOISE = {
    "gyroscope_noise_density": "sigma_g_c",
    "accelerometer_noise_density": "sigma_a_c",
    "gyroscope_random_walk": "sigma_gw_c",
    "accelerometer_random_walk": "sigma_aw_c",
}


class VslamLabImporter:
    """Images, depth, IMU samples and poses to a dataset; the body is that of ``T_BS`` in ``calibration.yaml``."""

    title = "VSLAM-LAB sequence: rgb.csv, calibration.yaml, imu_0.csv, groundtruth.csv"
    options = frozenset({"groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The files of the sequence."""
        found = [name for name in (_IMAGES, _CAMERAS, _SAMPLES, _TRUTH) if (path / name).is_file()]
        return Detection(tuple(found), tuple(name for name in (_IMAGES, _CAMERAS) if name not in found))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the sequence; raises InvalidInput naming the file, the line or key, and the remedy."""
        calibration = read_calibration_file(source / _CAMERAS)
        streams: list[PlannedStream] = []
        notes: list[str] = []
        for number, part in enumerate(calibration.parts("cameras")):
            made, remarks = _camera(source, part, number)
            streams.extend(made)
            notes.extend(remarks)
        if not streams:
            raise InvalidInput(f"{calibration.name} has no cameras", "add them from the calibration of the dataset")
        streams.sort(key=lambda stream: stream.sensor.kind is SensorKind.DEPTH)
        imus = calibration.parts("imus")
        if imus and (source / _SAMPLES).is_file():
            stream, remarks = _imu(source, imus[0])
            streams.append(stream)
            notes.extend(remarks)
        truth = _truth(source, options)
        return ImportPlan(tuple(streams), truth, _text(source), notes=(*notes, *matched_truth(truth, streams)))


def _camera(source: Path, part: CalibrationFile, number: int) -> tuple[list[PlannedStream], tuple[str, ...]]:
    """The streams of a camera: its images, and depth if it has some."""
    name = part.word("cam_name")
    frames, notes = _frames(source, name)
    T_body_camera = flat(part.rigid("T_BS"))
    stream = camera_stream(f"cam{number}", frames, _intrinsics(part), T_body_camera)
    if "depth_name" not in part.content:
        return [stream], notes
    depth, remarks = _frames(source, part.word("depth_name"))
    return [stream, depth_stream(stream.sensor, depth, part.positive("depth_factor"))], (*notes, *remarks)


def _frames(source: Path, name: str) -> tuple[Frames, tuple[str, ...]]:
    """The images of the columns ``ts_<name> (ns)`` and ``path_<name>``."""
    path = source / _IMAGES
    lines = read_lines(path)
    header = [word.strip() for word in lines[0].split(",")] if lines else []
    try:
        columns = header.index(f"ts_{name} (ns)"), header.index(f"path_{name}")
    except ValueError:
        raise InvalidInput(f"{path} lacks the columns of {name}, found {', '.join(header)[:200]}") from None
    # A line that is too short keeps its first word alone, so that its error shows it.
    split = [line.split(",") for line in lines]
    chosen = [
        ",".join(words[column] for column in columns) if len(words) > max(columns) else words[0] for words in split
    ]
    rows = parse_timed_list(chosen, path, f"ts_{name} (ns), path_{name}", TimeUnit.NS, columns=2)
    kept, paths = rows.files(source)
    return Frames(kept.times_ns, paths), rows.notes(kept)


def _intrinsics(part: CalibrationFile) -> CameraIntrinsics:
    width, height = part.size("image_dimension")
    (fx, fy), (cx, cy) = part.numbers("focal_length", 2), part.numbers("principal_point", 2)
    kind = part.word("distortion_type", "none")
    if kind in {"none", "None"}:
        return CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4)
    model = _MODELS.get(kind.rstrip("0123456789"))
    if model is None:
        raise InvalidInput(f"{part.name}: distortion type {kind} is unknown", f"use {' or '.join(_MODELS)}")
    distortion = part.numbers("distortion_coefficients", 4, 5, 8)
    if not any(distortion):
        return CameraIntrinsics(width, height, fx, fy, cx, cy, distortion=(0.0,) * 4)
    return CameraIntrinsics(width, height, fx, fy, cx, cy, model, distortion)


def _imu(source: Path, part: CalibrationFile) -> tuple[PlannedStream, tuple[str, ...]]:
    rows = read_timed_list(source / _SAMPLES, "ts (ns), wx, wy, wz, ax, ay, az", TimeUnit.NS, columns=7)
    noise = ImuNoise(**{ours: part.optional(theirs) for ours, theirs in _NOISE.items()})
    T_body_imu = flat(part.rigid("T_BS"))
    sensor = Sensor("imu0", SensorKind.IMU, "/imu0", rate_hz(rows.times_ns), T_body_imu, noise.calibration())
    return imu_stream(sensor, rows.times_ns, rows.numbers(0, 6)), rows.notes()


def _truth(source: Path, options: ImportOptions) -> PlannedTruth | None:
    if options.groundtruth is not None:
        return tum_truth(options.groundtruth, "", gravity_aligned=False)
    path = source / _TRUTH
    if not path.is_file() or len(read_lines(path)) < 2:
        return None
    rows = read_timed_list(path, "ts (ns), tx, ty, tz, qx, qy, qz, qw", TimeUnit.NS, columns=8)
    return listed_truth(rows, rows.numbers(3, 4), "", gravity_aligned=False)


def _text(source: Path) -> DatasetText:
    resolved = source.resolve()
    return DatasetText(
        title=f"{resolved.parent.name} {resolved.name}",
        description="A sequence as VSLAM-LAB prepares it.",
        source="https://github.com/VSLAM-LAB/VSLAM-LAB",
    )
