"""Importer of all datasets that evalio reads: LiDAR and IMU, with ground truth, and those that users registered there.

evalio 0.6.1 (https://github.com/contagon/evalio, MIT) has 12 datasets with 113 sequences. It orders points by rows.
Timestamps of its scans are their starts, from which the times of points count. The body is the IMU.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt

from slamhive.base.errors import InvalidInput, Unavailable
from slamhive.domain.calibration import ImuNoise, LidarLayout, PointOrder
from slamhive.domain.sensors import Sensor, SensorKind, is_rigid
from slamhive.recordings.geometry import Array
from slamhive.recordings.importers.evalio_reader import POINT, SCAN_HEADER
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
from slamhive.recordings.streams import imu_stream
from slamhive.recordings.writers import NS_PER_S, BagWriter
from slamhive.runtime.point_times import PointTimes
from slamhive.trajectory.model import find_problem

# The process that reads sequences with evalio (https://github.com/contagon/evalio), in an environment of its own.
#
# evalio brings 500 MB of pipelines and tools. Data comes through a pipe, one scan at a time.


PYTHON_VARIABLE = "SLAMHIVE_EVALIO_PYTHON"
_READER = Path(__file__).with_name("evalio_reader.py")
_MOST_POINTS = 4_000_000
_MOST_ARRAY_BYTES = 200_000_000
_MOST_LINE_BYTES = 100_000
_ARRAYS = {"scan_times_ns": 1, "imu_times_ns": 1, "imu": 6, "truth_times_ns": 1, "truth": 7}
"""The arrays that the reader writes, and their columns."""
_SHOWN = 300


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


class EvalioPlan(BaseModel):
    """Answer of the reader about a sequence. ``values`` are the arrays, by the names in :data:`_ARRAYS`."""

    model_config = ConfigDict(arbitrary_types_allowed=True)
    name: str
    url: str
    environment: str
    vehicle: str
    T_imu_lidar: tuple[FiniteFloat, ...]
    lidar: LidarNumbers
    imu: ImuNumbers
    arrays: list[tuple[str, Literal["<i8", "<f8"], tuple[NonNegativeInt, ...]]]
    values: dict[str, Any] = Field(default_factory=dict, exclude=True)

    @property
    def complete(self) -> bool:
        """All arrays are there, with their columns, and a row for each time."""
        columns = {name: 1 if values.ndim == 1 else values.shape[-1] for name, values in self.values.items()}
        pairs = (("imu_times_ns", "imu"), ("truth_times_ns", "truth"))
        return columns == _ARRAYS and all(len(self.values[times]) == len(self.values[rows]) for times, rows in pairs)


@dataclass(frozen=True)
class EvalioSequence:
    """A sequence that evalio can read: the folder of all its data, and ``dataset/sequence``."""

    data: Path
    name: str

    def plan(self) -> EvalioPlan:
        """The sequence without its scans; reads all measurements once.

        Raises:
            Unavailable: There is no environment with evalio.
            InvalidInput: evalio does not know the sequence, or cannot read it.
        """
        with self._reading("plan") as stream:
            try:
                about = EvalioPlan.model_validate_json(stream.readline(_MOST_LINE_BYTES))
                for name, kind, shape in about.arrays:
                    about.values[name] = _array(stream, kind, shape)
            except (ValueError, EOFError):
                raise self._broken() from None
        if not about.complete:
            raise self._broken()
        return about

    def scans(self) -> Iterator[tuple[int, Array]]:
        """Time in ns and points of each scan, a structured array of :data:`~.evalio_reader.POINT`."""
        with self._reading("scans") as stream:
            while header := stream.read(SCAN_HEADER.size):
                if len(header) < SCAN_HEADER.size:
                    raise self._broken()
                time_ns, count = SCAN_HEADER.unpack(header)
                if count > _MOST_POINTS:
                    raise InvalidInput(f"a scan of {self.name} has {count} points", f"at most {_MOST_POINTS} are read")
                data = stream.read(count * POINT.itemsize)
                if len(data) < count * POINT.itemsize:
                    raise self._broken()
                points: Array = np.frombuffer(data, dtype=POINT)
                yield time_ns, points

    @contextmanager
    def _reading(self, mode: str) -> Iterator[IO[bytes]]:
        """The output of the reader, which ends with the block; its last words are the error if it fails."""
        # -P: the folder of the reader has a module evalio of its own, which must not come first.
        command = [str(evalio_python()), "-P", str(_READER), mode, str(self.data), self.name]
        with tempfile.TemporaryFile() as words:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=words)
            assert process.stdout is not None
            try:
                yield process.stdout
                _failed_at_end(process)
            except InvalidInput:
                if not _failed_at_end(process):
                    raise
            finally:
                process.stdout.close()
                process.kill()
                process.wait()
            if process.returncode > 0:
                raise InvalidInput(f"evalio cannot read {self.name}: {_last_line(words)}", _REMEDY)

    def _broken(self) -> InvalidInput:
        return InvalidInput(f"evalio stopped while it read {self.name}", _REMEDY)


_REMEDY = "see whether evalio itself can read the sequence"


def evalio_python() -> Path:
    """The interpreter that has evalio; raises Unavailable if none is known."""
    named = os.environ.get(PYTHON_VARIABLE)
    if named:
        if not Path(named).is_file():
            raise Unavailable(f"{PYTHON_VARIABLE} names {named}, which does not exist", "correct the variable")
        return Path(named)
    if find_spec("evalio") is not None:
        return Path(sys.executable)
    raise Unavailable(
        "no environment with evalio is known",
        f"make one (python3 -m venv evalio && evalio/bin/pip install evalio), and set {PYTHON_VARIABLE} to its python",
    )


def _array(stream: IO[bytes], kind: str, shape: tuple[int, ...]) -> Array:
    dtype = np.dtype(kind)
    size = math.prod(shape) * dtype.itemsize
    if size > _MOST_ARRAY_BYTES:
        raise ValueError(f"an array of {size} bytes")
    data = stream.read(size)
    if len(data) < size:
        raise EOFError
    values: Array = np.frombuffer(data, dtype=dtype).reshape(shape)
    return values


def _failed_at_end(process: subprocess.Popen[bytes]) -> bool:
    """Tell if the process has written everything, and ended with an error."""
    assert process.stdout is not None
    return not process.stdout.read(1) and process.wait() != 0


def _last_line(words: IO[bytes]) -> str:
    words.seek(0)
    lines = [line.strip() for line in words.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1][:_SHOWN] if lines else "it gave no reason"


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
        """Plan the import of the sequence; raises InvalidInput with evalio's reason, Unavailable without evalio."""
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


def _lidar(sequence: EvalioSequence, about: EvalioPlan) -> PlannedStream:
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
    return PlannedStream(sensor, times_ns, write, points * POINT.itemsize + _OVERHEAD_BYTES)


def _imu(about: EvalioPlan) -> PlannedStream:
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
