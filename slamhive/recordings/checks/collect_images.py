"""Cheap statistics of all images, and costlier ones of some, within the time that a check may take."""

from __future__ import annotations

import zlib
from array import array
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache
from threading import BoundedSemaphore
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.evidence import Array, Depths, ImageEvidence, MatchEvidence
from slamhive.recordings.checks.geometry import can_undistort, depth_of, depths_by_triangulation, matrix, normalised
from slamhive.runtime.messages import COMPRESSED_IMAGE, IMAGE, convert, to_grey

# Costly work on images beside the pass over the recording: OpenCV computes while the next messages are read.


Result = TypeVar("Result")

MOST_WAITING = 4
"""Work that holds images in memory until it is done; the pass waits for more than that."""


class ImageWork:
    """One thread that does work in the order in which it was given.

    If the block ends with an error, work that has not started is dropped.
    """

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1, "check")
        self._free = BoundedSemaphore(MOST_WAITING)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._pool.shutdown(wait=True, cancel_futures=kind is not None)

    def start(self, work: Callable[[], Result]) -> Future[Result]:
        """Do ``work`` soon; its result, or its error, is in the future."""
        self._free.acquire()
        future = self._pool.submit(work)
        future.add_done_callback(lambda _done: self._free.release())
        return future


# Matches points between images of one camera over time, and between the cameras of a stereo pair.
#
# This is costly, so it is done at a few places spread over the recording, in the background. A place is examined one
# image later than it is met, when the messages of the other sensors of that time have come in.


FEWEST_PLACES, MOST_PLACES, IMAGES_PER_PLACE = 5, 40, 100
"""One place in 100 images costs a fifth of reading these images."""
MOTION_S = 0.2
"""Time between the images of a place: a body turns some degrees in it."""
FEATURES = 300
WIDTH_PX = 640
"""Wider images are scaled down to this before features are found."""
_RECENT = 4
_MOST_AXES_RAD = np.deg2rad(45)
_NEAREST_DISTINCT = 0.8
"""A match counts if the second best is that much worse (Lowe 2004)."""


_Partner = tuple[int, Any] | None
"""Timestamp in ns and message of another sensor, None if it has none of that time."""


@dataclass(frozen=True, eq=False)
class _Features:
    stamp_ns: int
    pixels: Array
    points: Array
    descriptors: Array | None


@dataclass(frozen=True, eq=False)
class _Place:
    """Features that wait for a later image, with what is known of their depths."""

    later_index: int
    features: _Features
    depths_raw: Array | None
    stereo_depths_m: Array | None


@dataclass(eq=False)
class _Eye:
    """A camera whose images are matched over time.

    The pass uses ``last`` and ``work``. The background uses ``waiting``, ``motion`` and ``stereo``.
    """

    sensor: Sensor
    places: frozenset[int]
    gap: int
    right: Sensor | None
    depth: Sensor | None
    last: tuple[int, int, Any] | None = None
    work: list[Future[None]] = field(default_factory=list)
    waiting: list[_Place] = field(default_factory=list)
    motion: list[MatchEvidence] = field(default_factory=list)
    stereo: list[MatchEvidence] = field(default_factory=list)


class CameraRig:
    """The cameras of a dataset, and which belong together.

    Args:
        dataset: With the sensors.
        counts: Number of messages of each sensor.
        background: Where images are examined.
    """

    def __init__(self, dataset: Dataset, counts: dict[str, int], background: ImageWork) -> None:
        self.background = background
        cameras = [sensor for sensor in dataset.of_kind(SensorKind.CAMERA) if counts[sensor.name]]
        rights = stereo_pairs(cameras)
        followers = {right.name for right in rights.values()}
        self._eyes: dict[str, _Eye] = {}
        for sensor in cameras:
            if sensor.name in followers or not can_undistort(sensor):
                continue
            count, gap = counts[sensor.name], max(1, round(MOTION_S * sensor.rate_hz))
            number = min(MOST_PLACES, max(FEWEST_PLACES, count // IMAGES_PER_PLACE))
            places = np.linspace(0, max(0, count - 1 - gap), number + 2)[1:-1].astype(int)
            right, depth = rights.get(sensor.name), depth_of(sensor, dataset)
            self._eyes[sensor.name] = _Eye(sensor, frozenset(places.tolist()), gap, right, depth)
        self._recent: dict[str, deque[tuple[int, Any]]] = {}
        for eye in self._eyes.values():
            for other in (eye.right, eye.depth):
                if other is not None:
                    self._recent[other.name] = deque(maxlen=_RECENT)

    def camera(self, name: str, index: int, stamp_ns: int, message: Any) -> None:
        """Take an image of the camera ``name``."""
        if name in self._recent:
            self._recent[name].append((stamp_ns, message))
        eye = self._eyes.get(name)
        if eye is not None:
            self._examine(eye)
            eye.last = (index, stamp_ns, message)

    def depth(self, name: str, stamp_ns: int, message: Any) -> None:
        """Take an image of the depth camera ``name``."""
        if name in self._recent:
            self._recent[name].append((stamp_ns, message))

    def finish(self, name: str) -> dict[str, Any]:
        """The matches of the camera ``name``."""
        eye = self._eyes.get(name)
        if eye is None:
            return {}
        self._examine(eye)
        eye.last = None
        for work in eye.work:
            work.result()
        return {"motion": tuple(eye.motion), "stereo": tuple(eye.stereo), "partner": eye.right}

    def _examine(self, eye: _Eye) -> None:
        """Look at the last image, if it is at a place or some time after one."""
        if eye.last is None:
            return
        index, stamp_ns, message = eye.last
        if index in eye.places:
            right = self._nearest(eye.right, stamp_ns)
            depth = self._nearest(eye.depth, stamp_ns)
            eye.work.append(self.background.start(lambda: _look(eye, index, stamp_ns, message, right, depth)))
        elif index - eye.gap in eye.places:
            eye.work.append(self.background.start(lambda: _look(eye, index, stamp_ns, message)))

    def _nearest(self, sensor: Sensor | None, stamp_ns: int) -> _Partner:
        """The message of ``sensor`` of the same time, if there is one within a third of its period."""
        if sensor is None or not self._recent[sensor.name]:
            return None
        found = min(self._recent[sensor.name], key=lambda entry: abs(entry[0] - stamp_ns))
        return found if abs(found[0] - stamp_ns) <= 1e9 / sensor.rate_hz / 3 else None


def stereo_pairs(cameras: list[Sensor]) -> dict[str, Sensor]:
    """The right camera of each left one: its neighbour in ``dataset.yaml`` that looks the same way from elsewhere."""
    pairs: dict[str, Sensor] = {}
    waiting: Sensor | None = None
    for sensor in cameras:
        if waiting is not None and _is_pair(waiting, sensor):
            pairs[waiting.name] = sensor
            waiting = None
        else:
            waiting = sensor
    return pairs


def _is_pair(left: Sensor, right: Sensor) -> bool:
    T_right_left = np.linalg.inv(matrix(right.T_body_sensor)) @ matrix(left.T_body_sensor)
    angle_rad = np.arccos(np.clip(T_right_left[2, 2], -1.0, 1.0))
    known = can_undistort(left) and can_undistort(right)
    return bool(known and angle_rad < _MOST_AXES_RAD and np.linalg.norm(T_right_left[:3, 3]) > 1e-3)


@cache
def _detector() -> Any:
    import cv2  # noqa: PLC0415 - only recordings with images need it

    opencv: Any = cv2  # its type hints lack ORB_create
    return opencv.ORB_create(FEATURES, nlevels=3, fastThreshold=12), opencv.BFMatcher(opencv.NORM_HAMMING)


def _features(sensor: Sensor, stamp_ns: int, message: Any) -> _Features | None:
    import cv2  # noqa: PLC0415 - only recordings with images need it

    try:
        grey = to_grey(np.asarray(convert(message, message.__msgtype__)))
    except InvalidInput:
        return None
    if grey.shape != (sensor.calibration["height"], sensor.calibration["width"]):
        return None  # the intrinsics are for other images
    scale = min(1.0, WIDTH_PX / len(grey[0]))
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = _detector()[0].detectAndCompute(grey, None)
    found = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float64).reshape(-1, 2)
    pixels = (found + 0.5) / scale - 0.5
    return _Features(stamp_ns, pixels, normalised(sensor, pixels), descriptors)


def _match(first: _Features, second: _Features) -> tuple[Array, Array]:
    """Indices of matching features in both."""
    nothing = np.zeros(0, dtype=np.intp)
    if first.descriptors is None or second.descriptors is None or len(second.points) < 2:
        return nothing, nothing
    candidates = _detector()[1].knnMatch(first.descriptors, second.descriptors, k=2)
    good = [best for best, other in candidates if best.distance < _NEAREST_DISTINCT * other.distance]
    mine = np.array([match.queryIdx for match in good], dtype=np.intp)
    theirs = np.array([match.trainIdx for match in good], dtype=np.intp)
    return mine, theirs


def _look(eye: _Eye, index: int, stamp_ns: int, message: Any, right: _Partner = None, depth: _Partner = None) -> None:
    """Examine an image at a place, or some time after one, with those of the other sensors at its time."""
    features = _features(eye.sensor, stamp_ns, message)
    if features is None:
        return
    for place in [place for place in eye.waiting if place.later_index == index]:
        eye.waiting.remove(place)
        earlier = place.features
        mine, theirs = _match(earlier, features)
        eye.motion.append(
            MatchEvidence(
                earlier.stamp_ns,
                features.stamp_ns,
                earlier.points[mine],
                features.points[theirs],
                None if place.depths_raw is None else place.depths_raw[mine],
                None if place.stereo_depths_m is None else place.stereo_depths_m[mine],
            )
        )
    if index in eye.places:
        stereo_depths_m = _match_stereo(eye, features, right)
        eye.waiting.append(_Place(index + eye.gap, features, _depths_at(features, depth), stereo_depths_m))


def _match_stereo(eye: _Eye, features: _Features, right: _Partner) -> Array | None:
    if right is None or eye.right is None:
        return None
    other = _features(eye.right, right[0], right[1])
    if other is None:
        return None
    mine, theirs = _match(features, other)
    eye.stereo.append(MatchEvidence(features.stamp_ns, other.stamp_ns, features.points[mine], other.points[theirs]))
    T_right_left = np.linalg.inv(matrix(eye.right.T_body_sensor)) @ matrix(eye.sensor.T_body_sensor)
    depths_m = np.full(len(features.points), np.nan)
    depths_m[mine] = depths_by_triangulation(features.points[mine], other.points[theirs], T_right_left)
    return depths_m


def _depths_at(features: _Features, depth: _Partner) -> Array | None:
    if depth is None:
        return None
    try:
        image = np.asarray(convert(depth[1], depth[1].__msgtype__))
    except InvalidInput:
        return None
    column, row = np.rint(features.pixels).astype(np.intp).T
    inside = (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
    depths = np.zeros(len(column))
    depths[inside] = image[row[inside], column[inside]]
    return np.nan_to_num(depths)


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

    def __init__(self, sensor: Sensor, count: int, rig: CameraRig) -> None:
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
        images = ImageEvidence(self._shapes, np.array(self._prints, dtype=np.int64), rows[:, 0], rows[:, 1], rows[:, 2])
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

    def __init__(self, sensor: Sensor, count: int, rig: CameraRig) -> None:
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
        images = ImageEvidence(self._shapes, np.array(self._prints, dtype=np.int64), nothing, nothing, nothing)
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
