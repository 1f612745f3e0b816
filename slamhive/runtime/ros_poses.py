"""Poses out of messages of ROS 1 and ROS 2. Works on anything that has their fields, so it needs no ROS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from slamhive.runtime.trajectory import Array, Poses, transform_from


class PoseKind(StrEnum):
    """The message types from which poses are read, as ROS 1 names them."""

    ODOMETRY = "nav_msgs/Odometry"
    POSE = "geometry_msgs/PoseStamped"
    PATH = "nav_msgs/Path"
    """Each message is the whole trajectory so far; the last one counts."""
    TF = "tf2_msgs/TFMessage"
    """The pose of the frame ``child`` in the frame ``parent``, along the tree of frames."""


@dataclass(frozen=True, slots=True)
class PoseTopic:
    """Where poses come from. ``parent`` and ``child`` are for :attr:`PoseKind.TF` alone."""

    topic: str
    kind: PoseKind
    parent: str = ""
    child: str = ""


@dataclass
class PoseLog:
    """The poses of one topic as they arrive.

    Attributes:
        source: The topic.
        arrivals: (timestamp, arrival) of each pose, both in s; of a path its newest pose.
    """

    source: PoseTopic
    arrivals: list[tuple[float, float]] = field(default_factory=list)
    _poses: dict[float, Array] = field(default_factory=dict)
    _edges: dict[str, tuple[str, Array]] = field(default_factory=dict)

    def add(self, message: Any, arrived_s: float) -> None:
        """Take one message that arrived at ``arrived_s`` of any monotonic clock."""
        _TAKERS[self.source.kind](self, message, arrived_s)

    @property
    def poses(self) -> Poses:
        """One pose for each timestamp; the newest where several have the same."""
        found = dict(self._poses)
        stamps_s = sorted(found)
        return Poses(np.array(stamps_s), np.array([found[stamp_s] for stamp_s in stamps_s]).reshape(-1, 4, 4))

    def _take(self, stamp_s: float, T: Array, arrived_s: float) -> None:
        self._poses[stamp_s] = T
        self.arrivals.append((stamp_s, arrived_s))

    def _take_odometry(self, message: Any, arrived_s: float) -> None:
        self._take(_seconds(message.header), _transform(message.pose.pose), arrived_s)

    def _take_pose(self, message: Any, arrived_s: float) -> None:
        self._take(_seconds(message.header), _transform(message.pose), arrived_s)

    def _take_path(self, message: Any, arrived_s: float) -> None:
        if message.poses:
            self._poses = {_seconds(entry.header): _transform(entry.pose) for entry in message.poses}
            self.arrivals.append((_seconds(message.poses[-1].header), arrived_s))

    def _take_tf(self, message: Any, arrived_s: float) -> None:
        for edge in message.transforms:
            child = edge.child_frame_id.lstrip("/")
            moved = edge.transform.translation, edge.transform.rotation
            self._edges[child] = (edge.header.frame_id.lstrip("/"), _matrix(*moved))
            if child == self.source.child:
                T = self._pose_in_parent()
                if T is not None:
                    self._take(_seconds(edge.header), T, arrived_s)

    def _pose_in_parent(self) -> Array | None:
        """Along the newest edges from the child up; None while the parent cannot be reached."""
        frame, T = self.source.child, np.eye(4)
        for _ in range(len(self._edges) + 1):
            if frame == self.source.parent:
                return T
            if frame not in self._edges:
                return None
            frame, T_frame_child = self._edges[frame]
            T = T_frame_child @ T
        return None


_TAKERS: dict[PoseKind, Callable[[PoseLog, Any, float], None]] = {
    PoseKind.ODOMETRY: PoseLog._take_odometry,
    PoseKind.POSE: PoseLog._take_pose,
    PoseKind.PATH: PoseLog._take_path,
    PoseKind.TF: PoseLog._take_tf,
}


def in_sensor_axes(T: Array, R_system_sensor: Array) -> Array:
    """(n, 4, 4) poses, stated in the axes of the system on both sides, in those of the sensor."""
    C = np.eye(4)
    C[:3, :3] = R_system_sensor
    turned: Array = C.T @ T @ C
    return turned


def _seconds(header: Any) -> float:
    """The timestamp in s; ROS 1 names its parts ``secs`` and ``nsecs``, ROS 2 ``sec`` and ``nanosec``."""
    stamp = header.stamp
    return float(stamp.to_sec() if hasattr(stamp, "to_sec") else stamp.sec + stamp.nanosec * 1e-9)


def _transform(pose: Any) -> Array:
    return _matrix(pose.position, pose.orientation)


def _matrix(position: Any, orientation: Any) -> Array:
    return transform_from(
        np.array([position.x, position.y, position.z]),
        np.array([orientation.x, orientation.y, orientation.z, orientation.w]),
    )
