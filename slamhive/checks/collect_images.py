"""Cheap statistics of all images, and costlier ones of some, within the time that a check may take."""

from __future__ import annotations

import zlib
from array import array
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np

from slamhive.checks.collect_matches import Rig
from slamhive.checks.evidence import Array, Depths, Images
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, convert, to_grey

COARSE = 8
"""Brightness is the mean of each eighth pixel of each eighth row."""
SHARPNESS_SAMPLES = 32
"""Images whose sharpness is computed, spread over the recording: 0.3 ms each."""
DECODED_SAMPLES = 60
"""Compressed images that are decoded for statistics: 5 ms each."""
DEPTH_SAMPLES = 40
_CROP_PX = 160
_UPPER_LIMIT = 250
_PRINT_STEP = 61
"""Prints use each 61st byte: noise makes different images differ in some of them."""
_FINE_PX, _COARSE_PX = 1.5, 6.0
Row = tuple[float, float, float]
"""Mean brightness, share of bright pixels, sharpness."""
NOTHING: Row = (np.nan, np.nan, np.nan)


class ImageCollector:
    """The images of one camera."""

    def __init__(self, sensor: Sensor, count: int, rig: Rig) -> None:
        self._name = sensor.name
        self._rig = rig
        self._late: list[tuple[int, Future[Row]]] = []
        self._sharp_every = max(1, count // SHARPNESS_SAMPLES)
        self._decode_every = max(1, count // DECODED_SAMPLES)
        self._shapes: Counter[tuple[int, int, str]] = Counter()
        self._prints = array("q")
        self._rows = array("f")

    def add(self, index: int, header_ns: int, message: Any) -> None:
        """Take one image."""
        data = np.asarray(message.data, dtype=np.uint8)
        self._prints.append(_print_of(data))
        if message.__msgtype__ == COMPRESSED_IMAGE:
            self._compressed(message, decoded=index % self._decode_every == 0)
        else:
            self._shapes[_shape_of(message)] += 1
            self._raw(message, data, sharp=index % self._sharp_every == 0)
        self._rig.camera(self._name, index, header_ns, message)

    def finish(self) -> dict[str, Any]:
        """The images, and what their matches show."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 3)
        for place, future in self._late:
            rows[place] = future.result()
        images = Images(self._shapes, np.array(self._prints, dtype=np.int64), rows[:, 0], rows[:, 1], rows[:, 2])
        return {"images": images, **self._rig.finish(self._name)}

    def _raw(self, message: Any, data: Array, *, sharp: bool) -> None:
        step, height, width = int(message.step), int(message.height), int(message.width)
        byte_deep = "16" not in message.encoding and "32" not in message.encoding
        if not byte_deep or data.size < step * height or width == 0:
            self._rows.extend(NOTHING)
            return
        channels = max(1, step // width)
        rows = data[: step * height].reshape(height, step)
        coarse = rows[::COARSE, : width * channels : COARSE * channels]
        brightness = int(coarse.sum()) / (255 * coarse.size)
        bright_share = np.count_nonzero(coarse >= _UPPER_LIMIT) / coarse.size
        if sharp:
            crop = _middle(rows[:, : width * channels : channels])
            self._start(lambda: (brightness, bright_share, sharpness_of(crop)))
        else:
            self._rows.extend((brightness, bright_share, np.nan))

    def _compressed(self, message: Any, *, decoded: bool) -> None:
        if decoded:
            self._start(lambda: self._decode(message))
        else:
            self._rows.extend(NOTHING)

    def _decode(self, message: Any) -> Row:
        try:
            grey = to_grey(np.asarray(convert(message, COMPRESSED_IMAGE)))
        except InvalidInput:
            self._shapes[0, 0, str(message.format)] += 1
            return NOTHING
        self._shapes[grey.shape[1], grey.shape[0], ""] += 1
        return (float(grey.mean()) / 255, float(np.mean(grey >= _UPPER_LIMIT)), sharpness_of(_middle(grey)))

    def _start(self, work: Callable[[], Row]) -> None:
        self._late.append((len(self._rows) // len(NOTHING), self._rig.background.start(work)))
        self._rows.extend(NOTHING)


class DepthCollector:
    """The images of one depth camera."""

    def __init__(self, sensor: Sensor, count: int, rig: Rig) -> None:
        self._name = sensor.name
        self._rig = rig
        self._every = max(1, count // DEPTH_SAMPLES)
        self._shapes: Counter[tuple[int, int, str]] = Counter()
        self._prints = array("q")
        self._rows = array("f")

    def add(self, index: int, header_ns: int, message: Any) -> None:
        """Take one depth image."""
        data = np.asarray(message.data, dtype=np.uint8)
        self._prints.append(_print_of(data))
        if message.__msgtype__ == IMAGE:
            self._shapes[_shape_of(message)] += 1
        self._rig.depth(self._name, header_ns, message)
        if index % self._every == 0:
            self._sample(message)

    def finish(self) -> dict[str, Any]:
        """The depth images."""
        rows = np.array(self._rows, dtype=np.float64).reshape(-1, 2)
        nothing = np.full(len(self._prints), np.nan)
        images = Images(self._shapes, np.array(self._prints, dtype=np.int64), nothing, nothing, nothing)
        return {"images": images, "depths": Depths(rows[:, 0], rows[:, 1])}

    def _sample(self, message: Any) -> None:
        try:
            values = np.asarray(convert(message, message.__msgtype__))[::COARSE, ::COARSE]
        except InvalidInput:
            return
        if values.size == 0:
            return
        valid = values[np.isfinite(values) & (values > 0)]
        self._rows.extend((valid.size / values.size, float(np.median(valid)) if valid.size else np.nan))


def sharpness_of(grey: Array) -> float:
    """Energy of structures of about 1 pixel over that of structures of about 4 pixels; 0.1 to 1 for a sharp image.

    A ratio, so that it depends on focus and motion, not on how much there is to see.
    """
    import cv2  # noqa: PLC0415 - only recordings with images need it

    image = grey.astype(np.float32)
    fine, coarse = cv2.GaussianBlur(image, (0, 0), _FINE_PX), cv2.GaussianBlur(image, (0, 0), _COARSE_PX)
    below = float(((fine - coarse) ** 2).mean())
    return float(((image - fine) ** 2).mean()) / below if below > 0 else np.nan


def _print_of(data: Array) -> int:
    """A number that differs between different images, nearly always."""
    return zlib.crc32(data[::_PRINT_STEP].tobytes()) ^ (data.size << 32)


def _shape_of(message: Any) -> tuple[int, int, str]:
    return int(message.width), int(message.height), str(message.encoding)


def _middle(image: Array) -> Array:
    top, left = (max(0, (size - _CROP_PX) // 2) for size in image.shape[:2])
    return np.ascontiguousarray(image[top : top + _CROP_PX, left : left + _CROP_PX])
