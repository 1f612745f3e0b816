"""Reads a saved map a piece at a time, so that memory does not grow with the map.

An algorithm wrote the file: no links, and its counts are compared with its length before anything is read.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np

from slamhive.errors import InvalidInput, NotFound
from slamhive.evaluation.pcd import (
    AXES,
    MAX_HEADER_BYTES,
    Header,
    cut_off,
    malformed,
    read_compressed,
    read_header,
    read_lines,
    read_rows,
)
from slamhive.runs.untrusted import LONGEST_LINE_BYTES, FloatArray, open_regular_file

PIECE_BYTES = 8_000_000
"""How much of a map is read at a time."""
MOST_PACKED_BYTES = 32_000_000
"""A compressed map is unpacked whole; a larger one is refused."""
_INTENSITIES = ("intensity", "reflectivity")


@dataclass(frozen=True, slots=True)
class MapFile:
    """An open map, whose header is read. Messages call it ``name``."""

    name: str
    header: Header
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
