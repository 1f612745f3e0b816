"""A saved map for a screen: a quick sample of its points first, then at most one point in each voxel."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.evaluation.evaluators.map_quality import (
    AXES,
    MAX_HEADER_BYTES,
    PcdHeader,
    cut_off,
    malformed,
    read_compressed,
    read_header,
    read_lines,
    read_rows,
)
from slamhive.run_folder.untrusted import LONGEST_LINE_BYTES, FloatArray, open_regular_file

# Reads a saved map a piece at a time, so that memory does not grow with the map.
#
# An algorithm wrote the file: no links, and its counts are compared with its length before anything is read.


PIECE_BYTES = 8_000_000
"""How much of a map is read at a time."""
MOST_PACKED_BYTES = 32_000_000
"""A compressed map is unpacked whole; a larger one is refused."""
_INTENSITIES = ("intensity", "reflectivity")


@dataclass(frozen=True, slots=True)
class MapFile:
    """An open map, whose header is read. Messages call it ``name``."""

    name: str
    header: PcdHeader
    stream: BinaryIO

    @property
    def points(self) -> int:
        """The number of points."""
        return self.header.points

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns of its pieces: x, y and z in m, and an intensity if the file has one."""
        known = [field.name for field in self.header.fields if field.count == 1 and field.name in _INTENSITIES]
        return (*AXES, *known[:1])

    def pieces(self) -> Iterator[FloatArray]:
        """All points, some of them at a time, shape (n, len(columns)); numbers may be NaN or infinite.

        Raises InvalidInput where the file is damaged.
        """
        self.stream.seek(self.header.offset)
        readers = {"ascii": self._ascii, "binary": self._binary, "binary_compressed": self._compressed}
        return readers[self.header.encoding]()

    def _binary(self) -> Iterator[FloatArray]:
        size = self.header.point_bytes
        at_once = max(1, PIECE_BYTES // size)
        for start in range(0, self.points, at_once):
            wanted = min(at_once, self.points - start) * size
            data = self.stream.read(wanted)
            if len(data) < wanted:
                raise cut_off(self.name, f"{start + len(data) // size} of {self.points} points")
            yield read_rows(data, self.header, self.columns)

    def _ascii(self) -> Iterator[FloatArray]:
        left = self.points
        for lines in _blocks_of_lines(self.stream, self.name):
            found = list(islice(lines, left))
            if found:
                yield read_lines(found, self.header, self.name, self.columns)
            left -= len(found)
            if left == 0:
                return
        if left:
            raise cut_off(self.name, f"{self.points - left} of {self.points} points")

    def _compressed(self) -> Iterator[FloatArray]:
        if self.points * self.header.point_bytes > MOST_PACKED_BYTES:
            raise InvalidInput(
                f"{self.name} is compressed and unpacks to more than {MOST_PACKED_BYTES // 1_000_000} MB",
                "save it with DATA binary",
            )
        data = self.stream.read(MOST_PACKED_BYTES + 8)
        yield read_compressed(data, self.header, self.name, self.columns)


@contextmanager
def open_map(path: Path, name: str) -> Iterator[MapFile]:
    """Open the PCD file at ``path``, which messages call ``name``.

    Raises:
        NotFound: There is no regular file.
        InvalidInput: It is no PCD file, or is cut off.
    """
    stream = open_regular_file(path)
    if stream is None:
        raise NotFound(f"there is no file {name}")
    with stream:
        header = read_header(stream.read(MAX_HEADER_BYTES), name)
        if header.encoding == "binary":
            held = os.fstat(stream.fileno()).st_size - header.offset
            needed = header.points * header.point_bytes
            if held < needed:
                raise cut_off(name, f"{held} of {needed} bytes")
        yield MapFile(name, header, stream)


def finite(rows: FloatArray) -> FloatArray:
    """The rows whose position is finite, also in single precision."""
    with np.errstate(over="ignore", invalid="ignore"):
        kept: FloatArray = rows[np.isfinite(rows[:, :3].astype(np.float32)).all(axis=1)]
    return kept


def _blocks_of_lines(stream: BinaryIO, name: str) -> Iterator[Iterator[str]]:
    """The lines of a text that are not empty, those of some megabytes at a time."""
    rest = b""
    while data := stream.read(PIECE_BYTES):
        whole, end, rest = (rest + data).rpartition(b"\n")
        if len(rest) > LONGEST_LINE_BYTES:
            raise malformed(name, f"it has a line of more than {LONGEST_LINE_BYTES} bytes")
        if end:
            yield _lines(whole)
    yield _lines(rest)


def _lines(data: bytes) -> Iterator[str]:
    return (line for line in data.decode("latin-1").split("\n") if line and not line.isspace())


MOST_POINTS = 100_000
"""What a browser without a GPU still turns smoothly."""
_FIRST_VOXELS = 4096
"""No voxel is so small that the map is more of them long."""
_FIRST_SHARE = 0.8
"""The first voxels are those of which a sample of points occupies this share of the most that are allowed."""
_COARSER = 1.25
_FARTHEST = 2**20
"""In voxels from the middle of the map. All points that are further away in a direction share a voxel."""
_Keys = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class MapCloud:
    """Points of a map.

    Attributes:
        positions_m: Shape (n, 3), in the frame of the file.
        intensities: Shape (n,), NaN where unknown; None if the file has none.
        total: How many points the file has.
        voxel_m: Edge of the cubes that hold at most one point each; None if points were not thinned that way.
        errors_m: Distance to the reference map, shape (n,); None if the map was not compared with one.
    """

    positions_m: FloatArray
    intensities: FloatArray | None
    total: int
    voxel_m: float | None = None
    errors_m: FloatArray | None = None

    @property
    def size_bytes(self) -> int:
        """The memory that it takes."""
        values = (self.positions_m, self.intensities, self.errors_m)
        return sum(array.nbytes for array in values if array is not None)

    def some(self, most: int) -> MapCloud:
        """At most ``most`` of the points, chosen at random. Two calls choose the same."""
        count = len(self.positions_m)
        if count <= most:
            return self
        kept = np.sort(np.random.default_rng(0).choice(count, most, replace=False))
        intensities = None if self.intensities is None else self.intensities[kept]
        errors_m = None if self.errors_m is None else self.errors_m[kept]
        return MapCloud(self.positions_m[kept], intensities, self.total, None, errors_m)


def sampled_cloud(path: Path, name: str, most: int = MOST_POINTS) -> MapCloud:
    """One point, chosen at random, of every so many in the order of the file; all of a map that is small enough.

    Two calls choose the same points. Raises NotFound without the file, InvalidInput for one that cannot be used.
    """
    with open_map(path, name) as file:
        return _cloud(file, _sample(file, most))


def thinned_cloud(path: Path, name: str, most: int = MOST_POINTS) -> MapCloud:
    """At most one point of each voxel, with voxels as small as ``most`` allows; raises as :func:`sampled_cloud`."""
    with open_map(path, name) as file:
        sample = _sample(file, most)
        if file.points <= most:
            return _cloud(file, sample)
        rows, voxel_m = _thin(file.pieces(), _some(file, sample), most)
        return _cloud(file, rows, voxel_m)


def map_size(path: Path, name: str) -> int:
    """Read the number of points that a map claims; raises as :func:`sampled_cloud`."""
    with open_map(path, name) as file:
        return file.points


def _sample(file: MapFile, most: int) -> FloatArray:
    """At most ``most`` rows. A fixed step alone would show the pattern of a spinning sensor."""
    step = max(1, -(-file.points // most))
    starts = np.arange(0, file.points, step)
    chosen = np.minimum(starts + np.random.default_rng(0).integers(0, step, len(starts)), file.points - 1)
    return np.concatenate([np.empty((0, len(file.columns))), *_chosen(file.pieces(), chosen)])


def _chosen(pieces: Iterable[FloatArray], chosen: _Keys) -> Iterator[FloatArray]:
    """The rows with these numbers, which are in order."""
    start = 0
    for piece in pieces:
        first, last = np.searchsorted(chosen, (start, start + len(piece)))
        yield finite(piece[chosen[first:last] - start])
        start += len(piece)


def _some(file: MapFile, rows: FloatArray) -> FloatArray:
    if len(rows) == 0:
        raise InvalidInput(f"{file.name} has no finite point", "the algorithm mapped nothing")
    return rows


def _cloud(file: MapFile, rows: FloatArray, voxel_m: float | None = None) -> MapCloud:
    intensities = rows[:, 3] if len(file.columns) > 3 else None
    return MapCloud(_some(file, rows)[:, :3], intensities, file.points, voxel_m)


def _thin(pieces: Iterable[FloatArray], sample: FloatArray, most: int) -> tuple[FloatArray, float]:
    """One row for each voxel, and the edge of the voxels.

    Voxels grow whenever more than ``most`` are occupied. So memory holds ``most`` rows and a piece.
    """
    middle_m = np.median(sample[:, :3], axis=0)
    # Surely small enough to begin with: all points occupy at least as many as a sample of them.
    near_m, far_m = np.percentile(sample[:, :3], (2, 98), axis=0)
    voxel_m = max(float((far_m - near_m).max()) / _FIRST_VOXELS, 1e-6)
    while len(np.unique(_keys(sample, middle_m, voxel_m))) > _FIRST_SHARE * most:
        voxel_m *= _COARSER
    rows, keys = sample[:0], np.empty(0, dtype=np.int64)
    for piece in pieces:
        points = finite(piece)
        rows, keys = _merged(rows, keys, points, _keys(points, middle_m, voxel_m))
        while len(rows) > most:
            voxel_m *= _COARSER
            rows, keys = _merged(rows[:0], keys[:0], rows, _keys(rows, middle_m, voxel_m))
    return rows, voxel_m


def _merged(rows: FloatArray, keys: _Keys, more: FloatArray, found: _Keys) -> tuple[FloatArray, _Keys]:
    """``rows`` with those of ``more`` whose voxel none of them is in; ``keys`` stay sorted."""
    if len(keys):
        places = np.minimum(np.searchsorted(keys, found), len(keys) - 1)
        fresh = keys[places] != found
        more, found = more[fresh], found[fresh]
    new, first = np.unique(found, return_index=True)
    joined = np.concatenate([keys, new])
    order = np.argsort(joined, kind="stable")
    return np.concatenate([rows, more[first]])[order], joined[order]


def _keys(rows: FloatArray, middle_m: FloatArray, voxel_m: float) -> _Keys:
    """A number for the voxel of each row: 21 bits for each axis."""
    cells = np.clip(np.floor((rows[:, :3] - middle_m) / voxel_m), -_FARTHEST, _FARTHEST - 1).astype(np.int64)
    x, y, z = (cells + _FARTHEST).T
    keys: _Keys = (x << 42) | (y << 21) | z
    return keys
