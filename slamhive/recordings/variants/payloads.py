"""Sensor messages to the arrays that steps work on, and back.

Messages are objects with the attributes of their ROS type, as rosbags makes them of either ROS generation. Everything
of a message that the array does not hold is kept.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import cv2
import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import SensorKind
from slamhive.recordings.variants.step import Array

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
POINTS = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"

TYPES_BY_KIND = {
    SensorKind.CAMERA: (IMAGE, COMPRESSED_IMAGE),
    SensorKind.DEPTH: (IMAGE, COMPRESSED_IMAGE),
    SensorKind.LIDAR: (POINTS,),
    SensorKind.IMU: (IMU,),
}
"""What a sensor's topic may carry for its messages to be changed; any type can be thinned."""

EQUAL_SIZES = frozenset({IMAGE, CAMERA_INFO, IMU})
"""Types whose messages on one topic are all equally large, as a rule."""

JPEG_QUALITY = 95
"""Of images encoded again: high, so that a variant shows what its steps did and little of the codec."""

_NAMED_ENCODINGS = {
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    "bgr8": ("u1", 3),
    "rgb8": ("u1", 3),
    "bgra8": ("u1", 4),
    "rgba8": ("u1", 4),
    "bgr16": ("u2", 3),
    "rgb16": ("u2", 3),
}
_GENERIC_ENCODING = re.compile(r"(8U|8S|16U|16S|32S|32F|64F)C([1-4])")
_GENERIC_TYPES = {"8U": "u1", "8S": "i1", "16U": "u2", "16S": "i2", "32S": "i4", "32F": "f4", "64F": "f8"}
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_DEPTH_HEADER_BYTES = 12
"""Of ``compressedDepth`` images: a format and two parameters, unused for 16UC1 (compressed_depth_image_transport)."""


class Codec(Protocol):
    """A message's array, and the message with another array in its place; raises InvalidInput."""

    def decode(self, message: Any, topic: str) -> Array:
        """The array; read only, or shared with the message."""
        ...

    def encode(self, message: Any, payload: Array) -> Any:
        """A new message."""
        ...


class ImageCodec:
    """``sensor_msgs/Image``: (h, w) or (h, w, channels)."""

    def decode(self, message: Any, topic: str) -> Array:
        """The pixels, without the padding of rows."""
        generic = _GENERIC_ENCODING.fullmatch(message.encoding)
        if generic is not None:
            code, channels = _GENERIC_TYPES[generic[1]], int(generic[2])
        elif message.encoding in _NAMED_ENCODINGS:
            code, channels = _NAMED_ENCODINGS[message.encoding]
        else:
            raise InvalidInput(
                f"{topic}: images of encoding {message.encoding!r} cannot be changed",
                f"supported: {', '.join(_NAMED_ENCODINGS)} and plain arrays such as 16UC1; Bayer and YUV images need a "
                "conversion first",
            )
        dtype = np.dtype(code).newbyteorder(">" if message.is_bigendian else "<")
        row_bytes = message.width * dtype.itemsize * channels
        if message.step < row_bytes or len(message.data) != message.step * message.height:
            raise InvalidInput(
                f"{topic}: an image of {message.width}x{message.height} {message.encoding} has {len(message.data)} "
                f"bytes in rows of {message.step}"
            )
        rows = np.asarray(message.data).reshape(message.height, message.step)[:, :row_bytes]
        pixels = np.ascontiguousarray(rows).view(dtype)
        if not dtype.isnative:
            pixels = pixels.astype(dtype.newbyteorder("="))
        return pixels if channels == 1 else pixels.reshape(message.height, message.width, channels)

    def encode(self, message: Any, payload: Array) -> Any:
        """The same encoding, rows without padding, little endian."""
        pixels = np.ascontiguousarray(payload)
        height, width = pixels.shape[:2]
        data = pixels.reshape(-1).view(np.uint8)
        return replace(message, height=height, width=width, is_bigendian=0, step=len(data) // height, data=data)


class CompressedImageCodec:
    """``sensor_msgs/CompressedImage`` in JPEG or PNG, depth images of type 16UC1 included."""

    def decode(self, message: Any, topic: str) -> Array:
        """The pixels in the file's own depth and channels; three come as blue, green, red."""
        _file_ending(message.format, topic)
        pixels = cv2.imdecode(np.asarray(message.data)[_prefix_bytes(message) :], cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise InvalidInput(f"{topic}: an image of format {message.format!r} cannot be decoded")
        return pixels

    def encode(self, message: Any, payload: Array) -> Any:
        """The same format; JPEG in quality :data:`JPEG_QUALITY`."""
        ending = _file_ending(message.format, "")
        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if ending == ".jpg" else []
        done, data = cv2.imencode(ending, payload, options)
        assert done, f"OpenCV encodes arrays of {payload.dtype} as {ending}"
        prefix = np.asarray(message.data)[: _prefix_bytes(message)]
        return replace(message, data=np.concatenate([prefix, data]) if len(prefix) else data)


class PointsCodec:
    """``sensor_msgs/PointCloud2``: a structured array (n,) with the cloud's fields."""

    def decode(self, message: Any, topic: str) -> Array:
        """All points, row by row."""
        size_bytes, row_bytes = message.row_step * message.height, message.width * message.point_step
        if len(message.data) < size_bytes or message.row_step < row_bytes:
            raise InvalidInput(f"{topic}: a point cloud of {len(message.data)} bytes does not fit its own description")
        dtype = np.dtype(
            {
                "names": [field.name for field in message.fields],
                "formats": [_point_format(field, topic, big=message.is_bigendian) for field in message.fields],
                "offsets": [field.offset for field in message.fields],
                "itemsize": message.point_step,
            }
        )
        rows = np.asarray(message.data)[:size_bytes].reshape(message.height, message.row_step)
        used = np.ascontiguousarray(rows[:, :row_bytes])
        points = used.reshape(-1).view(dtype)
        # bytes between the fields of another order are not kept: nothing says in which order they are
        return points.astype(dtype.newbyteorder("<")) if message.is_bigendian else points

    def encode(self, message: Any, payload: Array) -> Any:
        """Pack as many rows as before if no point is gone, one row otherwise; little endian."""
        height, width = message.height, message.width
        if len(payload) != height * width:
            height, width = 1, len(payload)
        data = np.frombuffer(payload.tobytes(), np.uint8)
        row_step = width * message.point_step
        return replace(message, height=height, width=width, is_bigendian=False, row_step=row_step, data=data)


class ImuCodec:
    """``sensor_msgs/Imu``: float64 (6,), angular velocity (rad/s), then specific force (m/s²)."""

    def decode(self, message: Any, topic: str) -> Array:  # noqa: ARG002 - nothing can be wrong with six numbers
        """The six numbers."""
        rate, force = message.angular_velocity, message.linear_acceleration
        return np.array([rate.x, rate.y, rate.z, force.x, force.y, force.z])

    def encode(self, message: Any, payload: Array) -> Any:
        """Orientation and covariances stay."""
        x, y, z, force_x, force_y, force_z = (float(value) for value in payload)
        return replace(
            message,
            angular_velocity=replace(message.angular_velocity, x=x, y=y, z=z),
            linear_acceleration=replace(message.linear_acceleration, x=force_x, y=force_y, z=force_z),
        )


CODECS: dict[str, Codec] = {
    IMAGE: ImageCodec(),
    COMPRESSED_IMAGE: CompressedImageCodec(),
    POINTS: PointsCodec(),
    IMU: ImuCodec(),
}

Edit = Callable[[Any, int, int], Any]
"""``edit(message, index, received_ns)``: the changed message."""


def _file_ending(text: str, topic: str) -> str:
    """The codec named by a compressed image's format, such as ``png``, ``rgb8; jpeg compressed bgr8``."""
    lower = text.lower()
    if "compresseddepth" in lower and not lower.startswith("16uc1"):
        raise InvalidInput(f"{topic}: compressed depth of format {text!r} cannot be changed", "supported: 16UC1")
    if "jpeg" in lower or "jpg" in lower:
        return ".jpg"
    if "png" in lower or "compresseddepth" in lower:
        return ".png"
    raise InvalidInput(f"{topic}: images of format {text!r} cannot be changed", "supported: JPEG and PNG")


def _prefix_bytes(message: Any) -> int:
    return _DEPTH_HEADER_BYTES if "compresseddepth" in message.format.lower() else 0


def _point_format(field: Any, topic: str, *, big: bool) -> Any:
    if field.datatype not in _POINT_TYPES:
        raise InvalidInput(f"{topic}: point field {field.name} is of unknown type {field.datatype}")
    code = (">" if big else "<") + _POINT_TYPES[field.datatype]
    return code if field.count == 1 else (code, (field.count,))
