"""Reads positions from PCD files (Point Cloud Library, versions 0.5 to 0.7).

An algorithm wrote the file: its counts and sizes are compared with its length before any memory is allocated for them.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.errors import InvalidInput, NotFound
from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.table import read_bounded

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
class Header:
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


def read_header(data: bytes, name: str) -> Header:
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
    return Header(fields, _points(entries, name), encoding, offset)


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


def _ascii(data: bytes, header: Header, name: str) -> FloatArray:
    lines = data.decode("latin-1").splitlines()[: header.points]
    if len(lines) < header.points:
        raise cut_off(name, f"{len(lines)} of {header.points} points")
    return read_lines(lines, header, name)


def read_lines(lines: Sequence[str], header: Header, name: str, columns: Sequence[str] = AXES) -> FloatArray:
    """The named columns of some lines of the ascii encoding, shape (n, len(columns)); raises InvalidInput."""
    starts = np.cumsum([0, *(field.count for field in header.fields)])
    places = [int(starts[header.place(column)]) for column in columns]
    try:
        read = np.loadtxt(lines, dtype=np.float64, usecols=places, ndmin=2, comments=None)
    except ValueError:
        raise malformed(name, "a line of its points is not numbers") from None
    return read.reshape(-1, len(columns))


def _binary(data: bytes, header: Header, name: str) -> FloatArray:
    needed = header.points * header.point_bytes
    if len(data) < needed:
        raise cut_off(name, f"{len(data)} of {needed} bytes")
    return read_rows(data[:needed], header)


def read_rows(data: bytes, header: Header, columns: Sequence[str] = AXES) -> FloatArray:
    """The named columns of some points of the binary encoding, shape (n, len(columns))."""
    rows = np.frombuffer(data, dtype=header.dtype)
    return np.column_stack([rows[f"f{header.place(column)}"][:, 0].astype(np.float64) for column in columns])


def read_compressed(data: bytes, header: Header, name: str, columns: Sequence[str] = AXES) -> FloatArray:
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
