"""cuVSLAM under the container contract: stereo, stereo with IMU, or RGB-D. Unverified."""

from __future__ import annotations

import sys
from typing import Any

import cuvslam
import numpy as np
from cuvslam_input import ImuQueue, camera_numbers, check_version, depth, grey, imu_noise, pose_numbers

from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.trajectory import Poses, poses_of_rows


class CuVslam:
    """Tracks frame by frame. The frame of cuVSLAM's rig is that of the left camera."""

    def __init__(self, config: RunConfig) -> None:
        self._version = check_version(cuvslam.get_version())
        self._values = values = config.parameters
        self._roles = set(config.algorithm_remap)
        self._cameras = [role for role in ("left", "right") if role in self._roles]
        rig = cuvslam.Rig()
        rig.cameras = [camera_of(values, role) for role in self._cameras]
        if "imu" in self._roles:
            rig.imus = [imu_of(values)]
        # Without threads of its own, a run repeated is the same.
        slam = cuvslam.Slam.Config(sync_mode=not values["async_sba"]) if values["slam"] else None
        self._tracker = cuvslam.Tracker(rig, self._odometry(), slam_config=slam)
        self._slam = slam is not None
        self._imu = ImuQueue()
        self._stamps_s: list[float] = []
        self._rows: list[list[float]] = []

    def process(self, frame: Frame) -> bool:
        """Track one frame, after the IMU samples up to its timestamp."""
        if "imu" in self._roles:
            for sample in self._imu.due(frame.imu, frame.stamp_s):
                self._tracker.register_imu_measurement(0, measurement_of(sample))
        images = [grey(frame.image(role)) for role in self._cameras]
        depths = [depth(frame.image("depth"))] if "depth" in self._roles else None
        odometry, slam_pose = self._tracker.track(round(frame.stamp_s * 1e9), images, depths=depths)
        if odometry.world_from_rig is None:
            return False
        pose = slam_pose if self._slam and slam_pose is not None else odometry.world_from_rig.pose
        self._stamps_s.append(frame.stamp_s)
        self._rows.append([*map(float, pose.translation), *map(float, pose.rotation)])
        return True

    def finish(self) -> Poses:
        """The poses as they were when their frames were tracked."""
        return poses_of_rows(np.array(self._stamps_s), np.array(self._rows))

    def about(self) -> dict[str, Any]:
        """The version of the library."""
        return {"package": "cuvslam", "version": self._version}

    def _odometry(self) -> cuvslam.Odometry.Config:
        values, modes = self._values, cuvslam.Odometry.OdometryMode
        if "depth" in self._roles:
            settings = cuvslam.Odometry.RGBDSettings(
                depth_scale_factor=float(values["depth_units_per_m"]),
                depth_camera_id=0,
                enable_depth_stereo_tracking=False,
            )
            return cuvslam.Odometry.Config(
                async_sba=bool(values["async_sba"]), odometry_mode=modes.RGBD, rgbd_settings=settings
            )
        return cuvslam.Odometry.Config(
            async_sba=bool(values["async_sba"]),
            odometry_mode=modes.Inertial if "imu" in self._roles else modes.Multicamera,
            rectified_stereo_camera=all(bool(values.get(f"{role}_rectified")) for role in self._cameras),
        )


def camera_of(values: dict[str, Any], role: str) -> cuvslam.Camera:
    """The camera in ``role``, its pose in the frame of the left camera."""
    numbers = camera_numbers(values, role)
    camera = cuvslam.Camera()
    camera.size, camera.focal, camera.principal = numbers.size, numbers.focal, numbers.principal
    if numbers.model is not None:
        model = getattr(cuvslam.Distortion.Model, numbers.model)
        camera.distortion = cuvslam.Distortion(model, numbers.coefficients)
    camera.rig_from_camera = cuvslam.Pose(rotation=numbers.rotation_xyzw, translation=numbers.translation_m)
    return camera


def imu_of(values: dict[str, Any]) -> cuvslam.ImuCalibration:
    """The IMU with its noise."""
    imu = cuvslam.ImuCalibration()
    rotation, translation = pose_numbers(transform(values, "left", "imu"))
    imu.rig_from_imu = cuvslam.Pose(rotation=rotation, translation=translation)
    for name, value in imu_noise(values).items():
        setattr(imu, name, value)
    return imu


def measurement_of(sample: np.ndarray) -> cuvslam.ImuMeasurement:
    """One row ``t, gyro xyz, acc xyz``."""
    measurement = cuvslam.ImuMeasurement()
    measurement.timestamp_ns = round(float(sample[0]) * 1e9)
    measurement.angular_velocities = sample[1:4].tolist()
    measurement.linear_accelerations = sample[4:7].tolist()
    return measurement


if __name__ == "__main__":
    sys.exit(run(CuVslam))
