"""Calibration in the recording itself: ``CameraInfo`` messages and the transforms of ``/tf_static``."""

from __future__ import annotations

from typing import Any

import numpy as np

from slamhive.bags.formats.frame_graph import FrameGraph
from slamhive.bags.formats.source_bag import SourceBag
from slamhive.bags.formats.topics import camera_of
from slamhive.bags.geometry import Array, transform
from slamhive.domain.calibration import COEFFICIENTS, CameraIntrinsics, CameraModel
from slamhive.domain.sensors import is_rigid
from slamhive.errors import InvalidInput
from slamhive.trajectory.transforms import rotations_from_quats

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
    """Whether images are rectified, by the name that ROS gives to such topics."""
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


def stereo_pose(info: Any, image_topic: str) -> Array:
    """The camera's pose (4, 4) relative to the rectified left camera of its pair.

    P = K' [I | t] projects points of the rectified left camera, and R turns the camera's own frame into the rectified
    one (definition of ``sensor_msgs/CameraInfo``).
    """
    P, R = _array(info, "p").reshape(3, 4), _array(info, "r").reshape(3, 3)
    position_m = np.zeros(3) if P[0, 0] <= 0 else -np.linalg.solve(P[:, :3], P[:, 3])
    rotation = np.eye(3)
    if not is_rectified(image_topic) and is_rigid(tuple(transform(R, [0.0, 0.0, 0.0]).reshape(-1).tolist())):
        rotation = R
    return transform(rotation, position_m)


def has_baseline(info: Any) -> bool:
    """Whether a ``CameraInfo`` is that of the right camera of a stereo pair."""
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
    T = transform(rotations_from_quats(quat[None] / norm)[0], [translation.x, translation.y, translation.z])
    return T if is_rigid(tuple(T.reshape(-1).tolist())) else None


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
