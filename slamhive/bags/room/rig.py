"""The sensors on the body: where they sit and what they are. The body frame is the IMU's: x forward, y left, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.bags.geometry import Array, rotation_xyz, transform
from slamhive.bags.room.camera import Camera
from slamhive.bags.room.imu import ImuNoise
from slamhive.bags.room.lidar import LidarModel

BASELINE_M = 0.12
DEPTH_UNITS_PER_M = 1000
IMAGE_NOISE_GREY = 2.0
_FOCAL_PER_WIDTH = 0.66
_R_BODY_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Rig:
    """Extrinsics (``T_body_*``, 4x4) and models of all sensors."""

    camera: Camera
    lidar: LidarModel
    imu_noise: ImuNoise
    T_body_left: Array
    T_body_right: Array
    T_body_lidar: Array


def make_rig(width: int, height: int, lidar_rate_hz: float) -> Rig:
    """The rig with cameras of ``width`` x ``height`` pixels and a LiDAR turning at ``lidar_rate_hz``."""
    focal = _FOCAL_PER_WIDTH * width
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    tilted = rotation_xyz(np.deg2rad(0.8), np.deg2rad(2.0), np.deg2rad(-1.2)) @ _R_BODY_OPTICAL
    T_body_left = transform(tilted, [0.09, 0.06, 0.035])
    T_left_right = transform(np.eye(3), [BASELINE_M, 0.0, 0.0])
    T_body_lidar = transform(rotation_xyz(np.deg2rad(1.0), np.deg2rad(-1.5), np.deg2rad(4.0)), [-0.04, 0.015, 0.11])
    return Rig(
        camera=camera,
        lidar=LidarModel(scan_duration_s=1.0 / lidar_rate_hz),
        imu_noise=ImuNoise(),
        T_body_left=T_body_left,
        T_body_right=T_body_left @ T_left_right,
        T_body_lidar=T_body_lidar,
    )
