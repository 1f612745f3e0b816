"""cuVSLAM under the container contract: stereo, stereo with IMU, or RGB-D. Unverified."""

from __future__ import annotations

import sys
from typing import Any

import cuvslam
import numpy as np

from slamhive.errors import InvalidInput
from slamhive.runtime.app import run
from slamhive.runtime.calibration import EQUIDISTANT, RADTAN, check_model, distortion, transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.messages import to_grey
from slamhive.runtime.trajectory import Poses, quaternions_xyzw, transform_from

NOISES = (
    "gyroscope_noise_density",
    "gyroscope_random_walk",
    "accelerometer_noise_density",
    "accelerometer_random_walk",
)


class CuVslam:
    """Tracks frame by frame. The frame of cuVSLAM's rig is that of the left camera."""

    def __init__(self, config: RunConfig) -> None:
        self._values = values = config.parameters
        self._roles = set(config.algorithm_remap)
        self._cameras = [role for role in ("left", "right") if role in self._roles]
        rig = cuvslam.Rig()
        rig.cameras = [camera_of(values, role) for role in self._cameras]
        if "imu" in self._roles:
            rig.imus = [imu_of(values)]
        slam = cuvslam.Slam.Config() if values["slam"] else None
        self._tracker = cuvslam.Tracker(rig, self._odometry(), slam_config=slam)
        self._slam = slam is not None
        self._imu = np.empty((0, 7))
        self._stamps_s: list[float] = []
        self._poses: list[np.ndarray] = []

    def process(self, frame: Frame) -> bool:
        """Track one frame, after the IMU samples up to its timestamp; later ones are kept for the next."""
        stamp_ns = round(frame.stamp_s * 1e9)
        if "imu" in self._roles:
            samples = np.concatenate([self._imu, frame.imu])
            due = samples[:, 0] <= frame.stamp_s
            self._imu = samples[~due]
            for sample in samples[due]:
                self._tracker.register_imu_measurement(0, measurement_of(sample))
        images = [np.ascontiguousarray(to_grey(frame.image(role))) for role in self._cameras]
        depths = [np.ascontiguousarray(frame.image("depth"), dtype=np.uint16)] if "depth" in self._roles else None
        odometry, slam_pose = self._tracker.track(stamp_ns, images, depths=depths)
        if odometry.world_from_rig is None:
            return False
        pose = slam_pose if self._slam and slam_pose is not None else odometry.world_from_rig.pose
        self._stamps_s.append(frame.stamp_s)
        self._poses.append(transform_from(np.array(pose.translation), np.array(pose.rotation)))
        return True

    def finish(self) -> Poses:
        """The poses as they were when their frames were tracked."""
        return Poses(np.array(self._stamps_s), np.array(self._poses).reshape(-1, 4, 4))

    def about(self) -> dict[str, Any]:
        """The version of the library."""
        return {"package": "cuvslam", "version": str(getattr(cuvslam, "__version__", "unknown"))}

    def _odometry(self) -> cuvslam.Odometry.Config:
        config = cuvslam.Odometry.Config()
        config.async_sba = bool(self._values["async_sba"])
        if "depth" in self._roles:
            config.odometry_mode = cuvslam.Odometry.OdometryMode.RGBD
            config.rgbd_settings.depth_scale_factor = float(self._values["depth_units_per_m"])
            config.rgbd_settings.depth_camera_id = 0
            config.rgbd_settings.enable_depth_stereo_tracking = False
            return config
        inertial = "imu" in self._roles
        modes = cuvslam.Odometry.OdometryMode
        config.odometry_mode = modes.Inertial if inertial else modes.Multicamera
        config.rectified_stereo_camera = all(bool(self._values.get(f"{role}_rectified")) for role in self._cameras)
        return config


def camera_of(values: dict[str, Any], role: str) -> cuvslam.Camera:
    """The camera in ``role``, its pose in the frame of the left camera."""
    check_model(values, role, (*RADTAN, *EQUIDISTANT), 5, "cuVSLAM")
    camera = cuvslam.Camera()
    camera.size = [int(values[f"{role}_width"]), int(values[f"{role}_height"])]
    camera.focal = [float(values[f"{role}_fx"]), float(values[f"{role}_fy"])]
    camera.principal = [float(values[f"{role}_cx"]), float(values[f"{role}_cy"])]
    coefficients = distortion(values, role)
    if coefficients:
        camera.distortion = distortion_of(str(values.get(f"{role}_model", RADTAN[0])), coefficients)
    camera.rig_from_camera = pose_of(transform(values, "left", role))
    return camera


def distortion_of(model: str, coefficients: list[float]) -> cuvslam.Distortion:
    """Brown's model takes k1, k2, k3, p1, p2, where ours are in OpenCV's order k1, k2, p1, p2, k3."""
    if model in EQUIDISTANT:
        return cuvslam.Distortion(cuvslam.Distortion.Model.Fisheye, coefficients)
    k1, k2, p1, p2, k3 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:5]
    return cuvslam.Distortion(cuvslam.Distortion.Model.Brown, [k1, k2, k3, p1, p2])


def imu_of(values: dict[str, Any]) -> cuvslam.ImuCalibration:
    """The IMU with its noise. Raises InvalidInput if the dataset does not state it."""
    missing = [name for name in NOISES if not values.get(f"imu_{name}")]
    if missing:
        raise InvalidInput(f"cuVSLAM needs {', '.join(missing)} of the IMU", "add them to dataset.yaml")
    imu = cuvslam.ImuCalibration()
    imu.rig_from_imu = pose_of(transform(values, "left", "imu"))
    for name in NOISES:
        setattr(imu, name, float(values[f"imu_{name}"]))
    imu.frequency = float(values["imu_rate_hz"])
    return imu


def measurement_of(sample: np.ndarray) -> cuvslam.ImuMeasurement:
    """One row ``t, gyro xyz, acc xyz``."""
    measurement = cuvslam.ImuMeasurement()
    measurement.timestamp_ns = round(float(sample[0]) * 1e9)
    measurement.angular_velocities = sample[1:4]
    measurement.linear_accelerations = sample[4:7]
    return measurement


def pose_of(T: np.ndarray) -> cuvslam.Pose:
    """A 4x4 transform as a pose with a quaternion, w last."""
    return cuvslam.Pose(rotation=quaternions_xyzw(T[None, :3, :3])[0], translation=T[:3, 3])


if __name__ == "__main__":
    sys.exit(run(CuVslam))
