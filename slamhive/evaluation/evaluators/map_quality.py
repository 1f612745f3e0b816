"""Map quality: ``Map.pcd`` against the dataset's reference cloud, and its crispness without one.

Accuracy, completeness and F-score are the precision, recall and F-score of Knapitsch et al., "Tanks and Temples", ACM
Transactions on Graphics 36, 2017. The clouds are not registered with each other: the alignment of the trajectory moves
the map, so a map is not better than its poses. Mean map entropy: Droeschel and Behnke, "Efficient Continuous-time SLAM
for 3D Lidar-based Online Mapping", ICRA 2018.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.metrics.references import (
    COMPARED_POINTS,
    ENTROPY_FLOOR_M,
    ENTROPY_NEIGHBOURS,
    ENTROPY_POINTS,
    ENTROPY_RADIUS_M,
    MAP_THRESHOLDS_M,
    MAP_VOXEL_M,
)
from slamhive.evaluation.evaluators.base import MAP, REFERENCE_MAP, MetricValues, Paired, absent
from slamhive.trajectory.alignment import Similarity
from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.table import read_bounded

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Reads positions from PCD files (Point Cloud Library, versions 0.5 to 0.7).
#
# An algorithm wrote the file: its counts and sizes are compared with its length before any memory is allocated for
# them.


MAX_POINTS = 20_000_000
MAX_HEADER_BYTES = 20_000
_MAX_FIELDS = 100
_TYPES = {
    ("F", 4): "<f4",
    ("F", 8): "<f8",
    ("I", 1): "<i1",
    ("I", 2): "<i2",
    ("I", 4): "<i4",
    ("I", 8): "<i8",
    ("U", 1): "<u1",
    ("U", 2): "<u2",
    ("U", 4): "<u4",
    ("U", 8): "<u8",
}
AXES = ("x", "y", "z")
ENCODINGS = ("ascii", "binary", "binary_compressed")


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    kind: str
    count: int

    @property
    def size_bytes(self) -> int:
        return np.dtype(self.kind).itemsize * self.count


@dataclass(frozen=True, slots=True)
class PcdHeader:
    """The header of a PCD file; the data begins at ``offset``."""

    fields: tuple[_Field, ...]
    points: int
    encoding: str
    offset: int

    @property
    def point_bytes(self) -> int:
        """The size of one point in the binary encoding."""
        return sum(field.size_bytes for field in self.fields)

    @property
    def dtype(self) -> np.dtype[np.void]:
        """One point, as the binary encoding has it."""
        parts = [(f"f{index}", field.kind, (field.count,)) for index, field in enumerate(self.fields)]
        return np.dtype(parts)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the fields, in the order of the file."""
        return tuple(field.name for field in self.fields)

    def place(self, name: str) -> int:
        """The place of the field with this name."""
        return self.names.index(name)


def read_pcd(path: Path, name: str) -> FloatArray:
    """The finite points of a PCD file in m, shape (n, 3).

    Args:
        path: Where it lies; a link is not followed.
        name: What messages call it.

    Raises:
        InvalidInput: There is none, it is no PCD file, has no x, y, z or no finite point, is cut off, or is too large.
    """
    if path.is_symlink():
        raise InvalidInput(f"{name} is a link, which is not followed")
    try:
        data = read_bounded(path)
    except NotFound:
        raise InvalidInput(f"{name} does not exist") from None
    header = read_header(data, name)
    readers = {"ascii": _ascii, "binary": _binary, "binary_compressed": read_compressed}
    with np.errstate(invalid="ignore", over="ignore"):
        read = readers[header.encoding](data[header.offset :], header, name)
    points_m: FloatArray = read[np.isfinite(read).all(axis=1)]
    if len(points_m) == 0:
        raise InvalidInput(f"{name} has no finite point", "the algorithm mapped nothing")
    return points_m


def read_header(data: bytes, name: str) -> PcdHeader:
    """The header at the beginning of a PCD file, of which ``data`` is at least 20 kB or all; raises InvalidInput."""
    entries: dict[str, list[str]] = {}
    offset = 0
    while "DATA" not in entries:
        end = data.find(b"\n", offset)
        if end < 0 or end > MAX_HEADER_BYTES:
            raise malformed(name, "its header has no DATA line")
        words = data[offset:end].decode("latin-1").split()
        offset = end + 1
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    fields = _fields(entries, name)
    missing = [axis for axis in AXES if [field.name for field in fields].count(axis) != 1]
    if missing:
        raise malformed(name, f"it has no field {missing[0]}, or several")
    if any(field.count != 1 for field in fields if field.name in AXES):
        raise malformed(name, "x, y and z must have one number each")
    encoding = " ".join(entries["DATA"]).lower()
    if encoding not in ENCODINGS:
        raise malformed(name, f"DATA is {encoding[:40]!r}, not one of {', '.join(ENCODINGS)}")
    return PcdHeader(fields, _points(entries, name), encoding, offset)


def _fields(entries: dict[str, list[str]], name: str) -> tuple[_Field, ...]:
    names = entries.get("FIELDS", entries.get("COLUMNS", []))
    if not 0 < len(names) <= _MAX_FIELDS:
        raise malformed(name, f"its header names {len(names)} fields")
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(counts):
        raise malformed(name, "FIELDS, SIZE, TYPE and COUNT differ in length")
    fields = []
    for field, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        numpy_type = _TYPES.get((kind.upper(), _number(size, "SIZE", 8, name)))
        if numpy_type is None:
            raise malformed(name, f"a field of type {kind[:10]} and size {size} is not known")
        fields.append(_Field(field, numpy_type, _number(count, "COUNT", 10_000, name)))
    return tuple(fields)


def _points(entries: dict[str, list[str]], name: str) -> int:
    if "POINTS" in entries:
        return _number(" ".join(entries["POINTS"]), "POINTS", MAX_POINTS, name)
    width = _number(" ".join(entries.get("WIDTH", [])), "WIDTH", MAX_POINTS, name)
    height = _number(" ".join(entries.get("HEIGHT", ["1"])), "HEIGHT", MAX_POINTS, name)
    return _number(str(width * height), "WIDTH x HEIGHT", MAX_POINTS, name)


def _number(text: str, what: str, most: int, name: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 15):
        raise malformed(name, f"{what} is {text[:40]!r}, not a whole number")
    if int(text) > most:
        raise malformed(name, f"{what} is {int(text)}, more than {most}")
    return int(text)


def _ascii(data: bytes, header: PcdHeader, name: str) -> FloatArray:
    lines = data.decode("latin-1").splitlines()[: header.points]
    if len(lines) < header.points:
        raise cut_off(name, f"{len(lines)} of {header.points} points")
    return read_lines(lines, header, name)


def read_lines(lines: Sequence[str], header: PcdHeader, name: str, columns: Sequence[str] = AXES) -> FloatArray:
    """The named columns of some lines of the ascii encoding, shape (n, len(columns)); raises InvalidInput."""
    starts = np.cumsum([0, *(field.count for field in header.fields)])
    places = [int(starts[header.place(column)]) for column in columns]
    try:
        read = np.loadtxt(lines, dtype=np.float64, usecols=places, ndmin=2, comments=None)
    except ValueError:
        raise malformed(name, "a line of its points is not numbers") from None
    return read.reshape(-1, len(columns))


def _binary(data: bytes, header: PcdHeader, name: str) -> FloatArray:
    needed = header.points * header.point_bytes
    if len(data) < needed:
        raise cut_off(name, f"{len(data)} of {needed} bytes")
    return read_rows(data[:needed], header)


def read_rows(data: bytes, header: PcdHeader, columns: Sequence[str] = AXES) -> FloatArray:
    """The named columns of some points of the binary encoding, shape (n, len(columns))."""
    rows = np.frombuffer(data, dtype=header.dtype)
    return np.column_stack([rows[f"f{header.place(column)}"][:, 0].astype(np.float64) for column in columns])


def read_compressed(data: bytes, header: PcdHeader, name: str, columns: Sequence[str] = AXES) -> FloatArray:
    """The named columns of all points: field by field instead of point by point, and compressed with LZF."""
    needed = header.points * header.point_bytes
    if len(data) < 8:
        raise cut_off(name, f"{len(data)} bytes of data")
    packed, unpacked = struct.unpack_from("<II", data)
    if unpacked != needed:
        raise malformed(name, f"it unpacks to {unpacked} bytes instead of {needed}")
    if len(data) - 8 < packed:
        raise cut_off(name, f"{len(data) - 8} of {packed} bytes")
    whole = unpack_lzf(data[8 : 8 + packed], unpacked, name)
    read = []
    for column in columns:
        place = header.place(column)
        start = header.points * sum(field.size_bytes for field in header.fields[:place])
        read.append(np.frombuffer(whole, header.fields[place].kind, header.points, start).astype(np.float64))
    return np.column_stack(read)


def unpack_lzf(data: bytes, size: int, name: str) -> bytes:
    """The ``size`` bytes that LZF (Marc Lehmann's liblzf) packed into ``data``; raises InvalidInput."""
    out = bytearray()
    place, end = 0, len(data)
    while place < end and len(out) <= size:
        control = data[place]
        place += 1
        if control < 32:
            out += data[place : place + control + 1]
            place += control + 1
            continue
        length, high = control >> 5, control & 31
        if length == 7:
            length += data[place] if place < end else 0
            place += 1
        back = (high << 8) + (data[place] if place < end else 0) + 1
        place += 1
        if back > len(out) or place > end:
            raise malformed(name, "its compressed data is damaged")
        length += 2
        start = len(out) - back
        chunk = out[start : start + length]
        out += (chunk * (length // len(chunk) + 1))[:length]
    if len(out) != size or place != end:
        raise malformed(name, "its compressed data is damaged")
    return bytes(out)


def malformed(name: str, found: str) -> InvalidInput:
    """The mistake that a file is no PCD file, because of what was found."""
    return InvalidInput(f"{name} is not a PCD file that can be read: {found}", "write it with the Point Cloud Library")


def cut_off(name: str, found: str) -> InvalidInput:
    """The mistake that a file ends too early."""
    return InvalidInput(
        f"{name} is cut off: it holds {found}", "the algorithm ended while it wrote, or the disk is full"
    )


_FARTHEST_M = 1e7
_CHUNK = 200


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points in m, shape (n, 3), one per voxel, and the tree that finds the nearest of them."""

    points_m: FloatArray
    tree: cKDTree


class MapQuality:
    """Shares within distances, mean distances, entropy."""

    keys = (
        *(
            f"map.{what}.{threshold_m * 100:g}cm"
            for threshold_m in MAP_THRESHOLDS_M
            for what in ("accuracy", "completeness", "fscore")
        ),
        "map.accuracy.mean",
        "map.completeness.mean",
        "map.chamfer",
        "map.entropy",
        "map.points",
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the algorithm wrote no map. Without a reference cloud, only entropy and size are found."""
        return map_metrics(paired.files, paired.transform)


def map_metrics(files: Mapping[str, Path], transform: Similarity | None) -> MetricValues:
    """The metrics of the map in ``files``, moved into the world of the reference cloud by ``transform``.

    Without a transform, which needs a ground-truth trajectory, the map is not compared.
    """
    path = files.get(MAP)
    if path is None:
        return absent(MapQuality.keys, "the algorithm wrote no Map.pcd")
    points_m = read_pcd(path, path.name)
    cloud = make_cloud(points_m if transform is None else transform.points(points_m))
    values = {"map.points": float(len(points_m))}
    missing: dict[str, str] = {}
    entropy = map_entropy(cloud)
    if entropy is None:
        missing["map.entropy"] = (
            f"no point of the map has {ENTROPY_NEIGHBOURS} neighbours within {ENTROPY_RADIUS_M:g} m"
        )
    else:
        values["map.entropy"] = entropy
    reference = files.get(REFERENCE_MAP)
    compared = [key for key in MapQuality.keys if key not in ("map.entropy", "map.points")]
    if reference is None:
        missing |= dict.fromkeys(compared, "the dataset has no reference cloud")
    elif transform is None:
        missing |= dict.fromkeys(compared, "without a ground-truth trajectory nothing moves the map to the reference")
    else:
        values |= compare(cloud, _reference_cloud(reference))
    return MetricValues(values, missing)


def compare(cloud: Cloud, reference: Cloud) -> dict[str, float]:
    """Metrics of a map against its reference, both in one frame."""
    to_reference_m, _ = reference.tree.query(spread(cloud.points_m, COMPARED_POINTS))
    to_map_m, _ = cloud.tree.query(spread(reference.points_m, COMPARED_POINTS))
    values: dict[str, float] = {}
    for threshold_m in MAP_THRESHOLDS_M:
        ending = f"{threshold_m * 100:g}cm"
        accuracy = float(np.mean(to_reference_m <= threshold_m))
        completeness = float(np.mean(to_map_m <= threshold_m))
        both = accuracy + completeness
        values[f"map.accuracy.{ending}"] = accuracy
        values[f"map.completeness.{ending}"] = completeness
        values[f"map.fscore.{ending}"] = 2 * accuracy * completeness / both if both > 0 else 0.0
    values["map.accuracy.mean"] = float(to_reference_m.mean())
    values["map.completeness.mean"] = float(to_map_m.mean())
    values["map.chamfer"] = (values["map.accuracy.mean"] + values["map.completeness.mean"]) / 2
    return values


def map_entropy(cloud: Cloud) -> float | None:
    """Mean of 0.5 ln det(2 pi e C) over points and the covariances C of their neighbours; None if none has enough."""
    centres_m = spread(cloud.points_m, ENTROPY_POINTS)
    total, count = 0.0, 0
    for start in range(0, len(centres_m), _CHUNK):
        lists = cloud.tree.query_ball_point(centres_m[start : start + _CHUNK], ENTROPY_RADIUS_M, return_sorted=False)
        found = [np.cov(cloud.points_m[near].T, bias=True) for near in lists if len(near) >= ENTROPY_NEIGHBOURS]
        covariances = np.reshape(found, (-1, 3, 3)) + ENTROPY_FLOOR_M**2 * np.eye(3)
        _, logarithms = np.linalg.slogdet(2 * np.pi * np.e * covariances)
        total, count = total + 0.5 * float(logarithms.sum()), count + len(covariances)
    return total / count if count else None


def make_cloud(points_m: FloatArray) -> Cloud:
    """Thin the points to their mean in each voxel. Raises InvalidInput if none is near enough to be a map's."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to load, and few runs have maps

    near = points_m[(np.abs(points_m) < _FARTHEST_M).all(axis=1)]
    if len(near) == 0:
        raise InvalidInput(f"every point of the map is further than {_FARTHEST_M:g} m away", "the map diverged")
    thinned = thin(near, MAP_VOXEL_M)
    return Cloud(thinned, cKDTree(thinned))


def thin(points_m: FloatArray, voxel_m: float) -> FloatArray:
    """The mean of the points in each voxel, shape (m, 3), in the order of the voxels."""
    cells = np.floor(points_m / voxel_m).astype(np.int64)
    ids = np.zeros(len(points_m), dtype=np.int64)
    for axis in range(3):
        # Each axis gets its own numbers, so that the product cannot overflow.
        along = np.unique(cells[:, axis], return_inverse=True)[1]
        ids = np.unique(ids * (int(along.max()) + 1) + along, return_inverse=True)[1]
    counts = np.bincount(ids)
    return np.column_stack([np.bincount(ids, weights=points_m[:, axis]) / counts for axis in range(3)])


def spread(points_m: FloatArray, most: int) -> FloatArray:
    """All points, or ``most`` of them, evenly taken."""
    if len(points_m) <= most:
        return points_m
    return points_m[np.linspace(0, len(points_m) - 1, most).astype(np.intp)]


@lru_cache(maxsize=1)
def _reference_cloud(path: Path) -> Cloud:
    """The reference cloud, read once for all runs on one dataset: a process of the evaluation lives for one job."""
    return make_cloud(read_pcd(path, f"reference cloud {path.name}"))
