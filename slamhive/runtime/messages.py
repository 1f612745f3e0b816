"""Converts ROS messages to numpy: images, point clouds, laser scans, IMU samples, odometry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamhive.base.errors import InvalidInput

Array = NDArray[Any]

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
IMU = "sensor_msgs/msg/Imu"
POINTS = "sensor_msgs/msg/PointCloud2"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
SUPPORTED = (IMAGE, COMPRESSED_IMAGE, IMU, POINTS, LASER_SCAN, ODOMETRY)
BETWEEN_FRAMES = (IMU, ODOMETRY)
"""Messages that make no frame of their own: each frame has those that came since the frame before."""

_IMAGE_LAYOUTS: dict[str, tuple[str, int]] = {
    "mono8": ("u1", 1),
    "8UC1": ("u1", 1),
    "mono16": ("u2", 1),
    "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
    "rgb8": ("u1", 3),
    "bgr8": ("u1", 3),
    "8UC3": ("u1", 3),
    "rgba8": ("u1", 4),
    "bgra8": ("u1", 4),
}
"""Scalar type and channels of each encoding of ``sensor_msgs/image_encodings.hpp`` that is read."""
IMAGE_ENCODINGS = frozenset(_IMAGE_LAYOUTS)

_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""``PointField.datatype`` to numpy."""

_LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Weights of red, green and blue in luma (ITU-R BT.601), as OpenCV uses them."""


@dataclass(frozen=True, eq=False)
class PointCloud:
    """One LiDAR scan.

    Attributes:
        points_m: (n, 3) float64, in the sensor's frame, each at its own instant; no NaN, no infinity.
        fields: The other fields of the message by name, (n,) each, in the recording's own types.
    """

    points_m: Array
    fields: dict[str, Array]

    def field(self, name: str) -> Array:
        """The values (n,) of field ``name``; raises InvalidInput if the scan has no such field."""
        if name not in self.fields:
            raise InvalidInput(f"the scans have no field {name!r}", f"they have {', '.join(self.fields) or 'none'}")
        return self.fields[name]


@dataclass(frozen=True, eq=False)
class LaserScan:
    """One scan in the x-y plane of a laser scanner.

    Attributes:
        ranges_m: (n,) float64; NaN where nothing was measured: outside of the sensor's limits, or no number.
        angles_rad: (n,) float64, the direction of each range, counter-clockwise from the sensor's x axis.
        offsets_s: (n,) float64, when each range was measured after the timestamp of the message.
    """

    ranges_m: Array
    angles_rad: Array
    offsets_s: Array


def stamp_ns(message: Any) -> int:
    """The header's timestamp in nanoseconds."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def imu_row(message: Any) -> tuple[float, ...]:
    """One IMU sample as ``t, gyro xyz, acc xyz``: s, rad/s, m/s²."""
    rate, force = message.angular_velocity, message.linear_acceleration
    return (stamp_ns(message) * 1e-9, rate.x, rate.y, rate.z, force.x, force.y, force.z)


def odometry_row(message: Any) -> tuple[float, ...]:
    """Odometry as ``t, position xyz, quaternion xyzw, velocity xyz, angular rate xyz``: s, m, m/s, rad/s."""
    pose, twist = message.pose.pose, message.twist.twist
    p, q, v, w = pose.position, pose.orientation, twist.linear, twist.angular
    return (stamp_ns(message) * 1e-9, p.x, p.y, p.z, q.x, q.y, q.z, q.w, v.x, v.y, v.z, w.x, w.y, w.z)


def convert(message: Any, kind: str) -> Array | PointCloud | LaserScan:
    """An image as an array, points and laser scans as their classes; raises InvalidInput for what cannot be read."""
    if kind == LASER_SCAN:
        return to_laser_scan(message)
    if kind == IMAGE:
        return to_image(message)
    if kind == COMPRESSED_IMAGE:
        return _decode(message)
    return to_points(message)


def to_image(message: Any) -> Array:
    """The pixels, (h, w) or (h, w, 3) in the order red, green, blue, in the encoding's own type and byte order."""
    try:
        scalar, channels = _IMAGE_LAYOUTS[message.encoding]
    except KeyError:
        raise InvalidInput(
            f"image encoding {message.encoding!r} is not read", f"convert to one of {', '.join(_IMAGE_LAYOUTS)}"
        ) from None
    dtype = np.dtype((">" if message.is_bigendian else "<") + scalar)
    row_bytes = message.width * channels * dtype.itemsize
    data = np.asarray(message.data, dtype=np.uint8)
    if message.step < row_bytes or data.size < message.step * message.height:
        raise InvalidInput(
            f"an image of {message.width}x{message.height} {message.encoding} holds {data.size} bytes, "
            f"{row_bytes * message.height} expected"
        )
    rows = data[: message.step * message.height].reshape(message.height, message.step)[:, :row_bytes]
    pixels: Array = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    if channels == 1:
        return pixels
    colour = pixels.reshape(message.height, message.width, channels)[..., :3]
    ordered: Array = np.ascontiguousarray(colour[..., ::-1] if message.encoding.startswith("bgr") else colour)
    return ordered


def to_grey(image: Array) -> Array:
    """An image as (h, w) uint8: colour by luma, 16 bit by its upper byte."""
    if image.ndim == 3:
        return np.asarray(np.rint(image.astype(np.float32) @ _LUMA).astype(np.uint8))
    grey: Array = (image >> 8).astype(np.uint8) if image.dtype == np.uint16 else image
    return grey


def to_laser_scan(message: Any) -> LaserScan:
    """The ranges and directions of a ``sensor_msgs/LaserScan``."""
    ranges_m = np.asarray(message.ranges, dtype=np.float64)
    numbers = np.arange(len(ranges_m))
    with np.errstate(invalid="ignore"):
        measured = (ranges_m >= message.range_min) & (ranges_m <= message.range_max)
    angles_rad = message.angle_min + numbers * message.angle_increment
    return LaserScan(np.where(measured, ranges_m, np.nan), angles_rad, numbers * float(message.time_increment))


def to_points(message: Any) -> PointCloud:
    """The finite points of a ``PointCloud2``; raises InvalidInput if it lacks x, y or z."""
    order = ">" if message.is_bigendian else "<"
    entries = [field for field in message.fields if field.datatype in _POINT_TYPES and field.count == 1]
    names = [field.name for field in entries]
    if not {"x", "y", "z"} <= set(names):
        raise InvalidInput(f"a point cloud has the fields {', '.join(names) or 'none'}; x, y, z are needed")
    layout = np.dtype(
        {
            "names": names,
            "formats": [order + _POINT_TYPES[field.datatype] for field in entries],
            "offsets": [field.offset for field in entries],
            "itemsize": message.point_step,
        }
    )
    data = np.asarray(message.data, dtype=np.uint8)
    if message.row_step < message.width * message.point_step or data.size < message.row_step * message.height:
        raise InvalidInput(
            f"a point cloud of {message.width}x{message.height} points holds {data.size} bytes, "
            f"{message.width * message.height * message.point_step} expected"
        )
    rows = data[: message.row_step * message.height].reshape(message.height, message.row_step)
    packed = np.ascontiguousarray(rows[:, : message.width * message.point_step])
    table = packed.reshape(-1).view(layout)
    points_m = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    finite = np.isfinite(points_m).all(axis=1)
    others = {name: np.ascontiguousarray(table[name][finite]) for name in names if name not in {"x", "y", "z"}}
    return PointCloud(points_m[finite], others)


def _decode(message: Any) -> Array:
    try:
        import cv2  # noqa: PLC0415 - only images with compressed recordings need it
    except ImportError:
        raise InvalidInput(
            "the recording holds compressed images, which need OpenCV", "add opencv-python-headless to the package"
        ) from None
    pixels: Array | None = cv2.imdecode(np.asarray(message.data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InvalidInput(f"a compressed image of format {message.format!r} cannot be decoded")
    if pixels.ndim == 3:
        pixels = np.ascontiguousarray(pixels[..., 2::-1])
    return pixels
