"""Writes recordings: ROS 1 bags with standard sensor messages, ROS 2 folders, and single ``.mcap`` or ``.db3``."""

from __future__ import annotations

import errno
import shutil
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapReader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from slamhive.base.errors import InvalidInput
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
        self._writer = Ros1Writer(path)
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
            data=np.ascontiguousarray(points).view(np.uint8),
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


# Writes ROS 2 recordings: a folder (SQLite or MCAP), or a single ``.mcap`` or ``.db3`` file.
#
# A recording that is made from another one keeps its storage, compression, type definitions and quality of service.


MCAP_SUFFIX, SQLITE_SUFFIX = ".mcap", ".db3"
_SUFFIXES = {StoragePlugin.MCAP: MCAP_SUFFIX, StoragePlugin.SQLITE3: SQLITE_SUFFIX}
_VERSION: Literal[8] = 8
"""Of the metadata. Version 9 writes quality of service in another form, which older readers do not know."""
_UNKNOWN_HASH = "unknown"


@dataclass(frozen=True, slots=True)
class Rosbag2Storage:
    """Storage of a ROS 2 recording; ``plain`` is a single file without the folder around it."""

    plugin: StoragePlugin
    compression: CompressionMode = CompressionMode.NONE
    plain: bool = False


PLAIN_MCAP = Rosbag2Storage(StoragePlugin.MCAP, plain=True)
SQLITE_FOLDER = Rosbag2Storage(StoragePlugin.SQLITE3)


def storage_of(path: Path, reader: AnyReader) -> Rosbag2Storage:
    """Storage of the open recording at ``path``."""
    (recording,) = reader.readers
    assert isinstance(recording, Reader)
    files = mcap_files(reader)
    mode = CompressionMode[(recording.compression_mode or "none").upper()]
    if mode is CompressionMode.NONE and any(chunk.compression for file in files for chunk in file.chunks):
        mode = CompressionMode.STORAGE
    return Rosbag2Storage(StoragePlugin.MCAP if files else StoragePlugin.SQLITE3, mode, plain=not path.is_dir())


def mcap_files(reader: AnyReader) -> list[McapReader]:
    """The open MCAP files of a recording."""
    (recording,) = reader.readers
    assert isinstance(recording, Reader)
    files = getattr(recording.storage, "storages", [recording.storage])
    return [file for file in files if isinstance(file, McapReader)]


@contextmanager
def rosbag2_writer(target: Path, storage: Rosbag2Storage) -> Iterator[Writer]:
    """An open writer of the recording ``target``, which must not exist; the name of a plain one has the right suffix.

    Equal messages and connections make equal bytes. Raises OSError where ``target`` cannot be written.
    """
    folder = target
    if storage.plain:
        around = target.with_name(f".{target.name}.partial")
        folder = around / target.stem
    writer = Writer(folder, version=_VERSION, storage_plugin=storage.plugin)
    writer.set_compression(storage.compression, CompressionFormat.ZSTD)
    try:
        with writer:
            yield writer
        if storage.plain:
            (folder / f"{target.stem}{_SUFFIXES[storage.plugin]}").replace(target)
    except sqlite3.Error as error:
        raise OSError(errno.EIO, str(error), str(target)) from error
    finally:
        if storage.plain:
            shutil.rmtree(around, ignore_errors=True)


def copy_connection(writer: Writer, connection: Connection, reader: AnyReader) -> Connection:
    """Add a connection of ``reader``, a ROS 2 recording, with its definition and quality of service.

    A definition that the recording lacks is added if the standard types contain it. Messages of other types are
    copied without one. Raises InvalidInput where MCAP cannot hold that.
    """
    definition, digest = _definition(connection, reader)
    if definition is None:
        if writer.storage_plugin is StoragePlugin.MCAP:
            raise InvalidInput(
                f"{connection.topic} carries {connection.msgtype}, and the recording does not define this type",
                "record the definition, or remove the topic",
            )
        writer.added_types.add(connection.msgtype)
    extension = connection.ext
    assert isinstance(extension, ConnectionExtRosbag2)
    return writer.add_connection(
        connection.topic,
        connection.msgtype,
        msgdef=definition or "",
        rihs01=digest,
        serialization_format=extension.serialization_format,
        offered_qos_profiles=extension.offered_qos_profiles,
    )


def _definition(connection: Connection, reader: AnyReader) -> tuple[str | None, str]:
    """The text of a type's definition, None if nobody knows it, and its hash."""
    kind = connection.msgtype
    if kind not in reader.typestore.fielddefs:
        return None, connection.digest or _UNKNOWN_HASH
    digest = connection.digest or reader.typestore.hash_rihs01(kind)
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        return connection.msgdef.data, digest
    return reader.typestore.generate_msgdef(kind, ros_version=2)[0], digest
