#!/usr/bin/python3
"""A node that integrates an IMU, and publishes a pose on /tf for each sweep of the LiDAR. Replace it by your system.

Positions drift, because the velocity at the start and the biases are unknown. The orientation is good for minutes.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import rospy
from geometry_msgs.msg import TransformStamped
from sensor_msgs.msg import Imu, PointCloud2
from tf2_msgs.msg import TFMessage


class DeadReckoning:
    """Integrates angular rate (rad/s) and acceleration (m/s²); the world's z axis points up."""

    def __init__(self, gravity: float, settling_s: float) -> None:
        self._gravity = np.array([0.0, 0.0, gravity])
        self._settling_s = settling_s
        self._first: list[np.ndarray] = []
        self._start_s = self._last_s = -1.0
        self._velocity = np.zeros(3)
        self.position_m = np.zeros(3)
        self.R_world_imu = np.eye(3)
        self._waiting: deque[Any] = deque(maxlen=100)
        self._poses: deque[tuple[float, np.ndarray, np.ndarray]] = deque(maxlen=1000)

    def add(self, stamp_s: float, rate: np.ndarray, acceleration: np.ndarray) -> None:
        """Take one sample."""
        if self._start_s < 0:
            self._start_s = self._last_s = stamp_s
        step_s, self._last_s = stamp_s - self._last_s, stamp_s
        if stamp_s - self._start_s < self._settling_s:
            self._first.append(acceleration)
            return
        if self._first:
            self.R_world_imu = level(np.mean(self._first, axis=0))
            self._first.clear()
        self.R_world_imu = self.R_world_imu @ rotation(rate * step_s)
        moved = self.R_world_imu @ acceleration - self._gravity
        self.position_m = self.position_m + self._velocity * step_s + 0.5 * moved * step_s**2
        self._velocity = self._velocity + moved * step_s
        self._poses.append((stamp_s, self.position_m, self.R_world_imu))

    def want(self, stamp: Any) -> None:
        """Ask for the pose at ``stamp``: messages of two topics come in any order."""
        self._waiting.append(stamp)

    def found(self) -> Iterator[tuple[Any, np.ndarray, np.ndarray]]:
        """Timestamp, position and rotation of poses that were asked for, as soon as the IMU has come that far."""
        while self._poses and self._waiting and self._waiting[0].to_sec() <= self._poses[-1][0]:
            stamp = self._waiting.popleft()
            _, position_m, R_world_imu = min(self._poses, key=lambda pose: abs(pose[0] - stamp.to_sec()))
            if stamp.to_sec() >= self._poses[0][0]:
                yield stamp, position_m, R_world_imu


def rotation(vector: np.ndarray) -> np.ndarray:
    """The rotation by a small vector (rad), Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle > 0 else vector
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turned: np.ndarray = np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K
    return turned


def level(acceleration: np.ndarray) -> np.ndarray:
    """The rotation without yaw that turns ``acceleration``, which points up at rest, to the z axis."""
    up = acceleration / np.linalg.norm(acceleration)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    return rotation(axis / sine * np.arctan2(sine, up[2])) if sine > 0 else np.eye(3)


def quaternion_xyzw(R: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation, from the eigenvector of the largest eigenvalue (Bar-Itzhack 2000)."""
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
        ]
    )
    largest: np.ndarray = np.linalg.eigh(K)[1][:, -1]
    return largest


def main() -> None:
    """Listen to ``imu/data`` and ``velodyne_points``, and publish."""
    rospy.init_node("my_slam")
    system = DeadReckoning(rospy.get_param("~gravity", 9.81), rospy.get_param("~settling", 0.2))
    publisher = rospy.Publisher("/tf", TFMessage, queue_size=1000)

    lock = threading.Lock()

    def publish() -> None:
        for pose in system.found():
            publisher.publish(TFMessage([message_of(*pose)]))

    def take_imu(message: Any) -> None:
        rate, acceleration = message.angular_velocity, message.linear_acceleration
        with lock:
            system.add(
                message.header.stamp.to_sec(),
                np.array([rate.x, rate.y, rate.z]),
                np.array([acceleration.x, acceleration.y, acceleration.z]),
            )
            publish()

    def take_points(message: Any) -> None:
        with lock:
            system.want(message.header.stamp)
            publish()

    rospy.Subscriber("imu/data", Imu, take_imu, queue_size=10_000, tcp_nodelay=True)
    rospy.Subscriber("velodyne_points", PointCloud2, take_points, queue_size=10, tcp_nodelay=True)
    rospy.spin()


def message_of(stamp: Any, position_m: np.ndarray, R_world_imu: np.ndarray) -> Any:
    """The pose of the IMU in the world as a message."""
    pose = TransformStamped(child_frame_id="imu")
    pose.header.stamp, pose.header.frame_id = stamp, "world"
    at, turned = pose.transform.translation, pose.transform.rotation
    at.x, at.y, at.z = position_m
    turned.x, turned.y, turned.z, turned.w = quaternion_xyzw(R_world_imu)
    return pose


if __name__ == "__main__":
    main()
