"""The process that reads sequences with evalio (https://github.com/contagon/evalio), in an environment of its own.

evalio brings 500 MB of pipelines and tools. Data comes through a pipe, one scan at a time.
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

from slamhive.bags.formats.evalio_reader import POINT, SCAN_HEADER
from slamhive.bags.geometry import Array
from slamhive.errors import InvalidInput, Unavailable

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
    """What the reader says of a sequence. ``values`` are the arrays, by the names in :data:`_ARRAYS`."""

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
        """What the sequence is, and everything but its scans; reads all measurements once.

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
    """Whether the process has written everything, and ended with an error."""
    assert process.stdout is not None
    return not process.stdout.read(1) and process.wait() != 0


def _last_line(words: IO[bytes]) -> str:
    words.seek(0)
    lines = [line.strip() for line in words.read().decode(errors="replace").splitlines() if line.strip()]
    return lines[-1][:_SHOWN] if lines else "it gave no reason"
