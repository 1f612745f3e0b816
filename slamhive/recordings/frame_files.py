"""Reads single frames from files, and refuses damaged ones instead of decoding a part."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.recordings.geometry import Array
from slamhive.trajectory.table import read_bounded

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8\xff", b"\xff\xd9"
_JPEG_SCAN = 0xDA
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a header with the image's size (ITU T.81, table B.1)."""
_PNM_HEADER = re.compile(rb"P([56])(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,6})\s+(\d{1,6})\s+(\d{1,5})\s")
_MOST_PIXELS = 64_000_000
"""Larger images are refused before they are decoded."""
_POINT_BYTES = 16
_REMEDY = "copy or download the frame again"

POINT_TYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])

_MODES = {
    "mono8": cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION,
    "bgr8": cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION,
    "16UC1": cv2.IMREAD_UNCHANGED,
}
_PIXEL_BYTES = {"mono8": 1, "bgr8": 3, "16UC1": 2, "32FC1": 4}


def pixel_bytes(encoding: str) -> int:
    """The size of a pixel in a message of ``encoding``."""
    return _PIXEL_BYTES[encoding]


def read_image(path: Path, encoding: str) -> Array:
    """The pixels of a PNG, JPEG, PGM or PPM file.

    Checksums and ends are verified first: decoders return the intact part of a truncated file without a word.

    Args:
        path: The file; its content says which format it has.
        encoding: ``mono8``: uint8 (h, w). ``bgr8``: uint8 (h, w, 3). ``16UC1``: uint16 (h, w), only of 16-bit images.

    Raises:
        InvalidInput: naming the frame and what is wrong with it.
    """
    data = _read(path)
    problem = _problem(data)
    if problem is not None:
        raise InvalidInput(f"frame {path} {problem}", _REMEDY)
    try:
        pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), _MODES[encoding])
    except cv2.error:
        pixels = None
    if pixels is None:
        raise InvalidInput(f"frame {path} cannot be decoded", _REMEDY)
    if encoding == "16UC1" and (pixels.dtype != np.uint16 or pixels.ndim != 2):
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise InvalidInput(
            f"frame {path} has {channels} channels of {8 * pixels.dtype.itemsize} bits",
            "a depth image has one channel of 16 bits",
        )
    return pixels


def has_colour(path: Path) -> bool:
    """Tell if the image at ``path`` has several channels; raises InvalidInput as :func:`read_image`."""
    read_image(path, "mono8")
    pixels = cv2.imdecode(np.frombuffer(_read(path), dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels is not None and pixels.ndim == 3


def read_velodyne(path: Path) -> Array:
    """The points of a KITTI scan, a structured array (n,) of :data:`POINT_TYPE`; raises InvalidInput."""
    data = _read(path)
    if not data or len(data) % _POINT_BYTES:
        raise InvalidInput(
            f"frame {path} has {len(data)} bytes, not a multiple of {_POINT_BYTES} (x, y, z, intensity)", _REMEDY
        )
    numbers = np.frombuffer(data, dtype="<f4")
    bad = np.flatnonzero(~np.isfinite(numbers))
    if len(bad):
        raise InvalidInput(f"frame {path}, point {int(bad[0]) // 4}: found {numbers[bad[0]]}", _REMEDY)
    return np.frombuffer(data, dtype=POINT_TYPE)


def _read(path: Path) -> bytes:
    try:
        return read_bounded(path)
    except (InvalidInput, NotFound) as error:
        raise InvalidInput(f"frame {error.message}", _REMEDY) from None


def _problem(data: bytes) -> str | None:
    """Name the fault of an image file, None if there is none."""
    if not data:
        return "is empty (0 bytes)"
    if data.startswith(_PNG_SIGNATURE):
        return _png_problem(data)
    if data.startswith(_JPEG_START):
        return _jpeg_problem(data)
    if data.startswith((b"P5", b"P6")):
        return _pnm_problem(data)
    return f"is no PNG, JPEG, PGM or PPM image (it begins with {data[:8]!r})"


def _png_problem(data: bytes) -> str | None:
    """Name the fault of a PNG's chunks, None if there is none (PNG specification, section 5)."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (expected,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != expected:
            return f"is corrupt: the checksum of a chunk at byte {position} is wrong"
        if kind == b"IHDR" and length >= 8:
            width, height = struct.unpack_from(">II", data, position + 8)
            if width * height > _MOST_PIXELS:
                return _too_large(width, height)
        if kind == b"IEND":
            return None
        position = end
    return f"is truncated: it ends after {len(data)} bytes"


def _jpeg_problem(data: bytes) -> str | None:
    """Name the fault of a JPEG's segments, None if there is none (ITU T.81, annex B)."""
    position = 2
    while position + 4 <= len(data):
        lead, marker, length = struct.unpack_from(">BBH", data, position)
        if lead != 0xFF:
            return f"is corrupt: no JPEG marker at byte {position}"
        if marker == _JPEG_SCAN:
            # 0xff bytes of the scan are followed by 0: what looks like the end marker is the end.
            return None if data.find(_JPEG_END, position) >= 0 else f"is truncated: it ends after {len(data)} bytes"
        if marker in _JPEG_FRAMES and position + 9 <= len(data):
            height, width = struct.unpack_from(">HH", data, position + 5)
            if width * height > _MOST_PIXELS:
                return _too_large(width, height)
        position += 2 + length
    return f"is truncated: it ends after {len(data)} bytes"


def _pnm_problem(data: bytes) -> str | None:
    """Name the fault of a binary PGM or PPM, None if there is none (netpbm's manual of these formats)."""
    header = _PNM_HEADER.match(data)
    if header is None:
        return "is corrupt: its PGM or PPM header cannot be read"
    kind, width, height, largest = (int(word) for word in header.groups())
    if width * height > _MOST_PIXELS:
        return _too_large(width, height)
    expected = header.end() + width * height * (3 if kind == 6 else 1) * (1 if largest < 256 else 2)
    return None if len(data) >= expected else f"is truncated: it ends after {len(data)} of {expected} bytes"


def _too_large(width: int, height: int) -> str:
    return f"is {width}x{height} pixels, more than {_MOST_PIXELS // 1_000_000} million"
