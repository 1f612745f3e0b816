"""Importer of all datasets that evalio reads: LiDAR and IMU, with ground truth, and those that users registered there.

evalio 0.6.1 (https://github.com/contagon/evalio, MIT) has 12 datasets with 113 sequences. It orders points by rows.
Timestamps of its scans are their starts, from which the times of points count. The body is the IMU.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slamhive.bags.bag_writer import NS_PER_S, BagWriter
from slamhive.bags.detection import Detection
from slamhive.bags.formats.evalio_process import EvalioPlan, EvalioSequence
from slamhive.bags.formats.evalio_reader import POINT
from slamhive.bags.geometry import Array
from slamhive.bags.ground_truth import matched_truth
from slamhive.bags.importing import DatasetText, ImportOptions, ImportPlan, PlannedTruth, Stream, rate_hz
from slamhive.bags.imu_stream import imu_stream
from slamhive.domain.calibration import ImuNoise
from slamhive.domain.lidar_layout import LidarLayout, PointOrder
from slamhive.domain.sensors import Sensor, SensorKind, is_rigid
from slamhive.errors import InvalidInput
from slamhive.runtime.point_times import PointTimes
from slamhive.trajectory.model import find_problem

DATASETS = (
    "boreas", "boreas_rt", "botanic_garden", "cumulti", "enwide", "fomo", "helipr", "hilti_2022", "multi_campus",
    "newer_college_2020", "newer_college_2021", "oxford_spires",
)  # fmt: skip
"""The folders in which evalio keeps its datasets; those that users registered need ``--format evalio``."""
_OVERHEAD_BYTES = 1000
_MOST_NS = 2**31 * NS_PER_S


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
        """What the sequence becomes; raises InvalidInput with evalio's reason, Unavailable without evalio."""
        sequence = _sequence(source, options.sequence)
        about = sequence.plan()
        streams = [_lidar(sequence, about)]
        if len(about.values["imu_times_ns"]):
            streams.append(_imu(about))
        truth = _truth(about)
        return ImportPlan(tuple(streams), truth, _text(about), notes=matched_truth(truth, streams))


def _sequence(source: Path, name: str | None) -> EvalioSequence:
    if name is not None:
        return EvalioSequence(source, name)
    folder = source.absolute()
    return EvalioSequence(folder.parent.parent, f"{folder.parent.name}/{folder.name}")


def _lidar(sequence: EvalioSequence, about: EvalioPlan) -> Stream:
    parameters, times_ns = about.lidar, about.values["scan_times_ns"]
    if not is_rigid(about.T_imu_lidar):
        raise InvalidInput(f"evalio's pose of the LiDAR of {about.name} is not rigid", "correct imu_T_lidar")
    _check_order(about, "scans", times_ns)
    layout = LidarLayout(
        PointTimes(1.0 / parameters.rate, "time"),
        ring_field="ring",
        point_order=PointOrder.ROWS,
        beams=parameters.num_rows,
        minimum_range_m=parameters.min_range,
        maximum_range_m=parameters.max_range,
    )
    sensor = Sensor("lidar0", SensorKind.LIDAR, "/points", rate_hz(times_ns), about.T_imu_lidar, layout.calibration())
    reading: list[Iterator[tuple[int, Array]]] = []

    def write(bag: BagWriter, index: int) -> None:
        if index == 0:
            reading[:] = [sequence.scans()]
        scan, expected_ns = next(reading[0], None), int(times_ns[index])
        if scan is None or scan[0] != expected_ns:
            raise InvalidInput(f"scan {index} of {about.name} is another when read again", "import again")
        bag.points(sensor, expected_ns, expected_ns, scan[1])

    points = parameters.num_rows * parameters.num_columns
    return Stream(sensor, times_ns, write, points * POINT.itemsize + _OVERHEAD_BYTES)


def _imu(about: EvalioPlan) -> Stream:
    times_ns, samples, noise = about.values["imu_times_ns"], about.values["imu"], about.imu
    _check_order(about, "IMU samples", times_ns)
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


def _check_order(about: EvalioPlan, what: str, times_ns: Array) -> None:
    if len(times_ns) and (times_ns[0] < 0 or times_ns[-1] >= _MOST_NS or (np.diff(times_ns) <= 0).any()):
        raise InvalidInput(f"the timestamps of the {what} of {about.name} do not increase", "correct the sequence")


def _text(about: EvalioPlan) -> DatasetText:
    words = ", ".join(word for word in (about.environment, about.vehicle) if word != "-")
    return DatasetText(
        title=f"{about.name} (evalio)",
        description=f"Read with evalio{': ' if words else ''}{words}. The body is the IMU.",
        source="" if about.url == "-" else about.url,
        attributes=("real",),
    )
