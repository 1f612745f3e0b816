"""Importers of LiDAR recordings that a library in an environment of its own reads: those of evalio, and Ouster's.

evalio 0.6.1 (https://github.com/contagon/evalio, MIT) has 12 datasets with 113 sequences, and those that users
registered there. It orders points by rows. Timestamps of its scans are their starts, from which the times of points
count. The body is the IMU.

ouster-sdk 1.0.1 (https://github.com/ouster-lidar/ouster-sdk, BSD-3-Clause) reads OSF files and captures of packets. The
body is the frame that the file places its sensors in. Points are in the Sensor Coordinate Frame of their LiDAR.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, NonNegativeInt

from slamhive.base.errors import InvalidInput
from slamhive.base.files import visible_files
from slamhive.domain.calibration import ImuNoise, LidarLayout, PointOrder, Rotation
from slamhive.domain.sensors import Sensor, SensorKind, is_rigid
from slamhive.recordings.geometry import Array, flat
from slamhive.recordings.importers.outside import Library, OutsidePlan, OutsideRecording
from slamhive.recordings.importers.outside_reader import POINT
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
    tum_truth,
)
from slamhive.recordings.streams import imu_stream
from slamhive.recordings.writers import NS_PER_S, BagWriter
from slamhive.runtime.point_times import PointTimes
from slamhive.trajectory.model import find_problem

EVALIO = Library("evalio", "evalio", "evalio")
OUSTER = Library("ouster", "ouster", "ouster-sdk")


class LidarNumbers(BaseModel):
    """``LidarParams`` of evalio: rings, columns, m, Hz."""

    num_rows: int = Field(gt=0, le=10_000)
    num_columns: int = Field(gt=0, le=100_000)
    min_range: FiniteFloat
    max_range: FiniteFloat
    rate: FiniteFloat = Field(gt=0)


class ImuNumbers(BaseModel):
    """``ImuParams`` of evalio: densities of noise and of the drift of biases, SI units."""

    gyro: FiniteFloat
    accel: FiniteFloat
    gyro_bias: FiniteFloat
    accel_bias: FiniteFloat


class EvalioPlan(OutsidePlan):
    """Answer of the reader about a sequence of evalio."""

    name: str
    url: str
    environment: str
    vehicle: str
    T_imu_lidar: tuple[FiniteFloat, ...]
    lidar: LidarNumbers
    imu: ImuNumbers

    @property
    def columns(self) -> dict[str, int]:
        """The arrays of each answer."""
        return {"scan_times_ns": 1, "imu_times_ns": 1, "imu": 6, "truth_times_ns": 1, "truth": 7}


DATASETS = (
    "boreas", "boreas_rt", "botanic_garden", "cumulti", "enwide", "fomo", "helipr", "hilti_2022", "multi_campus",
    "newer_college_2020", "newer_college_2021", "oxford_spires",
)  # fmt: skip
"""The folders in which evalio keeps its datasets; those that users registered need ``--format evalio``."""
_OVERHEAD_BYTES = 1000


class EvalioImporter:
    """Scans, IMU samples and ground truth of one sequence to a dataset.

    The source is the folder of a sequence, ``<data>/<dataset>/<sequence>``, or ``<data>`` with ``--sequence
    <dataset>/<sequence>``. ``EVALIO_CUSTOM`` names modules with datasets of users, as for evalio itself. All
    measurements are read twice: for their times first, then for the recording.
    """

    title = "sequence of a dataset that evalio reads: <data>/<dataset>/<sequence>"
    options = frozenset({"sequence"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """The folder of a sequence below that of a dataset of evalio."""
        dataset = path.absolute().parent.name
        if path.is_dir() and dataset in DATASETS:
            return Detection((f"a folder in {dataset}",), ())
        return Detection((), ("a folder <data>/<dataset>/<sequence> of evalio",))

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the sequence; raises InvalidInput with evalio's reason, Unavailable without evalio."""
        folder, name = source, options.sequence
        if name is None:
            folder, name = source.absolute().parent.parent, "/".join(source.absolute().parts[-2:])
        sequence = OutsideRecording(EVALIO, folder, name)
        about = sequence.plan(EvalioPlan, name)
        sequence.check_order("scans", about.values["scan_times_ns"])
        sequence.check_order("IMU samples", about.values["imu_times_ns"])
        streams = [_lidar(sequence, about)]
        if len(about.values["imu_times_ns"]):
            streams.append(_imu(about))
        truth = _truth(about)
        return ImportPlan(tuple(streams), truth, _text(about), notes=matched_truth(truth, streams))


def _lidar(sequence: OutsideRecording, about: EvalioPlan) -> PlannedStream:
    parameters, times_ns = about.lidar, about.values["scan_times_ns"]
    if not is_rigid(about.T_imu_lidar):
        raise InvalidInput(f"evalio's pose of the LiDAR of {about.name} is not rigid", "correct imu_T_lidar")
    layout = LidarLayout(
        PointTimes(1.0 / parameters.rate, "time"),
        ring_field="ring",
        point_order=PointOrder.ROWS,
        beams=parameters.num_rows,
        minimum_range_m=parameters.min_range,
        maximum_range_m=parameters.max_range,
    )
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/points", rate_hz(times_ns), about.T_imu_lidar, layout.calibration())
    points = parameters.num_rows * parameters.num_columns
    return _scan_stream(sequence, sequence.name, sensor, times_ns, points)


def _imu(about: EvalioPlan) -> PlannedStream:
    times_ns, samples, noise = about.values["imu_times_ns"], about.values["imu"], about.imu
    if not np.isfinite(samples).all():
        raise InvalidInput(f"an IMU sample of {about.name} is not finite", "correct the sequence")
    known = ImuNoise(noise.gyro, noise.accel, noise.gyro_bias, noise.accel_bias)
    sensor = Sensor("imu0", SensorKind.IMU, "/imu", rate_hz(times_ns), calibration=known.calibration())
    return imu_stream(sensor, times_ns, samples)


def _truth(about: EvalioPlan) -> PlannedTruth | None:
    """The poses of the IMU; evalio does not say whether the z axis of their world points up."""
    poses = about.values["truth"]
    if not len(poses):
        return None
    times_s, positions_m, quats_xyzw = about.values["truth_times_ns"] / NS_PER_S, poses[:, :3], poses[:, 3:]
    problem = find_problem(times_s, positions_m, quats_xyzw)
    if problem is not None:
        raise InvalidInput(f"ground truth of {about.name}, pose {problem.index + 1}: {problem.found}", problem.remedy)
    unit = quats_xyzw / np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    return PlannedTruth(times_s, positions_m, unit, gravity_aligned=False, source="evalio")


def _text(about: EvalioPlan) -> DatasetText:
    words = ", ".join(word for word in (about.environment, about.vehicle) if word != "-")
    return DatasetText(
        title=f"{about.name} (evalio)",
        description=f"Read with evalio{': ' if words else ''}{words}. The body is the IMU.",
        source="" if about.url == "-" else about.url,
        attributes=("real",),
    )


def _scan_stream(recording: OutsideRecording, part: str, sensor: Sensor, times_ns: Array, points: int) -> PlannedStream:
    """The scans of a LiDAR, of at most ``points`` points, which are read again while the recording is written."""
    reading: list[Iterator[tuple[int, Array]]] = []

    def write(bag: BagWriter, index: int) -> None:
        if index == 0:
            reading[:] = [recording.records(part, POINT)]
        scan, expected_ns = next(reading[0], None), int(times_ns[index])
        if scan is None or scan[0] != expected_ns:
            raise InvalidInput(f"scan {index} of {recording.name} is another when read again", "import again")
        bag.points(sensor, expected_ns, expected_ns, scan[1])

    return PlannedStream(sensor, times_ns, write, points * POINT.itemsize + _OVERHEAD_BYTES)


# Ouster.


class OusterSensor(BaseModel):
    """Facts about one LiDAR of a recording; transforms by rows, in metres."""

    product: str
    serial: str
    timestamp_mode: str
    columns: int = Field(gt=0, le=100_000)
    elevations_deg: tuple[FiniteFloat, ...]
    T_body_sensor: tuple[FiniteFloat, ...]
    T_sensor_imu: tuple[FiniteFloat, ...]
    listed: NonNegativeInt | None
    partial: NonNegativeInt
    posed: bool
    second_returns: bool
    gnss: bool


class OusterPlan(OutsidePlan):
    """Answer of the reader about a recording of Ouster sensors."""

    sensors: list[OusterSensor] = Field(min_length=1, max_length=64)

    @property
    def columns(self) -> dict[str, int]:
        """Times of scans, and IMU samples with their times, for each sensor."""
        kinds = {"scan{}_times_ns": 1, "imu{}_times_ns": 1, "imu{}": 6}
        return {name.format(number): count for number in range(len(self.sensors)) for name, count in kinds.items()}


_NOT_ABSOLUTE = ("", "TIME_FROM_INTERNAL_OSC", "TIME_FROM_UNSPEC")


class OusterImporter:
    """Scans and IMU samples of all sensors of an OSF file or a capture of packets to a dataset."""

    title = "Ouster recording: an .osf file, or a .pcap file with the .json file of the sensor beside it"
    options = frozenset({"groundtruth"})
    refines: frozenset[str] = frozenset()

    def detect(self, path: Path) -> Detection:
        """An OSF file, or a capture and the description of its sensor."""
        if path.suffix == ".osf" and path.is_file():
            return Detection((f"the OSF file {path.name}",), ())
        if path.suffix != ".pcap" or not path.is_file():
            return Detection((), ("an .osf file, or a .pcap file with its .json file",))
        missing = () if visible_files(path.parent, "*.json") else ("the .json file of the sensor beside it",)
        return Detection((f"the capture {path.name}",), missing)

    def plan(self, source: Path, options: ImportOptions) -> ImportPlan:
        """Plan the import of the file; raises InvalidInput with the SDK's reason, Unavailable without the SDK."""
        lacking = self.detect(source).missing
        if lacking:
            # The SDK would take other names for those of sensors in the network, or read files of other formats.
            raise InvalidInput(f"{source} is no recording of Ouster: it lacks {', '.join(lacking)}", "add it")
        recording = OutsideRecording(OUSTER, source.absolute(), source.name)
        about = recording.plan(OusterPlan)
        streams: list[PlannedStream] = []
        imus: list[PlannedStream] = []
        notes: list[str] = []
        for number, lidar in enumerate(about.sensors):
            name = f"lidar{len(streams)}"
            words = f"{name} ({lidar.product} {lidar.serial})"
            times_ns, samples_ns = about.values[f"scan{number}_times_ns"], about.values[f"imu{number}_times_ns"]
            total = len(times_ns) if lidar.listed is None else lidar.listed
            if total > len(times_ns):
                lost = total - len(times_ns)
                reason = f"{lost} of {total} scans of {lidar.product} {lidar.serial} are damaged and left out"
                notes.append(Loss(lost, total, reason))
            if not len(times_ns):
                notes.append(f"{lidar.product} {lidar.serial} has no scans and is left out")
                continue
            recording.check_order(f"scans of {name}", times_ns)
            recording.check_order(f"IMU samples of {name}", samples_ns)
            if not is_rigid(lidar.T_body_sensor) or not is_rigid(lidar.T_sensor_imu):
                raise InvalidInput(f"{source}: the pose of {words} or of its IMU is not rigid", "correct its metadata")
            rate = rate_hz(times_ns)
            layout = LidarLayout(
                # a gap between scans makes none of them longer
                PointTimes(float(np.median(np.diff(times_ns))) / NS_PER_S, "time"),
                ring_field="ring",
                point_order=PointOrder.COLUMNS,
                beams=len(lidar.elevations_deg),
                vertical_angles_deg=lidar.elevations_deg,
                points_per_ring=lidar.columns,
                rotation=Rotation.CLOCKWISE,
            )
            topic = "/points" if name == "lidar0" else f"/points{len(streams)}"
            sensor = Sensor(name, SensorKind.LIDAR, topic, rate, lidar.T_body_sensor, layout.calibration())
            points = len(lidar.elevations_deg) * lidar.columns
            streams.append(_scan_stream(recording, str(number), sensor, times_ns, points))
            if len(samples_ns) == 1:
                notes.append(f"the IMU of {name} has a single sample, and is left out")
            elif len(samples_ns):
                samples = about.values[f"imu{number}"]
                if not np.isfinite(samples).all():
                    raise InvalidInput(f"an IMU sample of {words} is not finite", "correct the recording")
                T_body_imu = np.reshape(lidar.T_body_sensor, (4, 4)) @ np.reshape(lidar.T_sensor_imu, (4, 4))
                topic = "/imu" if not imus else f"/imu{len(imus)}"
                imu = Sensor(f"imu{len(imus)}", SensorKind.IMU, topic, rate_hz(samples_ns), flat(T_body_imu))
                imus.append(imu_stream(imu, samples_ns, samples))
            notes += [
                note
                for note, holds in {
                    f"{lidar.partial} of {len(times_ns)} scans of {name} lack columns, since packets were lost": (
                        lidar.partial > 0
                    ),
                    f"second returns of {name} are left out": lidar.second_returns,
                    f"the GNSS positions that {name} recorded are left out": lidar.gnss,
                    f"the poses of {name} in the file are an estimate, and not taken as ground truth": lidar.posed,
                    f"the timestamps of {name} count from the start of the sensor": (
                        lidar.timestamp_mode in _NOT_ABSOLUTE
                    ),
                }.items()
                if holds
            ]
        if not streams:
            raise InvalidInput(f"{source}: {'; '.join(notes)}", "copy the whole file again, or record again")
        streams += imus
        truth = None
        if options.groundtruth is not None:
            truth = tum_truth(options.groundtruth, "", gravity_aligned=False)
        text = DatasetText(
            title=f"{source.stem} (Ouster)",
            description=f"Read with ouster-sdk: {', '.join(sorted({entry.product for entry in about.sensors}))}.",
            attributes=("real",),
        )
        return ImportPlan(tuple(streams), truth, text, notes=(*notes, *matched_truth(truth, streams)))
