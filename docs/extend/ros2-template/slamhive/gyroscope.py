"""A node that turns with the gyroscope and stays where it is. Replace it by your system."""

from __future__ import annotations

from typing import Any

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.node import Node
from sensor_msgs.msg import Imu, PointCloud2


class Turning(Node):  # type: ignore[misc]
    """Publishes the orientation of the IMU on ``/odom``, for each message on ``points``."""

    def __init__(self) -> None:
        super().__init__("my_slam")
        self._quat_wxyz = np.array([1.0, 0.0, 0.0, 0.0])
        self._last_s: float | None = None
        self._publisher = self.create_publisher(Odometry, "/odom", 100)
        self.create_subscription(Imu, "imu", self._turn, 1000)
        self.create_subscription(PointCloud2, "points", self._publish, 10)

    def _turn(self, message: Any) -> None:
        now_s = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        step_s = 0.0 if self._last_s is None else now_s - self._last_s
        self._last_s = now_s
        rate = message.angular_velocity
        x, y, z = 0.5 * step_s * np.array([rate.x, rate.y, rate.z])
        w0, x0, y0, z0 = self._quat_wxyz
        turned = np.array(
            [
                w0 - x0 * x - y0 * y - z0 * z,
                x0 + w0 * x + y0 * z - z0 * y,
                y0 + w0 * y + z0 * x - x0 * z,
                z0 + w0 * z + x0 * y - y0 * x,
            ]
        )
        self._quat_wxyz = turned / np.linalg.norm(turned)

    def _publish(self, message: Any) -> None:
        pose = Odometry()
        pose.header.stamp = message.header.stamp
        pose.header.frame_id, pose.child_frame_id = "world", "imu"
        turned = pose.pose.pose.orientation
        turned.w, turned.x, turned.y, turned.z = self._quat_wxyz.tolist()
        self._publisher.publish(pose)


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(Turning())
