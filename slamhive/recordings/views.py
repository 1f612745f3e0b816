"""Single frames and LiDAR sweeps of a recording, made for people to look at."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.geometry import Array
from slamhive.recordings.reader import decode, messages, open_bag
from slamhive.runtime.messages import SUPPORTED, PointCloud, convert, stamp_ns, to_grey

FRAME_WIDTH, THUMBNAIL_WIDTH = 960, 160
MOST_POINTS = 12_000
_JPEG_QUALITY = 85
_JITTER_NS = 1_000_000_000
"""How much sooner or later after its timestamp a message may be received than the first one was."""
_MOST_SEARCHED = 500
_HALF_A_MS = 500_000
"""Timestamps in files have fewer digits than those in headers."""


@dataclass(frozen=True, slots=True)
class FrameView:
    """An image as JPEG; ``time_s`` counts from the start of the recording."""

    time_s: float
    jpeg: bytes


@dataclass(frozen=True, slots=True)
class SweepView:
    """Points of one LiDAR sweep in the sensor's frame, (n, 3) in m; ``points`` counts those before thinning."""

    time_s: float
    positions_m: Array
    points: int


def frames_at(dataset: Dataset, sensor: Sensor, times_s: Iterable[float], width: int) -> Iterator[FrameView]:
    """The first image of a camera at or after each time, at most ``width`` pixels wide.

    Times after the last image give nothing. Depth is coloured from near (red) to far (blue); black means no depth.

    Raises:
        NotFound: The sensor is no camera.
        InvalidInput: The recording is absent or damaged.
    """
    if sensor.kind not in {SensorKind.CAMERA, SensorKind.DEPTH}:
        raise NotFound(f"sensor {sensor.name} takes no images", "choose a camera")
    for time_s, message, kind in _messages_at(dataset, sensor, times_s):
        pixels = convert(message, kind)
        if not isinstance(pixels, np.ndarray):
            raise InvalidInput(f"topic {sensor.topic} of sensor {sensor.name} holds {kind}, no images")
        # Eight bits a channel, colour as blue, green, red.
        if sensor.kind is SensorKind.DEPTH:
            pixels = _coloured(pixels)
        elif pixels.ndim == 3:
            pixels = np.ascontiguousarray(pixels[..., ::-1].astype(np.uint8))
        else:
            pixels = to_grey(pixels).astype(np.uint8)
        if pixels.shape[1] <= width:
            shown = pixels
        else:
            height = max(1, round(pixels.shape[0] * width / pixels.shape[1]))
            shown = np.asarray(cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA))
        yield FrameView(time_s, _jpeg(shown))


def sweep_at(dataset: Dataset, sensor: Sensor, time_s: float) -> SweepView | None:
    """The first sweep of a LiDAR at or after ``time_s``, None after the last one; raises as :func:`frames_at`."""
    if sensor.kind is not SensorKind.LIDAR:
        raise NotFound(f"sensor {sensor.name} is no LiDAR", "choose a LiDAR")
    for found_s, message, kind in _messages_at(dataset, sensor, [time_s]):
        cloud = convert(message, kind)
        if not isinstance(cloud, PointCloud):
            raise InvalidInput(f"topic {sensor.topic} of sensor {sensor.name} holds {kind}, no point clouds")
        count = len(cloud.points_m)
        kept = np.linspace(0, count - 1, min(count, MOST_POINTS)).astype(np.int64)
        return SweepView(found_s, cloud.points_m[kept], count)
    return None


def received_s(dataset: Dataset, sensor: Sensor, timestamp_s: float) -> float | None:
    """Time of receipt of the first message with this timestamp in its header, or a later one.

    Returns:
        s from the start of the recording, as :func:`frames_at` and :func:`sweep_at` take them; None after the last.

    Raises:
        InvalidInput: The recording is absent or damaged.
    """
    path, wanted_ns = dataset.bag_path, round(timestamp_s * 1e9)
    with open_bag(path) as reader:
        start_ns = int(reader.start_time)
        first = next(messages(reader, path, [sensor.topic]), None)
        if first is None:
            return None
        connection, received_ns, raw = first
        _check_shown(connection.msgtype, sensor)
        delay_ns = received_ns - stamp_ns(decode(reader, path, connection, raw))
        begin_ns = max(start_ns, wanted_ns + delay_ns - _JITTER_NS)
        for connection, received_ns, raw in islice(messages(reader, path, [sensor.topic], begin_ns), _MOST_SEARCHED):
            if stamp_ns(decode(reader, path, connection, raw)) >= wanted_ns - _HALF_A_MS:
                return (received_ns - start_ns) * 1e-9
    return None


def _messages_at(dataset: Dataset, sensor: Sensor, times_s: Iterable[float]) -> Iterator[tuple[float, Any, str]]:
    """The first message of a sensor at or after each time, found by the index of the recording."""
    path = dataset.bag_path
    with open_bag(path) as reader:
        start_ns = int(reader.start_time)
        for time_s in times_s:
            found = next(messages(reader, path, [sensor.topic], start_ns + round(time_s * 1e9)), None)
            if found is None:
                return
            connection, received_ns, raw = found
            _check_shown(connection.msgtype, sensor)
            message = decode(reader, path, connection, raw)
            yield (received_ns - start_ns) * 1e-9, message, connection.msgtype


def _check_shown(kind: str, sensor: Sensor) -> None:
    if kind not in SUPPORTED:
        raise InvalidInput(
            f"topic {sensor.topic} of sensor {sensor.name} holds {kind}, which cannot be shown",
            f"messages of type {', '.join(SUPPORTED)} can",
        )


def _coloured(depth: Array) -> Array:
    values = np.nan_to_num(depth.astype(np.float32), posinf=0.0, neginf=0.0)
    known = values > 0
    far = float(np.percentile(values[known], 98)) if known.any() else 1.0
    near_is_high = 255 - np.clip(values * (255 / far), 0, 255)
    coloured: Array = cv2.applyColorMap(near_is_high.astype(np.uint8), cv2.COLORMAP_TURBO)
    coloured[~known] = 0
    return coloured


def _jpeg(pixels: Array) -> bytes:
    done, encoded = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise InvalidInput(f"an image of shape {pixels.shape} cannot be shown")
    return bytes(encoded)
