"""Streams of LiDAR scans that lie in one file each, named by their timestamps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from slamhive.bags.bag_writer import BagWriter
from slamhive.bags.geometry import Array
from slamhive.bags.importing import Stream
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput
from slamhive.files import visible_files

_OVERHEAD_BYTES = 1000
_MOST_NS = 2**31 * 10**9
_REMEDY = "copy or download the file again"


def timed_files(folder: Path, suffix: str, ns_per_unit: int) -> tuple[Array, list[Path]]:
    """The files of ``folder`` in the order of the whole numbers that name them.

    Returns:
        Their times in ns, int64 (n,), and the files.

    Raises:
        InvalidInput: A name is no timestamp, or there are fewer than two files.
    """
    found: dict[int, Path] = {}
    for path in visible_files(folder, f"*{suffix}"):
        if not (path.stem.isascii() and path.stem.isdigit()) or int(path.stem) * ns_per_unit >= _MOST_NS:
            raise InvalidInput(f"{path} is not named by a timestamp", "remove the file, or give it its name again")
        found[int(path.stem) * ns_per_unit] = path
    if len(found) < 2:
        raise InvalidInput(f"{folder} has {len(found)} files *{suffix}", "two are needed at least")
    times = sorted(found)
    return np.array(times, dtype=np.int64), [found[time] for time in times]


def point_stream(
    sensor: Sensor, times_ns: Array, paths: list[Path], read: Callable[[Path], Array], point_bytes: float
) -> Stream:
    """The messages of a LiDAR; ``read`` gives a structured array, ``point_bytes`` is its size per byte of a file."""

    def write(bag: BagWriter, index: int) -> None:
        stamp_ns = int(times_ns[index])
        bag.points(sensor, stamp_ns, stamp_ns, read(paths[index]))

    size = sum(path.stat().st_size for path in paths) / len(paths)
    return Stream(sensor, times_ns, write, int(size * point_bytes) + _OVERHEAD_BYTES)


def read_records(path: Path, record: np.dtype[np.void]) -> Array:
    """The records of a binary file; raises InvalidInput unless it holds a whole number of them, one at least."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"{path} cannot be read: {error.strerror}", _REMEDY) from None
    if not data or len(data) % record.itemsize:
        names = ", ".join(record.names or ())
        raise InvalidInput(f"{path} has {len(data)} bytes, not a multiple of {record.itemsize} ({names})", _REMEDY)
    records: Array = np.frombuffer(data, dtype=record)
    return records
