"""Importer of recordings of Project Aria's glasses: VRS files, with the trajectory of Machine Perception Services.

https://facebookresearch.github.io/projectaria_tools: projectaria-tools (Apache-2.0) reads the file in an environment of
its own. The body is the frame ``device``, in which the file and the trajectory give their poses. All timestamps
are on the clock of the device.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, NonNegativeInt

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import TIME_OFFSET, CameraIntrinsics, CameraModel
from slamhive.domain.names import plural
from slamhive.domain.sensors import Sensor, SensorKind, is_rigid
from slamhive.recordings.geometry import Array
from slamhive.recordings.importers.outside import Library, OutsidePlan, OutsideRecording
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
from slamhive.recordings.streams import OVERHEAD_BYTES, imu_stream
from slamhive.recordings.writers import NS_PER_S, BagWriter
from slamhive.trajectory.model import find_problem
from slamhive.trajectory.table import read_bounded

ARIA = Library("aria", "projectaria_tools", "projectaria-tools")
_TRAJECTORY = "closed_loop_trajectory.csv"
_FEWEST_RAYS = 50
_LARGEST = 1e6
_DOWN = np.array([0.0, 0.0, -1.0])


class AriaCamera(BaseModel):
    """Facts about one camera; the transform by rows, in metres."""

    label: str
    stream: str
    width: int = Field(gt=0, le=20_000)
    height: int = Field(gt=0, le=20_000)
    channels: int
    focal_px: FiniteFloat = Field(gt=0, le=_LARGEST)
    model: str
    time_offset_s: FiniteFloat
    T_device_sensor: tuple[FiniteFloat, ...]


class AriaImu(BaseModel):
    """Facts about one IMU. The offsets are how late timestamps are."""

    label: str
    invalid: NonNegativeInt
    gyro_offset_s: FiniteFloat
    force_offset_s: FiniteFloat
    T_device_sensor: tuple[FiniteFloat, ...]


class AriaPlan(OutsidePlan):
    """Answer of the reader about a recording; ``rays0`` are pixels u, v of ``cam0`` with the directions x, y, z."""

    device: str
    cameras: list[AriaCamera]
    imus: list[AriaImu]
    left_out: list[str]

    @property
    def columns(self) -> dict[str, int]:
        """The arrays of all cameras and IMUs."""
        cameras, imus = range(len(self.cameras)), range(len(self.imus))
        return {
            **{f"cam{number}_times_ns": 1 for number in cameras},
            **{f"rays{number}": 5 for number in cameras},
            **{f"imu{number}_times_ns": 1 for number in imus},
            **{f"imu{number}": 6 for number in imus},
        }


class AriaImporter:
    """Images and IMU samples of a VRS file to a dataset, with the closed-loop trajectory as ground truth.

    Cameras for SLAM come first, left before right, then the colour camera. The calibration of the factory corrects IMU
    samples. Fisheye models of 15 parameters become the nearest one of Kannala and Brandt; a note says how near.
    """

    title = f"Project Aria: a .vrs file, or a folder with one; {_TRAJECTORY} below it is the ground truth"
    options = frozenset({"groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """A VRS file, or a folder that holds exactly one."""
        files = _recordings(path)
        if len(files) == 1:
            return Detection((f"the VRS file {files[0].name}",), ())
        return Detection((f"{len(files)} VRS files",) if files else (), ("exactly one .vrs file",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import; raises InvalidInput with the library's reason, Unavailable without the library."""
        files = _recordings(source)
        if len(files) != 1:
            raise InvalidInput(f"{source} has {len(files)} files *.vrs", "give one of them")
        recording = OutsideRecording(ARIA, files[0], files[0].name)
        about = recording.plan(AriaPlan)
        notes: list[str] = []
        poses = {entry.label: entry.T_device_sensor for entry in about.cameras}
        poses |= {entry.label: entry.T_device_sensor for entry in about.imus}
        for label, T_device_sensor in poses.items():
            if not is_rigid(T_device_sensor):
                raise InvalidInput(f"{files[0]}: the pose of {label} is not rigid", "correct its calibration")
        streams = [_camera(recording, about, number, notes) for number in range(len(about.cameras))]
        imus = [_imu(recording, about, number, notes) for number in range(len(about.imus))]
        streams += [imu for imu in imus if imu is not None]
        if not streams:
            raise InvalidInput(f"{files[0]} has no images and no IMU samples", "give the recording of a device")
        if about.left_out:
            notes.append(f"left out: {', '.join(sorted(about.left_out))}")
        path = options.groundtruth or _beside(files[0])
        truth = None if path is None else _truth(path, notes)
        text = DatasetText(
            title=f"{files[0].stem} (Project Aria)",
            description=f"Read with projectaria-tools; device {about.device}. The body is the frame device.",
            source="https://www.projectaria.com",
            attributes=("real",),
        )
        return ImportPlan(tuple(streams), truth, text, notes=(*notes, *matched_truth(truth, streams)))


def _recordings(path: Path) -> list[Path]:
    """The file itself, or those in the folder."""
    if path.is_dir():
        return visible_files(path, "*.vrs")
    return [path] if path.suffix == ".vrs" and path.is_file() else []


def _beside(file: Path) -> Path | None:
    """The trajectory that the services write near a recording: in the folders ``slam`` of ``mps``, or without them."""
    folders = (f"mps_{file.stem}_vrs/slam", "mps/slam", "slam", "trajectory", ".")
    found = (file.parent / folder / _TRAJECTORY for folder in folders)
    return next((path for path in found if path.is_file()), None)


def _camera(recording: OutsideRecording, about: AriaPlan, number: int, notes: list[str]) -> PlannedStream:
    camera, times_ns, name = about.cameras[number], about.values[f"cam{number}_times_ns"], f"cam{number}"
    recording.check_order(f"images of {camera.label}", times_ns)
    if camera.channels not in {1, 3}:
        raise InvalidInput(f"{camera.label} of {recording.name} has {camera.channels} channels", "1 and 3 are read")
    intrinsics, rms_px, most_px = nearest_fisheye(camera, about.values[f"rays{number}"])
    notes.append(
        f"{name} is {camera.label}: its model {camera.model} becomes {intrinsics.model}, "
        f"{rms_px:.2g} pixels apart (RMS), at most {most_px:.2g}"
    )
    encoding = "mono8" if camera.channels == 1 else "rgb8"
    # Aria subtracts its offset, and a dataset states what is to be added.
    offset = {TIME_OFFSET: -camera.time_offset_s} if camera.time_offset_s else {}
    calibration = intrinsics.calibration(encoding, **offset)
    topic = f"/{name}/image_raw"
    sensor = Sensor(name, SensorKind.CAMERA, topic, rate_hz(times_ns), camera.T_device_sensor, calibration)
    shape = (camera.height, camera.width, *((3,) if camera.channels == 3 else ()))
    reading: list[Iterator[tuple[int, Array]]] = []

    def write(bag: BagWriter, index: int) -> None:
        if index == 0:
            reading[:] = [recording.records(camera.stream, np.uint8)]
        image, expected_ns = next(reading[0], None), int(times_ns[index])
        if image is None or image[0] != expected_ns:
            raise InvalidInput(f"image {index} of {camera.label} is another when read again", "import again")
        if image[1].size != int(np.prod(shape)):
            raise InvalidInput(
                f"image {index} of {camera.label} has {image[1].size} bytes, not {' x '.join(map(str, shape))}",
                "give a recording whose images all have one size",
            )
        bag.camera_info(sensor, f"/{name}/camera_info", expected_ns)
        bag.image(sensor, expected_ns, image[1].reshape(shape), encoding)

    return PlannedStream(sensor, times_ns, write, int(np.prod(shape)) + OVERHEAD_BYTES)


def nearest_fisheye(camera: AriaCamera, rays: Array) -> tuple[CameraIntrinsics, float, float]:
    """Fit the model of Kannala and Brandt to pixels and their directions (n, 5).

    J. Kannala, S. Brandt. A generic camera model and calibration method for conventional, wide-angle, and fish-eye
    lenses. TPAMI 28(8), 2006; with the first four coefficients.

    Returns:
        The intrinsics, and how far pixels are apart: the root mean square, and the most.

    Raises:
        InvalidInput: There are too few rays.
    """
    if len(rays) < _FEWEST_RAYS:
        raise InvalidInput(f"the calibration of {camera.label} covers {len(rays)} of 625 pixels", "correct it")
    if not (np.abs(rays) <= _LARGEST).all():
        raise InvalidInput(f"the calibration of {camera.label} has numbers beyond {_LARGEST:g}", "correct it")
    pixels, x, y, z = rays[:, :2], *rays[:, 2:].T
    across = np.hypot(x, y)
    angles_rad = np.arctan2(across, z)
    # the direction of the optical axis has no azimuth, and needs none
    directions = np.stack([x, y], axis=1) / np.where(across > 0, across, 1.0)[:, None]
    powers = angles_rad[:, None] ** np.array([3, 5, 7, 9])

    def residuals(numbers: Array) -> Array:
        radii = angles_rad + powers @ numbers[4:]
        errors: Array = (numbers[:2] * radii[:, None] * directions + numbers[2:4] - pixels).reshape(-1)
        return errors

    centre = ((camera.width - 1) / 2, (camera.height - 1) / 2)
    from scipy.optimize import least_squares  # noqa: PLC0415 - no other importer needs it

    fitted = least_squares(residuals, [camera.focal_px, camera.focal_px, *centre, 0.0, 0.0, 0.0, 0.0], x_scale="jac")
    fx, fy, cx, cy, *coefficients = (float(number) for number in fitted.x)
    apart_px = np.linalg.norm(residuals(fitted.x).reshape(-1, 2), axis=1)
    model, distortion = CameraModel.FISHEYE_KB, tuple(coefficients)
    intrinsics = CameraIntrinsics(camera.width, camera.height, fx, fy, cx, cy, model, distortion)
    return intrinsics, float(np.sqrt(np.mean(apart_px**2))), float(apart_px.max())


def _imu(recording: OutsideRecording, about: AriaPlan, number: int, notes: list[str]) -> PlannedStream | None:
    """One IMU, None with fewer than two samples.

    Its timestamps become those of the angular rates, and accelerations are interpolated there.
    """
    imu, captured_ns, samples = about.imus[number], about.values[f"imu{number}_times_ns"], about.values[f"imu{number}"]
    recording.check_order(f"samples of {imu.label}", captured_ns)
    if not np.isfinite(samples).all():
        raise InvalidInput(f"a sample of {imu.label} of {recording.name} is not finite", "correct the recording")
    name, total = f"imu{number}", len(captured_ns) + imu.invalid
    if imu.invalid:
        notes.append(Loss(imu.invalid, total, f"{imu.invalid} of {total} samples of {imu.label} are marked invalid"))
    if len(captured_ns) < 2:
        notes.append(f"{imu.label} has {plural(len(captured_ns), 'valid sample')}, and is left out")
        return None
    gyro_ns, force_ns = round(imu.gyro_offset_s * NS_PER_S), round(imu.force_offset_s * NS_PER_S)
    words = f"{name} is {imu.label}, corrected by the calibration of the factory"
    if gyro_ns or force_ns:
        words += f"; its angular rates are {gyro_ns / 1e6:.3g} ms late, its accelerations {force_ns / 1e6:.3g} ms"
    notes.append(f"{words}; its noise is not in the file")
    times_ns = captured_ns - gyro_ns
    if gyro_ns != force_ns:
        # Numbers near zero keep all their digits in floating point.
        at_s, known_s = ((times - captured_ns[0]) / NS_PER_S for times in (times_ns, captured_ns - force_ns))
        inside = (at_s >= known_s[0]) & (at_s <= known_s[-1])
        forces = [np.interp(at_s[inside], known_s, samples[:, axis]) for axis in (3, 4, 5)]
        times_ns, samples = times_ns[inside], np.column_stack([samples[inside, :3], *forces])
    topic = "/imu" if number == 0 else f"/imu{number}"
    return imu_stream(Sensor(name, SensorKind.IMU, topic, rate_hz(times_ns), imu.T_device_sensor), times_ns, samples)


def _truth(path: Path, notes: list[str]) -> PlannedTruth:
    """The poses of the device in the largest map; raises InvalidInput naming the line and the remedy."""
    positions = ("tx_world_device", "ty_world_device", "tz_world_device")
    quats = ("qx_world_device", "qy_world_device", "qz_world_device", "qw_world_device")
    gravity = ("gravity_x_world", "gravity_y_world", "gravity_z_world")
    needed = ("graph_uid", "tracking_timestamp_us", *positions, *quats, *gravity)
    maps: list[str] = []
    rows: list[list[float]] = []
    reader = csv.DictReader(io.StringIO(read_bounded(path).decode("utf-8", errors="replace"), newline=""))
    lacking = [name for name in needed if name not in (reader.fieldnames or ())]
    if lacking:
        raise InvalidInput(f"{path} lacks the columns {', '.join(lacking)}", f"give a {_TRAJECTORY} of Aria's MPS")
    try:
        for row in reader:
            rows.append([float(row[name]) for name in needed[1:]])
            maps.append(row["graph_uid"])
    except (TypeError, ValueError, csv.Error):
        raise InvalidInput(f"{path}:{reader.line_num}: a value is no number", "copy the file again") from None
    if not rows:
        raise InvalidInput(f"{path} has no poses", "give the trajectory of the recording")
    sizes = Counter(maps)
    largest = sizes.most_common(1)[0][0]
    if len(sizes) > 1:
        notes.append(
            f"{len(rows) - sizes[largest]} of {len(rows)} poses are in {len(sizes) - 1} other maps than the largest "
            "one, and left out of the ground truth"
        )
    kept = np.flatnonzero([uid == largest for uid in maps])
    table = np.array(rows)[kept]
    times_s, positions_m, quats_xyzw, down = table[:, 0] / 1e6, table[:, 1:4], table[:, 4:8], table[:, 8:]
    problem = find_problem(times_s, positions_m, quats_xyzw)
    if problem is not None:
        raise InvalidInput(f"{path}:{kept[problem.index] + 2}: {problem.found}", problem.remedy)
    unit = quats_xyzw / np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    lengths = np.linalg.norm(down, axis=1, keepdims=True)
    aligned = bool(lengths.min() > 0 and np.allclose(down / np.where(lengths > 0, lengths, 1.0), _DOWN, atol=1e-3))
    return PlannedTruth(times_s, positions_m, unit, gravity_aligned=aligned, source="Aria MPS, closed loop")
