"""Images that algorithms do not read, as plain ones: Bayer, YUV, colour of 16 bits, and compressed depth.

A recording with them is written again, so that the player, the pre-processing steps and all algorithms read a few kinds
of images. The player of a run has numpy alone.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.recordings.importers.video_messages import VIDEO_TYPES, codec_of
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE_ENCODINGS, Array, convert

_BAYER = {
    "rggb": cv2.COLOR_BayerBG2RGB,
    "bggr": cv2.COLOR_BayerRG2RGB,
    "gbrg": cv2.COLOR_BayerGR2RGB,
    "grbg": cv2.COLOR_BayerGB2RGB,
}
"""ROS names a pattern by its first two rows, OpenCV by the second pixels of the second and third row."""
_YUV = {
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
}
_PLANAR_YUV = {"nv21": cv2.COLOR_YUV2RGB_NV21, "nv12": cv2.COLOR_YUV2RGB_NV12}
_DEEP_COLOUR = {"rgb16": 3, "bgr16": 3, "rgba16": 4, "bgra16": 4}
_DEEP_BAYER_BITS = 16
ODD_ENCODINGS = frozenset(
    {
        *(f"bayer_{pattern}{bits}" for pattern in _BAYER for bits in (8, _DEEP_BAYER_BITS)),
        *_YUV,
        *_PLANAR_YUV,
        *_DEEP_COLOUR,
    }
)
"""Encodings of ``Image`` that become ``rgb8``."""

COMPRESSED_DEPTH = "compressedDepth"
_CONFIG_BYTES = 12
"""The header of ``compressed_depth_image_transport``: the format as int32, and two parameters as float32."""
_RVL_SIZE_BYTES = 8
_MOST_PIXELS = 200_000_000
_NIBBLE_BITS = 3


def is_odd(message: Any, kind: str) -> bool:
    """Return whether an image has to become a plain one."""
    if kind in VIDEO_TYPES or codec_of(message, kind) is not None:
        return True
    if kind == COMPRESSED_IMAGE:
        return COMPRESSED_DEPTH in str(message.format)
    return str(message.encoding) not in IMAGE_ENCODINGS


def plain_image(message: Any, kind: str) -> tuple[Array, str]:
    """The pixels of an image in an encoding that algorithms read, and that encoding; raises InvalidInput if damaged."""
    if not is_odd(message, kind):
        pixels = convert(message, kind)
        assert isinstance(pixels, np.ndarray)
        return pixels, str(getattr(message, "encoding", "")) or ("mono8" if pixels.ndim == 2 else "rgb8")
    return _depth(message) if kind == COMPRESSED_IMAGE else (_colour(message), "rgb8")


def depth_encoding(message: Any) -> str:
    """The encoding that a message of compressed depth names first, such as ``16UC1``; empty for another format."""
    encoding = str(message.format).partition(";")[0].strip()
    return encoding if encoding in {"16UC1", "32FC1", "mono16"} else ""


def _colour(message: Any) -> Array:
    """The pixels (h, w, 3) in red, green, blue; of 16 bits the upper eight."""
    encoding, height, width = str(message.encoding), int(message.height), int(message.width)
    if encoding in _PLANAR_YUV:
        return _converted(_rows(message, height * 3 // 2, width, np.uint8), _PLANAR_YUV[encoding], message)
    if encoding in _YUV:
        packed = _rows(message, height, 2 * width, np.uint8).reshape(height, width, 2)
        return _converted(packed, _YUV[encoding], message)
    deep = np.dtype((">" if message.is_bigendian else "<") + "u2")
    if encoding in _DEEP_COLOUR:
        channels = _DEEP_COLOUR[encoding]
        pixels = (_rows(message, height, channels * width, deep) >> 8).astype(np.uint8)
        colour = pixels.reshape(height, width, channels)[..., :3]
        return np.ascontiguousarray(colour[..., ::-1] if encoding.startswith("bgr") else colour)
    pattern, bits = encoding.removeprefix("bayer_")[:4], encoding.removeprefix("bayer_")[4:]
    if pattern not in _BAYER or bits not in {"8", str(_DEEP_BAYER_BITS)}:
        raise InvalidInput(f"image encoding {encoding!r} is not read")
    if bits == "8":
        return _converted(_rows(message, height, width, np.uint8), _BAYER[pattern], message)
    return _converted((_rows(message, height, width, deep) >> 8).astype(np.uint8), _BAYER[pattern], message)


def _rows(message: Any, rows: int, numbers: int, kind: Any) -> Array:
    """The numbers of the rows, without padding, shape (rows, numbers)."""
    row_bytes = numbers * np.dtype(kind).itemsize
    data, step = np.asarray(message.data, dtype=np.uint8), int(message.step)
    if not 0 < rows * numbers <= _MOST_PIXELS or step < row_bytes or data.size < rows * step:
        raise InvalidInput(
            f"an image of {message.width}x{message.height} {message.encoding} holds {data.size} bytes, "
            f"{rows * max(step, row_bytes)} expected"
        )
    return np.ascontiguousarray(data[: rows * step].reshape(rows, step)[:, :row_bytes]).view(kind)


def _converted(pixels: Array, code: int, message: Any) -> Array:
    try:
        return np.asarray(cv2.cvtColor(pixels, code))
    except cv2.error as error:
        size = f"{message.width}x{message.height} {message.encoding}"
        raise InvalidInput(f"an image of {size} cannot be converted: {' '.join(str(error).split())[:100]}") from None


def _depth(message: Any) -> tuple[Array, str]:
    """The depths of a ``compressedDepth`` message: 16UC1 as stored, 32FC1 in m from inverse depth."""
    data, encoding = np.asarray(message.data, dtype=np.uint8), depth_encoding(message)
    if not encoding or data.size <= _CONFIG_BYTES:
        raise InvalidInput(
            f"compressed depth of format {str(message.format)[:80]!r} and {data.size} bytes is not read",
            "expected 16UC1 or 32FC1, with PNG or RVL",
        )
    if "rvl" in str(message.format).lower():
        stored = decode_rvl(data[_CONFIG_BYTES:].tobytes())
    else:
        try:
            found = cv2.imdecode(data[_CONFIG_BYTES:], cv2.IMREAD_UNCHANGED)
        except cv2.error:  # a size that damage made up
            found = None
        if found is None or found.dtype != np.uint16 or found.ndim != 2:
            raise InvalidInput("an image of compressed depth is no PNG of 16 bits", "the recording may be damaged")
        stored = np.asarray(found)
    if encoding != "32FC1":
        return stored, "16UC1"
    # depth = A / (stored - B), with 0 for no depth
    a, b = np.frombuffer(data[4:_CONFIG_BYTES].tobytes(), "<f4").astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        depths_m = np.where(stored == 0, np.nan, a / (stored.astype(np.float64) - b))
        return depths_m.astype(np.float32), "32FC1"


def decode_rvl(data: bytes) -> Array:
    """The image (h, w) uint16 that RVL compressed, after its width and height as two uint32; raises InvalidInput.

    Wilson, "Fast lossless depth image compression", ISS 2017. Runs of zeros and of other pixels alternate. Numbers are
    written in nibbles, the lowest three bits first, and the fourth bit says that more follow.
    """
    broken = InvalidInput("an image of compressed depth (RVL) makes no sense", "the recording may be damaged")
    if len(data) < _RVL_SIZE_BYTES:
        raise broken
    width, height = np.frombuffer(data[:_RVL_SIZE_BYTES], "<u4").tolist()
    words = np.frombuffer(data[_RVL_SIZE_BYTES : len(data) - (len(data) - _RVL_SIZE_BYTES) % 4], "<u4")
    pixels = width * height
    if not 0 < pixels <= _MOST_PIXELS:
        raise broken
    numbers = _rvl_numbers(words)
    result = np.zeros(pixels, dtype=np.uint16)
    place = read = 0
    runs: list[tuple[int, int, int]] = []
    while place < pixels:
        if read + 2 > len(numbers):
            raise broken
        zeros, count = int(numbers[read]), int(numbers[read + 1])
        place += zeros
        if place + count > pixels or read + 2 + count > len(numbers) or zeros + count == 0:
            raise broken
        runs.append((place, count, read + 2))
        place, read = place + count, read + 2 + count
    if not any(count for _, count, _ in runs):
        return result.reshape(height, width)
    coded = np.concatenate([numbers[start : start + count] for _, count, start in runs])
    depths = np.cumsum((coded >> 1) ^ -(coded & 1))
    done = 0
    for place, count, _ in runs:
        result[place : place + count] = depths[done : done + count]
        done += count
    return result.reshape(height, width)


def _rvl_numbers(words: Array) -> Array:
    """The numbers (n,) int64 in the nibbles of ``words``, the highest nibble of a word first."""
    shifts = np.arange(28, -1, -4, dtype=np.uint32)
    nibbles = ((words[:, None] >> shifts) & 15).reshape(-1).astype(np.int64)
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        return np.zeros(0, dtype=np.int64)
    starts = np.concatenate(([0], ends[:-1] + 1))
    nibbles = nibbles[: ends[-1] + 1]
    position = np.arange(len(nibbles)) - np.repeat(starts, ends - starts + 1)
    # 32 bits are eleven nibbles; what is longer is damaged, and becomes too large for an image
    parts = (nibbles & 7) << np.minimum(_NIBBLE_BITS * position, 33)
    return np.asarray(np.add.reduceat(parts, starts))
