"""Reads single frames from files, and refuses damaged ones instead of decoding a part."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from slamhive.bags.geometry import Array
from slamhive.errors import InvalidInput

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_POINT_BYTES = 16
_REMEDY = "copy or download the frame again"

POINT_TYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])


def read_png(path: Path, *, colour: bool) -> Array:
    """The pixels of a PNG: uint8 (h, w), or (h, w, 3) in the order blue, green, red if ``colour``.

    Every chunk's checksum is verified first: decoders return the intact part of a truncated file without a word.

    Raises:
        InvalidInput: naming the frame and what is wrong with it.
    """
    data = _read(path)
    problem = _png_problem(data)
    if problem is not None:
        raise InvalidInput(f"frame {path} {problem}", _REMEDY)
    mode = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), mode)
    if pixels is None:
        raise InvalidInput(f"frame {path} cannot be decoded as PNG", _REMEDY)
    return pixels


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
        return path.read_bytes()
    except OSError as error:
        raise InvalidInput(f"frame {path} cannot be read: {error.strerror}", _REMEDY) from None


def _png_problem(data: bytes) -> str | None:
    """What is wrong with a PNG's chunks, None if nothing (PNG specification, section 5)."""
    if not data.startswith(_PNG_SIGNATURE):
        return f"is no PNG (it begins with {data[:8]!r})" if data else "is empty (0 bytes)"
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            break
        (expected,) = struct.unpack_from(">I", data, end - 4)
        if zlib.crc32(data[position + 4 : end - 4]) != expected:
            return f"is corrupt: the checksum of a chunk at byte {position} is wrong"
        if kind == b"IEND":
            return None
        position = end
    return f"is truncated: it ends after {len(data)} bytes"
