"""Matches points between images of one camera over time, and between the cameras of a stereo pair.

This is costly, so it is done at a few places spread over the recording, in the background. A place is examined one
image later than it is met, when the messages of the other sensors of that time have come in.
"""

from __future__ import annotations

from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from slamhive.checks.background import Background
from slamhive.checks.evidence import Array, Matches
from slamhive.checks.geometry import can_undistort, depth_of, depths_by_triangulation, matrix, normalised
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.errors import InvalidInput
from slamhive.runtime.messages import convert, to_grey

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
    motion: list[Matches] = field(default_factory=list)
    stereo: list[Matches] = field(default_factory=list)


class Rig:
    """The cameras of a dataset, and which belong together.

    Args:
        dataset: With the sensors.
        counts: Number of messages of each sensor.
        background: Where images are examined.
    """

    def __init__(self, dataset: Dataset, counts: dict[str, int], background: Background) -> None:
        self.background = background
        cameras = [sensor for sensor in dataset.of_kind(SensorKind.CAMERA) if counts[sensor.name]]
        rights = stereo_pairs(cameras)
        followers = {right.name for right in rights.values()}
        self._eyes = {
            sensor.name: _eye(sensor, counts[sensor.name], rights.get(sensor.name), dataset)
            for sensor in cameras
            if sensor.name not in followers and can_undistort(sensor)
        }
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


def _eye(sensor: Sensor, count: int, right: Sensor | None, dataset: Dataset) -> _Eye:
    gap = max(1, round(MOTION_S * sensor.rate_hz))
    number = min(MOST_PLACES, max(FEWEST_PLACES, count // IMAGES_PER_PLACE))
    places = np.linspace(0, max(0, count - 1 - gap), number + 2)[1:-1].astype(int)
    return _Eye(sensor, frozenset(places.tolist()), gap, right, depth_of(sensor, dataset))


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
        _match_motion(eye, place, features)
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
    eye.stereo.append(Matches(features.stamp_ns, other.stamp_ns, features.points[mine], other.points[theirs]))
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


def _match_motion(eye: _Eye, place: _Place, later: _Features) -> None:
    earlier = place.features
    mine, theirs = _match(earlier, later)
    eye.motion.append(
        Matches(
            earlier.stamp_ns,
            later.stamp_ns,
            earlier.points[mine],
            later.points[theirs],
            None if place.depths_raw is None else place.depths_raw[mine],
            None if place.stereo_depths_m is None else place.stereo_depths_m[mine],
        )
    )
