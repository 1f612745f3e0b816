"""The sensors of a recording: rates and sizes from its messages, calibration from files and topics."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.calibration import COEFFICIENTS, CameraIntrinsics, CameraModel
from slamhive.domain.sensors import CalibrationValue, Sensor, SensorKind, is_rigid
from slamhive.recordings.geometry import Array, flat, transform
from slamhive.recordings.importers.calibration import BODY, FrameGraph, KnownCalibration, KnownSensor, pose_matrix
from slamhive.recordings.importers.lidar_drivers import layout_of, livox_layout
from slamhive.recordings.importers.odd_images import is_odd
from slamhive.recordings.importers.recording import LIVOX, Matching, SourceBag, camera_of
from slamhive.recordings.writers import NS_PER_S

# Calibration in the recording itself: ``CameraInfo`` messages and the transforms of ``/tf_static``.


CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
TF_TYPES = (TF_MESSAGE, "tf/msg/tfMessage")

_MODELS = {
    "plumb_bob": CameraModel.PINHOLE_RADTAN,
    "rational_polynomial": CameraModel.PINHOLE_RADTAN,
    "equidistant": CameraModel.PINHOLE_EQUIDISTANT,
    "fisheye": CameraModel.PINHOLE_EQUIDISTANT,
    "double_sphere": CameraModel.DOUBLE_SPHERE,
}
_MOST_STATIC = 1000
"""Recorders write /tf_static once for each node; more messages say nothing new."""


def camera_info_of(bag: SourceBag, image_topic: str) -> Any | None:
    """The first ``CameraInfo`` of the camera behind ``image_topic``, None if there is none or it is all zeros."""
    camera, _ = camera_of(image_topic)
    parent = camera.rpartition("/")[0]
    names = (f"{camera}/camera_info", f"{image_topic}/camera_info", f"{camera}_info", f"{parent}/camera_info")
    known = {topic.name for topic in bag.of_type(CAMERA_INFO)}
    found = next((name for name in names if name in known), None)
    if found is None:
        return None
    info = bag.first(found)
    return info if np.isfinite(_array(info, "k")).all() and _array(info, "k")[0] > 0 else None


def is_rectified(image_topic: str) -> bool:
    """Tell if images are rectified, by the name that ROS gives to such topics."""
    return "image_rect" in image_topic


def intrinsics_of(info: Any, image_topic: str) -> CameraIntrinsics:
    """The intrinsics in a ``CameraInfo``; rectified images have those of its P, without distortion.

    Raises InvalidInput for an unknown model, or coefficients that do not fit it.
    """
    K, P = _array(info, "k").reshape(3, 3), _array(info, "p").reshape(3, 4)
    rectified = is_rectified(image_topic)
    A = P[:, :3] if rectified and P[0, 0] > 0 else K
    model, distortion = (CameraModel.PINHOLE, ()) if rectified else _distortion(info, image_topic)
    fx, fy, cx, cy = (float(value) for value in (A[0, 0], A[1, 1], A[0, 2], A[1, 2]))
    return CameraIntrinsics(int(info.width), int(info.height), fx, fy, cx, cy, model, distortion, rectified)


def window_of(info: Any, whole: CameraIntrinsics) -> CameraIntrinsics:
    """The intrinsics of the window that a camera reads out, each pixel the mean of some of the sensor.

    ``CameraInfo`` states those of the whole sensor, a region of interest, and how many pixels become one (``binning``).
    """
    roi, step_x, step_y = info.roi, max(int(info.binning_x), 1), max(int(info.binning_y), 1)
    return replace(
        whole,
        width=int(roi.width or whole.width) // step_x,
        height=int(roi.height or whole.height) // step_y,
        fx=whole.fx / step_x,
        fy=whole.fy / step_y,
        cx=(whole.cx - roi.x_offset) / step_x,
        cy=(whole.cy - roi.y_offset) / step_y,
    )


def stereo_pose(info: Any, image_topic: str) -> Array:
    """The camera's pose (4, 4) relative to the rectified left camera of its pair.

    P = K' [I | t] projects points of the rectified left camera, and R turns the camera's own frame into the rectified
    one (definition of ``sensor_msgs/CameraInfo``).
    """
    P, R = _array(info, "p").reshape(3, 4), _array(info, "r").reshape(3, 3)
    position_m = np.zeros(3) if P[0, 0] <= 0 else -np.linalg.solve(P[:, :3], P[:, 3])
    rotation = np.eye(3)
    if not is_rectified(image_topic) and is_rigid(flat(transform(R, [0.0, 0.0, 0.0]))):
        rotation = R
    return transform(rotation, position_m)


def has_baseline(info: Any) -> bool:
    """Tell if a ``CameraInfo`` is that of the right camera of a stereo pair."""
    P = _array(info, "p")
    return bool(P[0] > 0 and P[3] != 0)


def add_static_transforms(bag: SourceBag, graph: FrameGraph) -> None:
    """Add the transforms of ``/tf_static`` to ``graph``; those that are not rigid are left out."""
    for topic in bag.of_type(*TF_TYPES):
        if not topic.name.endswith("tf_static"):
            continue
        for number, (_, message) in enumerate(bag.stream(topic.name)):
            if number == _MOST_STATIC:
                break
            for entry in message.transforms:
                T = matrix_of(entry.transform.translation, entry.transform.rotation)
                if T is not None:
                    graph.add(plain_frame(entry.header.frame_id), plain_frame(entry.child_frame_id), T)


def matrix_of(translation: Any, rotation: Any) -> Array | None:
    """The transform (4, 4) of a ROS message, None if it is not rigid."""
    quat = np.array([rotation.x, rotation.y, rotation.z, rotation.w], dtype=np.float64)
    norm = float(np.linalg.norm(quat))
    if not 0.9 < norm < 1.1:
        return None
    T = pose_matrix([translation.x, translation.y, translation.z], quat)
    return T if is_rigid(flat(T)) else None


def plain_frame(frame_id: str) -> str:
    """A frame as ROS 2 writes it, without a slash in front."""
    return str(frame_id).lstrip("/")


def _distortion(info: Any, image_topic: str) -> tuple[CameraModel, tuple[float, ...]]:
    name = str(info.distortion_model)
    coefficients = tuple(float(value) for value in _array(info, "d"))
    if not any(coefficients):
        return CameraModel.PINHOLE, ()
    model = _MODELS.get(name)
    if model is None:
        raise InvalidInput(
            f"the CameraInfo of {image_topic} has distortion model {name!r}", f"known: {', '.join(_MODELS)}"
        )
    if len(coefficients) not in COEFFICIENTS[model]:
        raise InvalidInput(f"the CameraInfo of {image_topic} has {len(coefficients)} coefficients of {name}")
    return model, coefficients


def _array(info: Any, key: str) -> Array:
    """K, D, R or P: ROS 1 writes capitals, ROS 2 small letters."""
    values = getattr(info, key, None)
    return np.asarray(getattr(info, key.upper()) if values is None else values, dtype=np.float64)


_TF = "tf:"
"""Before the names of frames of the recording: those of sensors are names of their own."""
_MILLIMETRES, _METRES = 1000.0, 1.0
"""Values of a metre in 16UC1 and 32FC1 images (REP 118)."""
_BODIES = (SensorKind.IMU, SensorKind.CAMERA, SensorKind.LIDAR)
"""Which sensor's frame is the body, where ground truth and calibration do not say; the first one that is there."""


@dataclass(eq=False)
class SensorBuilder:
    """Makes the sensors of one recording.

    Attributes:
        bag: The recording.
        matching: Which topic is which sensor.
        known: What calibration files say.
        truth_frame: The frame whose poses the ground truth has, as the recording calls it; empty if not known.
        depth_units_per_m: The value of a depth pixel that means one metre, as users say.
        notes: What users should know; filled by :meth:`sensors`.
    """

    bag: SourceBag
    matching: Matching
    known: KnownCalibration
    truth_frame: str = ""
    depth_units_per_m: float | None = None
    notes: list[str] = field(default_factory=list)

    def sensors(self) -> tuple[tuple[Sensor, ...], tuple[int, int]]:
        """The sensors, and the first and the last timestamp of their headers in ns; raises InvalidInput."""
        spans = {name: self.bag.stamps_ns(topic.name) for name, topic in self.matching.topics.items()}
        graph, body = self._frames()
        made: list[Sensor] = []
        for name, topic in self.matching.topics.items():
            kind = self.matching.kind(name)
            first_ns, last_ns = spans[name]
            # Headers without times leave the times of the recording.
            if last_ns <= first_ns:
                first_ns, last_ns = self.bag.start_ns, self.bag.end_ns
                self.notes.append(f"{name} on {topic.name} has headers without increasing timestamps")
            if last_ns <= first_ns:
                raise InvalidInput(f"{self.bag.path}: all messages have one time", "two are needed at least")
            rate_hz = round((topic.count - 1) * NS_PER_S / (last_ns - first_ns), 6)
            calibration = self._calibration(name, kind, rate_hz, made)
            T_body_sensor = graph.find(body, name)
            if T_body_sensor is None:
                T_body_sensor = np.eye(4)
                graph.add(body, name, T_body_sensor)  # what is fixed to this sensor follows it
                self.notes.append(f"{name} has no known pose relative to {self._words(body)}: identity is assumed")
            matrix = tuple(float(value) for value in T_body_sensor.reshape(-1))
            made.append(Sensor(name, kind, topic.name, rate_hz, matrix, calibration))
        self.notes.append(f"the body frame is that of {self._words(body)}")
        self.notes += self.known.notes
        return tuple(made), (min(first for first, _ in spans.values()), max(last for _, last in spans.values()))

    def position_m(self, frame: str) -> tuple[float, ...] | None:
        """Position of a frame of the recording on the body, None if nothing says it."""
        graph, body = self._frames()
        T_body_frame = graph.find(body, _TF + frame)
        return None if T_body_frame is None else tuple(float(number) for number in T_body_frame[:3, 3])

    def _known(self, name: str, kind: SensorKind) -> KnownSensor | None:
        """Calibration of a sensor in files: that of its topic, otherwise that of its name."""
        topic = self.matching.topics[name].name
        own = [sensor for sensor in self.known.sensors if sensor.kind is kind]
        by_topic = [sensor for sensor in own if sensor.topic == topic]
        taken = {entry.name for entry in self.matching.topics.values()}
        by_name = [sensor for sensor in own if sensor.name == name and sensor.topic not in taken - {topic}]
        if not by_topic and len(by_name) > 1:
            topics = ", ".join(sensor.topic or "none" for sensor in by_name)
            raise InvalidInput(
                f"several calibrations are of a {name}, of topics {topics}; {topic} is none of them",
                "give one, or name its topic with --topic",
            )
        found = next(iter(by_topic or by_name), None)
        if found is not None and found.topic not in {"", topic}:
            note = f"the calibration of {name} names topic {found.topic}, and is used for {topic}"
            if note not in self.notes:
                self.notes.append(note)
        return found

    def _calibration(
        self, name: str, kind: SensorKind, rate_hz: float, made: list[Sensor]
    ) -> dict[str, CalibrationValue]:
        known = self._known(name, kind)
        more = {} if known is None else known.more
        if kind in {SensorKind.CAMERA, SensorKind.DEPTH}:
            return {**more, **self._camera(name, kind, known, made)}
        if kind is SensorKind.IMU:
            return {**more, **({} if known is None or known.noise is None else known.noise.calibration())}
        if kind is SensorKind.LIDAR:
            topic = self.matching.topics[name]
            first = self.bag.first(topic.name)
            layout, note = livox_layout(rate_hz) if topic.type in LIVOX else layout_of(first, rate_hz)
            self.notes.append(f"{name}: {note}")
            return {**layout.calibration(), **more}
        return dict(more)

    def _camera(
        self, name: str, kind: SensorKind, known: KnownSensor | None, made: list[Sensor]
    ) -> dict[str, CalibrationValue]:
        topic = self.matching.topics[name]
        message = self.bag.first(topic.name)
        picture = self.bag.first_picture(topic.name)
        height, width = picture.pixels.shape[:2]
        intrinsics = None if known is None else known.intrinsics
        if intrinsics is None:
            info = camera_info_of(self.bag, topic.name)
            intrinsics = None if info is None else intrinsics_of(info, topic.name)
            if intrinsics is not None and (intrinsics.width, intrinsics.height) != (width, height):
                window = window_of(info, intrinsics)
                if (window.width, window.height) == (width, height):
                    of = f"{intrinsics.width}x{intrinsics.height}"
                    self.notes.append(f"the CameraInfo of {name} is of {of} pixels; its window and binning are applied")
                    intrinsics = window
        partner = next((sensor for sensor in made if _shares_pixels(topic.name, width, height, sensor)), None)
        if intrinsics is None and kind is SensorKind.DEPTH and partner is not None:
            intrinsics = CameraIntrinsics.of(partner)
        if intrinsics is None:
            raise InvalidInput(
                f"camera {name} on {topic.name} has no calibration",
                f"give --calibration FILE, or leave it out with --topic {name}=none",
            )
        if (intrinsics.width, intrinsics.height) == (0, 0):
            intrinsics = replace(intrinsics, width=width, height=height)
        if (intrinsics.width, intrinsics.height) != (width, height):
            raise InvalidInput(
                f"images of {name} on {topic.name} are {width}x{height} pixels, "
                f"its calibration is of {intrinsics.width}x{intrinsics.height}",
                "give the calibration of this recording with --calibration FILE",
            )
        if is_odd(message, topic.type):
            written = getattr(message, "encoding", None) or message.format
            self.notes.append(f"images of {name} ({written}) become {picture.encoding}")
        if kind is not SensorKind.DEPTH:
            return intrinsics.calibration(picture.encoding)
        units_per_m = self.depth_units_per_m or (_METRES if picture.encoding == "32FC1" else _MILLIMETRES)
        registered: dict[str, Any] = {} if partner is None else {"registered_to": partner.name}
        return intrinsics.calibration(picture.encoding, units_per_m=units_per_m, **registered)

    def _frames(self) -> tuple[FrameGraph, str]:
        """All transforms that are known, those of calibration files first, and the body frame."""
        graph, topics = FrameGraph(), self.matching.topics
        names = {
            known.frame: name for name in topics for known in [self._known(name, self.matching.kind(name))] if known
        }
        for parent, child, T in self.known.transforms:
            graph.add(names.get(parent, parent), names.get(child, child), T)
        static = FrameGraph()
        add_static_transforms(self.bag, static)
        for parent, child, T in static.edges():
            graph.add(_TF + parent, _TF + child, T)
        owners_of: dict[str, list[str]] = {}
        for name, topic in self.matching.topics.items():
            message = self.bag.first(topic.name)
            # odometry is that of its child frame; the header has the fixed one
            frame = plain_frame(getattr(message, "child_frame_id", message.header.frame_id))
            if frame:
                owners_of.setdefault(frame, []).append(name)
        for frame, owners in owners_of.items():
            cameras = [name for name in owners if self.matching.kind(name) is SensorKind.CAMERA]
            for name in owners:
                if frame in static and (len(cameras) < 2 or name not in cameras):
                    graph.add(_TF + frame, name, np.eye(4))
        # A left camera followed by a right one with a baseline is a pair, as CameraInfo describes it.
        cameras = [name for name in self.matching.topics if self.matching.kind(name) is SensorKind.CAMERA]
        names_of_topics = {name: topics[name].name for name in cameras}
        for left, right in itertools.pairwise(cameras):
            infos = [camera_info_of(self.bag, names_of_topics[name]) for name in (left, right)]
            if infos[0] is None or infos[1] is None or has_baseline(infos[0]) or not has_baseline(infos[1]):
                continue
            pair = f"pair:{left}"
            for name, info in zip((left, right), infos, strict=True):
                if graph.find(left, name) is None or name == left:
                    graph.add(pair, name, stereo_pose(info, names_of_topics[name]))
        return graph, self._body(graph)

    def _body(self, graph: FrameGraph) -> str:
        """Frame of the ground truth if anything connects it to a sensor, else of the calibration or a sensor."""
        names = list(self.matching.topics)
        for frame in (_TF + self.truth_frame, BODY):
            if frame in graph and any(graph.find(frame, name) is not None for name in names):
                return frame
        kinds = {kind: name for name in reversed(names) for kind in [self.matching.kind(name)]}
        return next((kinds[kind] for kind in _BODIES if kind in kinds), names[0])

    @staticmethod
    def _words(body: str) -> str:
        return (
            f"frame {body.removeprefix(_TF)}"
            if body.startswith(_TF)
            else "the calibration file"
            if body == BODY
            else body
        )


def _shares_pixels(topic: str, width: int, height: int, camera: Sensor) -> bool:
    """Tell if a depth topic says that it is registered to a camera, and the sizes agree."""
    size = camera.calibration.get("width"), camera.calibration.get("height")
    named = "registered" in topic or "aligned_depth_to" in topic
    return camera.kind is SensorKind.CAMERA and named and size == (width, height)
