"""Writes ROS 1 bags with standard sensor messages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Connection
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from slamhive.domain.calibration import CameraIntrinsics, LaserLayout
from slamhive.domain.sensors import Sensor

Array = NDArray[Any]

IMAGE = "sensor_msgs/msg/Image"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
POINTS = "sensor_msgs/msg/PointCloud2"
LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
NAV_SAT_FIX = "sensor_msgs/msg/NavSatFix"
_UNKNOWN_COVARIANCE, _DIAGONAL_COVARIANCE = 0, 2
"""``position_covariance_type`` of ``NavSatFix``."""
_FIELD_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
"""PointField's datatype constants by numpy kind and size."""

NS_PER_S = 1_000_000_000


EARLIEST_NS = 1
"""``rosbag play`` skips earlier messages: ``ros::TIME_MIN`` is 1 ns, since ROS 1 takes 0 for a time that is not set."""


def playable_ns(received_ns: int) -> int:
    """Time at which a ROS 1 bag says that a message was received; its timestamp stays as it is."""
    return max(received_ns, EARLIEST_NS)


def nanoseconds(seconds: float) -> int:
    """The timestamp nearest to ``seconds``."""
    return round(seconds * NS_PER_S)


class BagWriter:
    """Writes a ROS 1 bag; use as a context manager. Timestamps are integer nanoseconds.

    Connections appear in the bag in the order of their first message; header sequence numbers count from 0 for each
    topic. Nothing but the arguments ends up in the file, so equal input makes equal bytes.

    Args:
        path: A file that does not exist yet.
    """

    def __init__(self, path: Path) -> None:
        self._store = get_typestore(Stores.ROS1_NOETIC)
        self._writer = Writer(path)
        self._connections: dict[str, Connection] = {}
        self._counts: dict[str, int] = {}

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def image(
        self, sensor: Sensor, stamp_ns: int, pixels: Array, encoding: str, received_ns: int | None = None
    ) -> None:
        """A ``sensor_msgs/Image``; ``pixels`` is (h, w) or (h, w, channels) in the encoding's own type.

        It was received at ``received_ns``, unless given when it was measured.
        """
        data = np.ascontiguousarray(pixels)
        message = self._message(
            IMAGE,
            header=self._header(sensor.topic, stamp_ns, sensor.name),
            height=data.shape[0],
            width=data.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=data.strides[0],
            data=data.reshape(-1).view(np.uint8),
        )
        self._write(sensor.topic, IMAGE, stamp_ns if received_ns is None else received_ns, message)

    def camera_info(self, sensor: Sensor, topic: str, stamp_ns: int, baseline_m: float = 0.0) -> None:
        """The ``sensor_msgs/CameraInfo`` of a camera, ``baseline_m`` to the right of its left partner."""
        c = CameraIntrinsics.of(sensor)
        no_region = self._message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        distorted = any(c.distortion)
        message = self._message(
            CAMERA_INFO,
            header=self._header(topic, stamp_ns, sensor.name),
            height=c.height,
            width=c.width,
            distortion_model=c.ros_model,
            D=np.array(c.distortion) if distorted else np.zeros(5),
            K=np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1.0]),
            R=np.eye(3).reshape(-1),
            P=np.array([c.fx, 0, c.cx, -c.fx * baseline_m, 0, c.fy, c.cy, 0, 0, 0, 1.0, 0]),
            binning_x=0,
            binning_y=0,
            roi=no_region,
        )
        self._write(topic, CAMERA_INFO, stamp_ns, message)

    def imu(self, sensor: Sensor, stamp_ns: int, rate_radps: Array, force_mps2: Array) -> None:
        """A ``sensor_msgs/Imu`` without orientation (its covariance says so, as the message's definition asks)."""
        no_orientation = np.zeros(9)
        no_orientation[0] = -1.0
        message = self._message(
            IMU,
            header=self._header(sensor.topic, stamp_ns, sensor.name),
            orientation=self._message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=no_orientation,
            angular_velocity=self._vector(rate_radps),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(force_mps2),
            linear_acceleration_covariance=np.zeros(9),
        )
        self._write(sensor.topic, IMU, stamp_ns, message)

    def points(self, sensor: Sensor, stamp_ns: int, received_ns: int, points: Array) -> None:
        """A ``sensor_msgs/PointCloud2`` of a structured array (n,), stamped ``stamp_ns``, received later."""
        layout: Mapping[str, Any] = points.dtype.fields or {}
        fields = [
            self._message(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=place[1],
                datatype=_FIELD_CODES[place[0].str[1:]],
                count=1,
            )
            for name, place in layout.items()
        ]
        message = self._message(
            POINTS,
            header=self._header(sensor.topic, stamp_ns, sensor.name),
            height=1,
            width=len(points),
            fields=fields,
            is_bigendian=False,
            point_step=points.dtype.itemsize,
            row_step=points.dtype.itemsize * len(points),
            data=np.frombuffer(points.tobytes(), dtype=np.uint8),
            is_dense=True,
        )
        self._write(sensor.topic, POINTS, received_ns, message)

    def laser_scan(self, sensor: Sensor, stamp_ns: int, ranges_m: Array) -> None:
        """A ``sensor_msgs/LaserScan`` of ranges (n,), with the geometry that the calibration of ``sensor`` states."""
        layout, count = LaserLayout.of(sensor), len(ranges_m)
        message = self._message(
            LASER_SCAN,
            header=self._header(sensor.topic, stamp_ns, sensor.name),
            angle_min=layout.angle_min_rad,
            angle_max=layout.angle_min_rad + layout.angle_increment_rad * (count - 1),
            angle_increment=layout.angle_increment_rad,
            time_increment=layout.scan_duration_s / max(count - 1, 1),
            scan_time=1.0 / sensor.rate_hz,
            range_min=layout.minimum_range_m,
            range_max=layout.maximum_range_m,
            ranges=np.ascontiguousarray(ranges_m, dtype=np.float32),
            intensities=np.zeros(0, dtype=np.float32),
        )
        self._write(sensor.topic, LASER_SCAN, stamp_ns, message)

    def odometry(self, sensor: Sensor, stamp_ns: int, pose: Array, twist: Array) -> None:
        """A ``nav_msgs/Odometry`` of ``sensor`` in the frame ``odom``.

        Args:
            sensor: Where it comes from; its name is the child frame.
            stamp_ns: When it was measured.
            pose: Position and unit quaternion (7,): x y z in m, x y z w.
            twist: Velocity and angular rate in the child frame (6,), m/s and rad/s; NaN is unknown and becomes 0.
        """
        x, y, z, qx, qy, qz, qw = (float(number) for number in pose)
        known = np.nan_to_num(twist)
        pose_message = self._message(
            "geometry_msgs/msg/Pose",
            position=self._message("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._message("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )
        twist_message = self._message(
            "geometry_msgs/msg/Twist", linear=self._vector(known[:3]), angular=self._vector(known[3:])
        )
        none = np.zeros(36)
        message = self._message(
            ODOMETRY,
            header=self._header(sensor.topic, stamp_ns, "odom"),
            child_frame_id=sensor.name,
            pose=self._message("geometry_msgs/msg/PoseWithCovariance", pose=pose_message, covariance=none),
            twist=self._message("geometry_msgs/msg/TwistWithCovariance", twist=twist_message, covariance=none),
        )
        self._write(sensor.topic, ODOMETRY, stamp_ns, message)

    def nav_sat_fix(self, sensor: Sensor, stamp_ns: int, position: Array, variances_m2: Array | None = None) -> None:
        """A ``sensor_msgs/NavSatFix``: latitude and longitude in degrees, altitude in m; variances east, north, up."""
        status = self._message("sensor_msgs/msg/NavSatStatus", status=0, service=1)
        covariance = np.zeros(9) if variances_m2 is None else np.diag(np.asarray(variances_m2, dtype=np.float64))
        message = self._message(
            NAV_SAT_FIX,
            header=self._header(sensor.topic, stamp_ns, sensor.name),
            status=status,
            latitude=float(position[0]),
            longitude=float(position[1]),
            altitude=float(position[2]),
            position_covariance=np.ascontiguousarray(covariance).reshape(-1),
            position_covariance_type=_UNKNOWN_COVARIANCE if variances_m2 is None else _DIAGONAL_COVARIANCE,
        )
        self._write(sensor.topic, NAV_SAT_FIX, stamp_ns, message)

    def copy(self, connection: Connection, received_ns: int, raw: bytes, ros2: Typestore | None) -> None:
        """Copy a message of another recording; ``ros2`` has the types of one that ROS 2 serialised."""
        topic, kind = connection.topic, connection.msgtype
        if topic not in self._connections:
            self._connections[topic] = (
                self._writer.add_connection(topic, kind, typestore=self._store)
                if ros2 is not None
                else self._writer.add_connection(topic, kind, msgdef=connection.msgdef.data, md5sum=connection.digest)
            )
        # by the types of the source: those of ROS 1 expect a sequence number in the header
        converted = raw if ros2 is None else bytes(ros2.cdr_to_ros1(raw, kind))
        self._writer.write(self._connections[topic], playable_ns(received_ns), converted)

    def _message(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _vector(self, values: Array) -> Any:
        return self._message("geometry_msgs/msg/Vector3", x=float(values[0]), y=float(values[1]), z=float(values[2]))

    def _header(self, topic: str, stamp_ns: int, frame: str) -> Any:
        stamp = self._message("builtin_interfaces/msg/Time", sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)
        return self._message("std_msgs/msg/Header", seq=self._counts.get(topic, 0), stamp=stamp, frame_id=frame)

    def _write(self, topic: str, kind: str, received_ns: int, message: Any) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        raw = self._store.serialize_ros1(message, kind)
        self._writer.write(self._connections[topic], playable_ns(received_ns), raw)
        self._counts[topic] = self._counts.get(topic, 0) + 1
