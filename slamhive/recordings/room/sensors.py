"""The sensors on the body: where they sit and what they are. The body frame is the IMU's: x forward, y left, z up."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.recordings.geometry import Array, rotation_xyz, transform
from slamhive.recordings.room.camera import Camera
from slamhive.recordings.room.motion import RoomMotion, motion_at
from slamhive.recordings.room.world import room_faces

# The inertial sensor: specific force and angular rate of the body, with white noise and drifting biases.
#
# Noise model as in Kalibr and Forster et al. 2017: a sample is the true value plus bias plus white noise of standard
# deviation density / sqrt(dt); each bias is a random walk with steps of standard deviation walk * sqrt(dt).


GRAVITY_MPS2 = 9.81


@dataclass(frozen=True, slots=True)
class SimulatedNoise:
    """Densities in SI units: rad/s/√Hz, m/s²/√Hz, rad/s²/√Hz, m/s³/√Hz; initial biases are drawn once."""

    gyroscope_noise_density: float = 1.7e-4
    accelerometer_noise_density: float = 2.0e-3
    gyroscope_random_walk: float = 2.0e-5
    accelerometer_random_walk: float = 3.0e-3
    gyroscope_initial_bias: float = 3.0e-3
    accelerometer_initial_bias: float = 3.0e-2


NO_NOISE = SimulatedNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """``rates_radps`` and ``specific_forces_mps2``, each (n, 3), in the body frame."""

    rates_radps: Array
    specific_forces_mps2: Array


def measure(motion: RoomMotion, rate_hz: float, noise: SimulatedNoise, rng: np.random.Generator) -> ImuSamples:
    """Readings of the IMU at the body's origin at the instants of ``motion``."""
    upward = motion.accelerations_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])
    forces = np.einsum("nji,nj->ni", motion.R_world_body, upward)
    dt_s = 1.0 / rate_hz
    return ImuSamples(
        motion.rates_body_radps
        + _errors(
            len(forces),
            dt_s,
            (noise.gyroscope_noise_density, noise.gyroscope_random_walk, noise.gyroscope_initial_bias),
            rng,
        ),
        forces
        + _errors(
            len(forces),
            dt_s,
            (noise.accelerometer_noise_density, noise.accelerometer_random_walk, noise.accelerometer_initial_bias),
            rng,
        ),
    )


def _errors(count: int, dt_s: float, levels: tuple[float, float, float], rng: np.random.Generator) -> Array:
    density, walk, initial = levels
    white = rng.standard_normal((count, 3)) * (density / np.sqrt(dt_s))
    steps = rng.standard_normal((count, 3)) * (walk * np.sqrt(dt_s))
    errors: Array = white + np.cumsum(steps, axis=0) + rng.standard_normal(3) * initial
    return errors


# The spinning LiDAR.
#
# Every column of a scan is measured at its own instant from its own pose, so scans are distorted by the motion
# exactly as real ones are.


POINT_TYPE = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
)
"""``x y z`` metres in the LiDAR frame at the point's own instant, ``time`` s since the scan's start, its timestamp.

Names, types and order of the fields are those of Velodyne's ROS driver (``PointcloudXYZIRT`` of velodyne_pointcloud).
Packed, as padding would carry whatever bytes memory held and two bags of one seed would differ.
"""


@dataclass(frozen=True, slots=True)
class LidarModel:
    """Geometry and noise of the sensor."""

    beams: int = 32
    columns: int = 720
    lowest_rad: float = np.deg2rad(-30.0)
    highest_rad: float = np.deg2rad(30.0)
    minimum_range_m: float = 0.3
    maximum_range_m: float = 50.0
    range_noise_m: float = 0.01
    scan_duration_s: float = 0.1

    @property
    def elevations_deg(self) -> tuple[float, ...]:
        """The vertical angle of each ring, upwards."""
        angles = np.linspace(np.rad2deg(self.lowest_rad), np.rad2deg(self.highest_rad), self.beams)
        return tuple(float(angle) for angle in np.round(angles, 6))


class Lidar:
    """Scans the room.

    Args:
        model: The sensor.
        T_body_lidar: Where it sits, (4, 4).
        duration_s: Length of the sequence, which determines the motion.
    """

    def __init__(self, model: LidarModel, T_body_lidar: Array, duration_s: float) -> None:
        self.model = model
        self._T_body_lidar = T_body_lidar
        self._duration_s = duration_s
        self._faces = room_faces()

    def scan(self, start_s: float, rng: np.random.Generator) -> Array:
        """The scan that starts at ``start_s``: a structured array of :data:`POINT_TYPE`, in order of time."""
        model = self.model
        offsets_ns = np.arange(model.columns) * int(model.scan_duration_s * 1e9) // model.columns
        motion = motion_at(start_s + offsets_ns * 1e-9, self._duration_s)
        R_world_lidar = np.einsum("nij,jk->nik", motion.R_world_body, self._T_body_lidar[:3, :3])
        origins = motion.positions_m + np.einsum("nij,j->ni", motion.R_world_body, self._T_body_lidar[:3, 3])
        directions = self._directions()
        rays = np.einsum("nij,nbj->nbi", R_world_lidar, directions)
        # The nearest face that a ray hits from its front; a ray that hits nothing keeps an infinite range.
        x, y, z = (np.ascontiguousarray(rays[..., axis]) for axis in range(3))
        ranges = np.full(x.shape, np.inf)
        reflectivity = np.zeros(x.shape)
        for face in self._faces:
            height = (origins - face.corner_m) @ face.normal
            if not np.any(height > 0):
                continue
            facing = x * face.normal[0] + y * face.normal[1] + z * face.normal[2]
            with np.errstate(divide="ignore", invalid="ignore"):
                distance = -height[:, None] / facing
            hit = (facing < 0) & (height[:, None] > 0) & (distance < ranges)
            column, beam = np.nonzero(hit)
            offsets = origins[column] - face.corner_m + rays[column, beam] * distance[column, beam, None]
            u, v = offsets @ face.u, offsets @ face.v
            inside = (u >= 0) & (u <= face.width_m) & (v >= 0) & (v <= face.height_m)
            column, beam = column[inside], beam[inside]
            ranges[column, beam] = distance[column, beam]
            reflectivity[column, beam] = -facing[column, beam] * face.reflectivity
        ranges = ranges + rng.standard_normal(ranges.shape) * model.range_noise_m
        points = np.zeros(ranges.shape, dtype=POINT_TYPE)
        for axis, name in enumerate("xyz"):
            points[name] = directions[..., axis] * ranges
        points["intensity"] = 255.0 * reflectivity / np.maximum(ranges, 1.0)
        points["time"] = offsets_ns[:, None] * 1e-9
        points["ring"] = np.arange(model.beams)[None, :]
        return points[(ranges >= model.minimum_range_m) & (ranges <= model.maximum_range_m)]

    def _directions(self) -> Array:
        """Unit vectors in the LiDAR frame, (columns, beams, 3), turning counter-clockwise from the back."""
        azimuth = (2 * np.pi * np.arange(self.model.columns) / self.model.columns - np.pi)[:, None]
        elevation = np.linspace(self.model.lowest_rad, self.model.highest_rad, self.model.beams)[None, :]
        return np.stack(
            [
                np.cos(azimuth) * np.cos(elevation),
                np.sin(azimuth) * np.cos(elevation),
                np.broadcast_to(np.sin(elevation), (self.model.columns, self.model.beams)),
            ],
            axis=-1,
        )


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
    imu_noise: SimulatedNoise
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
        imu_noise=SimulatedNoise(),
        T_body_left=T_body_left,
        T_body_right=T_body_left @ T_left_right,
        T_body_lidar=T_body_lidar,
    )
