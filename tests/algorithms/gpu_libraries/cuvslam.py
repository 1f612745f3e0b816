"""The interface of cuVSLAM's Python bindings 17.0.0, as far as its examples use it. It tracks nothing."""

from __future__ import annotations

from enum import Enum
from types import SimpleNamespace

import numpy as np

VERSION = ["17.0.0+cu12", 17, 0, 0]
made: list[Tracker] = []


def get_version():
    return tuple(VERSION)


class Pose:
    """Rotation (x, y, z, w) and translation."""

    def __init__(self, rotation=(0, 0, 0, 1), translation=(0, 0, 0)):
        assert len(rotation) == 4
        assert len(translation) == 3
        self.rotation, self.translation = np.float32(rotation), np.float32(translation)


class Distortion:
    """A model and its coefficients."""

    class Model(Enum):
        """The models, with the number of coefficients of each."""

        Brown = 5
        Fisheye = 4

    def __init__(self, model, parameters):
        assert len(parameters) == model.value
        self.model, self.parameters = model, parameters


class Camera:
    """A camera of a rig."""

    __slots__ = ("distortion", "focal", "principal", "rig_from_camera", "size")


class ImuCalibration:
    """The IMU of a rig."""

    __slots__ = (
        "accelerometer_noise_density",
        "accelerometer_random_walk",
        "frequency",
        "gyroscope_noise_density",
        "gyroscope_random_walk",
        "rig_from_imu",
    )


class ImuMeasurement:
    """One sample."""

    __slots__ = ("angular_velocities", "linear_accelerations", "timestamp_ns")


class Rig:
    """Cameras, and one IMU or none."""

    def __init__(self):
        self.cameras, self.imus = [], []


class Odometry:
    """Its settings."""

    class OdometryMode(Enum):
        """What it tracks with."""

        Multicamera = 0
        Inertial = 1
        RGBD = 2

    class RGBDSettings:
        """Settings for depth."""

        def __init__(self, *, depth_scale_factor, depth_camera_id, enable_depth_stereo_tracking):
            self.scale, self.camera, self.stereo = depth_scale_factor, depth_camera_id, enable_depth_stereo_tracking

    class Config:
        """Settings of the odometry."""

        def __init__(self, *, async_sba, odometry_mode, rectified_stereo_camera=False, rgbd_settings=None):
            self.async_sba, self.mode = async_sba, odometry_mode
            self.rectified, self.rgbd = rectified_stereo_camera, rgbd_settings


class Slam:
    """Its settings."""

    class Config:
        """Settings of loop closing."""

        def __init__(self, *, sync_mode):
            self.sync_mode = sync_mode


class Tracker:
    """Notes what it gets; finds no pose for the first image, and then one for each."""

    def __init__(self, rig, odom_config=None, slam_config=None):
        self.rig, self.odometry, self.slam = rig, odom_config, slam_config
        self.taken = []
        made.append(self)

    def register_imu_measurement(self, sensor_index, imu_measurement):
        assert sensor_index == 0
        assert len(imu_measurement.angular_velocities) == len(imu_measurement.linear_accelerations) == 3
        self.taken.append(imu_measurement)

    def track(self, timestamp, images, masks=None, depths=None):
        assert masks is None
        assert [image.dtype for image in images] == [np.uint8] * len(self.rig.cameras)
        assert all(image.ndim == 2 and image.flags.c_contiguous for image in images)
        assert depths is None or [image.dtype for image in depths] == [np.uint16]
        first = not any(hasattr(entry, "images") for entry in self.taken)
        self.taken.append(SimpleNamespace(timestamp_ns=timestamp, images=images, depths=depths))
        pose = None if first else SimpleNamespace(pose=Pose((0, 0, 0.6, 0.8), (timestamp / 1e9 - 1000, 0, 0)))
        slam = Pose((0, 0, 0, 1), (7, 7, 7)) if self.slam is not None else None
        return SimpleNamespace(world_from_rig=pose), slam
