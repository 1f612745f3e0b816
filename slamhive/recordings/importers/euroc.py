"""Importer of the ASL layout of EuRoC (Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016).

TUM-VI's export in this layout (Schubert et al., "The TUM VI benchmark", IROS 2018) has fisheye cameras and ``mocap0``.
The Monado SLAM datasets (de Mayo et al., 2025) have ``gt``, and one calibration of Basalt's instead of ``sensor.yaml``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import COEFFICIENTS, CameraIntrinsics, CameraModel, ImuNoise
from slamhive.domain.sensors import IDENTITY4, Matrix4, Sensor, SensorKind
from slamhive.recordings.geometry import flat
from slamhive.recordings.importers.calibration import (
    CalibrationFile,
    FrameGraph,
    KnownCalibration,
    read_calibration_file,
    read_calibrations,
    time_offset,
    unread_keys,
)
from slamhive.recordings.importing import (
    DatasetText,
    Detection,
    ImportOptions,
    ImportPlan,
    PlannedStream,
    PlannedTruth,
    matched_truth,
    of_body,
    rate_hz,
    tum_truth,
)
from slamhive.recordings.streams import image_stream, imu_stream
from slamhive.recordings.text_lists import TimedList, listed_truth, read_timed_list
from slamhive.trajectory.layout import TimeUnit

ROOT, LIST, SENSOR_FILE = "mav0", "data.csv", "sensor.yaml"
_WHOLE_CALIBRATION = "calibration.json"
_ESTIMATE = "state_groundtruth_estimate0"
_MEASURED = {
    "vicon0": "motion capture (Vicon)",
    "mocap0": "motion capture (OptiTrack)",
    "leica0": "laser tracker (Leica MS50)",
    "gt": "tracking of the headset",
}
_SENSOR_KEYS = frozenset({"sensor_type", "comment", "T_BS", "rate_hz"})
_CAMERA_KEYS = _SENSOR_KEYS | {
    *("resolution", "camera_model", "intrinsics", "distortion_model", "distortion_coefficients", "timeshift_cam_imu")
}
_IMU_KEYS = _SENSOR_KEYS | frozenset(ImuNoise.__slots__)
_POSE = "timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z"
_MODELS = {
    "radial-tangential": CameraModel.PINHOLE_RADTAN,
    "radtan": CameraModel.PINHOLE_RADTAN,
    "equidistant": CameraModel.FISHEYE_KB,
}


@dataclass(frozen=True)
class _Part:
    """A folder of the layout: its list and its calibration."""

    folder: Path

    @property
    def name(self) -> str:
        return self.folder.name

    def calibration(self) -> CalibrationFile:
        return read_calibration_file(self.folder / SENSOR_FILE)

    def rows(self, layout: str) -> TimedList:
        return read_timed_list(self.folder / LIST, layout, TimeUnit.NS, columns=layout.count(",") + 1)


class EurocImporter:
    """Grey images, IMU samples and poses to a dataset. The body frame is that of the IMU.

    Of several ground truths, the estimate of the authors is taken: ``state_groundtruth_estimate0``. A laser tracker
    measures the positions of its prism, which are kept as they are, with its lever arm.
    """

    title = "EuRoC (ASL) folder: mav0 with cam0, imu0 and others, each with data.csv and sensor.yaml"
    options = frozenset({"calibration", "groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The parts of ``mav0``, given itself or its parent."""
        root = _root(path)
        found = [f"{name}/{LIST}" for name in ("cam0", "imu0", *_truths()) if (root / name / LIST).is_file()]
        return Detection(tuple(found), () if f"cam0/{LIST}" in found else (f"cam0/{LIST}",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the folder; raises InvalidInput naming the file, the line or key, and the remedy."""
        root = _root(source)
        cameras = [_Part(folder) for folder in sorted(root.glob("cam[0-9]")) if folder.is_dir()]
        if not cameras:
            raise InvalidInput(f"{source} is no EuRoC folder: it lacks cam0", "give the folder that contains mav0")
        streams: list[PlannedStream] = []
        notes: list[str] = []
        known = _known(source, root, options)
        notes.extend(known.notes)
        for camera in cameras:
            stream, remarks = _camera_stream(camera, known)
            streams.append(stream)
            notes.extend(remarks)
        if (root / "imu0").is_dir():
            part = _Part(root / "imu0")
            rows = part.rows("timestamp [ns], w_x, w_y, w_z [rad/s], a_x, a_y, a_z [m/s^2]")
            noise, T_body_imu, unread = _imu(part, known)
            notes.extend(unread)
            sensor = Sensor(
                part.name, SensorKind.IMU, f"/{part.name}", rate_hz(rows.times_ns), T_body_imu, noise.calibration()
            )
            stream, remarks = imu_stream(sensor, rows.times_ns, rows.numbers(0, 6)), rows.notes()
            streams.append(stream)
            notes.extend(remarks)
        truth, remarks = _truth(root, options)
        fisheye = any(stream.sensor.calibration.get("model") == CameraModel.FISHEYE_KB for stream in streams)
        return ImportPlan(
            tuple(streams),
            truth,
            _text(source, tum_vi=fisheye and (root / "mocap0").is_dir(), monado=(root / "gt").is_dir()),
            notes=(*notes, *remarks, *matched_truth(truth, streams)),
        )


def _root(path: Path) -> Path:
    return path / ROOT if (path / ROOT).is_dir() else path


def _truths() -> tuple[str, ...]:
    return (_ESTIMATE, *_MEASURED)


def _known(source: Path, root: Path, options: ImportOptions) -> KnownCalibration:
    """Calibration that replaces the ``sensor.yaml`` of each part: that of the user, or that of the dataset."""
    beside = [folder / _WHOLE_CALIBRATION for folder in dict.fromkeys((source, root, root.parent))]
    return read_calibrations(options.calibration or [path for path in beside if path.is_file()][:1])


def _imu(part: _Part, known: KnownCalibration) -> tuple[ImuNoise, Matrix4, list[str]]:
    """The noise of the IMU, its pose relative to the body, and a note on what is not read."""
    found = next((sensor.noise for sensor in known.sensors if sensor.name == part.name and sensor.noise), None)
    if found is not None:
        return found, IDENTITY4, []
    calibration = part.calibration()
    noise = ImuNoise(**{key: calibration.optional(key) for key in ImuNoise.__slots__})
    return noise, flat(calibration.rigid("T_BS")), unread_keys(calibration, _IMU_KEYS, f"{part.name}/{SENSOR_FILE}")


def _camera_stream(part: _Part, known: KnownCalibration) -> tuple[PlannedStream, tuple[str, ...]]:
    rows = part.rows("timestamp [ns], filename")
    kept, paths = rows.files(part.folder / "data")
    found = next((sensor for sensor in known.sensors if sensor.name == part.name and sensor.intrinsics), None)
    unread: list[str] = []
    if found is None:
        own = part.calibration()
        sensor = camera_sensor(part.name, own, rate_hz(kept.times_ns))
        unread = unread_keys(own, _CAMERA_KEYS, f"{part.name}/{SENSOR_FILE}")
    else:
        graph = FrameGraph()
        for parent, child, T in known.transforms:
            graph.add(parent, child, T)
        T_body_camera = graph.find("imu0", found.frame)
        if T_body_camera is None:
            raise InvalidInput(
                f"the calibration of {part.name} does not say where it is relative to imu0", "calibrate both together"
            )
        assert found.intrinsics is not None
        calibration = {**found.intrinsics.calibration("mono8"), **found.more}
        matrix = flat(T_body_camera)
        topic = f"/{part.name}/image_raw"
        sensor = Sensor(part.name, SensorKind.CAMERA, topic, rate_hz(kept.times_ns), matrix, calibration)
    return image_stream(sensor, kept.times_ns, paths), (*rows.notes(kept), *unread)


def camera_sensor(name: str, calibration: CalibrationFile, rate: float) -> Sensor:
    """The camera that a ``sensor.yaml`` describes, its images grey; raises InvalidInput."""
    model_name = calibration.word("distortion_model")
    if calibration.word("camera_model") != "pinhole" or model_name not in _MODELS:
        found = f"{calibration.word('camera_model')} with {model_name}"
        raise InvalidInput(
            f"{calibration.name}: camera model {found} is unknown", f"use pinhole with {' or '.join(_MODELS)}"
        )
    model = _MODELS[model_name]
    width, height = calibration.size("resolution")
    fx, fy, cx, cy = calibration.numbers("intrinsics", 4)
    if min(fx, fy) <= 0:
        raise InvalidInput(f"{calibration.name}: focal lengths are {fx:g}, {fy:g}", "expected numbers above 0")
    distortion = calibration.numbers("distortion_coefficients", *COEFFICIENTS[model])
    intrinsics = CameraIntrinsics(width, height, fx, fy, cx, cy, model, distortion)
    return Sensor(
        name,
        SensorKind.CAMERA,
        f"/{name}/image_raw",
        rate,
        flat(calibration.rigid("T_BS")),
        {**intrinsics.calibration("mono8"), **time_offset(calibration)},
    )


def _truth(root: Path, options: ImportOptions) -> tuple[PlannedTruth | None, tuple[str, ...]]:
    present = [name for name in _truths() if (root / name / LIST).is_file()]
    if options.groundtruth is not None:
        others = f"; {', '.join(present)} of the folder is left out" if present else ""
        truth = tum_truth(options.groundtruth, "", gravity_aligned=True)
        return truth, (f"ground truth is {options.groundtruth}{others}",)
    if not present:
        return None, ()
    if present[0] != _ESTIMATE and len(present) > 1:
        raise InvalidInput(
            f"{root} has several ground truths: {', '.join(present)}", "give the right one with --groundtruth FILE"
        )
    left_out = (f"ground truth is {present[0]}; {', '.join(present[1:])} is left out",) if present[1:] else ()
    part = _Part(root / present[0])
    if part.name == _ESTIMATE:
        measured = "motion capture or laser tracker, with the IMU, by the authors' estimator"
        return _poses(part, measured), left_out
    if part.name == "leica0":
        rows = part.rows("timestamp [ns], p_x, p_y, p_z")
        truth = listed_truth(rows, None, _MEASURED[part.name], gravity_aligned=True)
        arm_m = tuple(float(number) for number in part.calibration().rigid("T_BS")[:3, 3])
        note = f"ground truth is the positions of a prism, {np.linalg.norm(arm_m):.3f} m from the body (lever_arm_m)"
        return replace(truth, lever_arm_m=arm_m), (*left_out, note)
    # Poses of the markers; TUM-VI, which has no ``sensor.yaml`` here, states them for the IMU.
    truth = _poses(part, _MEASURED[part.name])
    if not (part.folder / SENSOR_FILE).is_file():
        return truth, (*left_out, f"{part.name} has no {SENSOR_FILE}: its poses are taken as those of the IMU")
    return of_body(truth, np.linalg.inv(part.calibration().rigid("T_BS"))), left_out


def _poses(part: _Part, source: str) -> PlannedTruth:
    rows = part.rows(_POSE)
    return listed_truth(rows, np.roll(rows.numbers(3, 4), -1, axis=1), source, gravity_aligned=True)


def _text(source: Path, *, tum_vi: bool, monado: bool) -> DatasetText:
    resolved = source.resolve()
    name = resolved.parent.name if resolved.name == ROOT else resolved.name
    if tum_vi:
        return DatasetText(
            title=f"TUM VI, {name}",
            description="Fisheye stereo and IMU; the body is the IMU.",
            licence="CC BY 4.0",
            citation="Schubert et al.: The TUM VI benchmark for evaluating visual-inertial odometry. IROS 2018",
            source="https://cvg.cit.tum.de/data/datasets/visual-inertial-dataset",
            attributes=("real", "handheld"),
        )
    if monado:
        return DatasetText(
            title=f"Monado SLAM, {name}",
            description="Cameras and IMU of a headset; the body is the IMU.",
            licence="CC BY 4.0",
            citation="de Mayo, Cremers, Pire: The Monado SLAM dataset for egocentric visual-inertial tracking. 2025",
            source="https://huggingface.co/datasets/collabora/monado-slam-datasets",
            attributes=("real", "indoor", "handheld"),
        )
    return DatasetText(
        title=f"EuRoC, {name}",
        description="Cameras and IMU of a micro aerial vehicle; the body is the IMU.",
        licence="see the terms of ETH Zürich's Autonomous Systems Lab",
        citation="Burri et al.: The EuRoC micro aerial vehicle datasets. IJRR 2016",
        source="https://projects.asl.ethz.ch/datasets/euroc-mav",
        attributes=("real", "indoor", "drone"),
    )
