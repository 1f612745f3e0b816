"""The sensors on the body and their frames and scans. The body frame is the IMU's: x forward, y left, z up."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache
from multiprocessing.connection import wait

import cv2
import numpy as np

from slamhive.base.errors import Unavailable
from slamhive.recordings.geometry import Array, rotation_xyz, transform
from slamhive.recordings.room.camera import Camera, Renderer
from slamhive.recordings.room.world import ROOM_SIZE_M, RoomMotion, clearance_m, motion_at, room_faces

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


# The expensive part: frames and scans, rendered one by one or by worker processes, always in the order asked for.


_AHEAD_PER_WORKER = 2
_NOISE_STREAM_FRAMES, _NOISE_STREAM_SCANS = 2, 3


class TaskKind(StrEnum):
    """Requests to a worker."""

    FRAME = "frame"
    SCAN = "scan"


@dataclass(frozen=True, slots=True)
class Task:
    """One frame or scan: its number (which seeds its noise) and its time since the sequence's start."""

    kind: TaskKind
    number: int
    time_s: float


@dataclass(frozen=True, slots=True)
class Scene:
    """State of a sensing process; small, as it is sent to each."""

    seed: int
    duration_s: float
    width: int
    height: int
    lidar_rate_hz: float


class Senses:
    """Renders tasks of one scene in this process."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._rig = make_rig(scene.width, scene.height, scene.lidar_rate_hz)
        self._renderer = Renderer(scene.seed)
        self._lidar = Lidar(self._rig.lidar, self._rig.T_body_lidar, scene.duration_s)

    def sense(self, task: Task) -> tuple[Array, ...]:
        """``(left, right, depth)`` of a frame (uint8, uint8, uint16 in mm) or ``(points,)`` of a scan."""
        if task.kind is TaskKind.SCAN:
            return (self._lidar.scan(task.time_s, self._rng(_NOISE_STREAM_SCANS, task.number)),)
        T_world_body = motion_at(np.array([task.time_s]), self._scene.duration_s).T_world_body(0)
        rng = self._rng(_NOISE_STREAM_FRAMES, task.number)
        left = self._renderer.view(T_world_body @ self._rig.T_body_left, self._rig.camera)
        right = self._renderer.view(T_world_body @ self._rig.T_body_right, self._rig.camera)
        depth = np.rint(left.depth_m * DEPTH_UNITS_PER_M).astype(np.uint16)
        return add_noise(left.grey, rng), add_noise(right.grey, rng), depth

    def _rng(self, stream: int, number: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence([self._scene.seed, stream, number]))


def add_noise(grey: Array, rng: np.random.Generator) -> Array:
    """The sensor's image: white noise added, rounded to uint8."""
    noise = rng.standard_normal(grey.shape, dtype=np.float32) * np.float32(IMAGE_NOISE_GREY)
    image: Array = np.clip(np.rint(grey + noise), 0, 255).astype(np.uint8)
    return image


def sense_all(scene: Scene, tasks: list[Task], workers: int) -> Iterator[tuple[Array, ...]]:
    """The results of ``tasks`` in their order; at most a few frames per worker are in memory at a time.

    Raises Unavailable if a worker process dies.
    """
    if workers == 1:
        senses = Senses(scene)
        for task in tasks:
            yield senses.sense(task)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(scene,))
    try:
        yield from _in_order(pool, tasks, workers * _AHEAD_PER_WORKER)
    except BrokenProcessPool:
        raise Unavailable("a process that renders the room ended", "is there enough memory? (200 MB each)") from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _in_order(pool: ProcessPoolExecutor, tasks: list[Task], ahead: int) -> Iterator[tuple[Array, ...]]:
    pending: deque[Future[tuple[Array, ...]]] = deque()
    for task in tasks:
        if len(pending) >= ahead:
            yield pending.popleft().result()
        pending.append(pool.submit(_work, task))
    while pending:
        yield pending.popleft().result()


_worker: dict[str, Senses] = {}
"""The worker process's own renderer; stays empty in the parent."""


def _start_worker(scene: Scene) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    cv2.setNumThreads(1)
    _worker["senses"] = Senses(scene)


def _end_with_parent() -> None:
    """A killed parent cannot tell its workers, which would wait for work for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _work(task: Task) -> tuple[Array, ...]:
    return _worker["senses"].sense(task)


# Single pictures of the room, for whatever needs images without a recording: training an ORB vocabulary, say.


_CLEARANCE_M = 0.6
_VIEW_STREAM = 5


def sample_views(count: int, seed: int = 1, width: int = 640, height: int = 480) -> list[Array]:
    """``count`` noisy grey images (height, width) uint8 from random free places, looking in random directions."""
    rig = make_rig(width, height, lidar_rate_hz=10.0)
    rng = np.random.default_rng(np.random.SeedSequence([seed, _VIEW_STREAM]))
    images = []
    for _ in range(count):
        turn = rotation_xyz(rng.uniform(-0.2, 0.2), rng.uniform(-0.35, 0.35), rng.uniform(-np.pi, np.pi))
        T_world_camera = transform(turn, _free_place(rng)) @ rig.T_body_left
        images.append(add_noise(_renderer(seed).view(T_world_camera, rig.camera).grey, rng))
    return images


def _free_place(rng: np.random.Generator) -> Array:
    low = np.array([-ROOM_SIZE_M[0] / 2, -ROOM_SIZE_M[1] / 2, 0.0]) + _CLEARANCE_M
    high = np.array([ROOM_SIZE_M[0] / 2, ROOM_SIZE_M[1] / 2, ROOM_SIZE_M[2]]) - _CLEARANCE_M
    while True:
        place: Array = rng.uniform(low, high)
        if clearance_m(place) > _CLEARANCE_M:
            return place


@lru_cache(maxsize=1)
def _renderer(seed: int) -> Renderer:
    return Renderer(seed)
