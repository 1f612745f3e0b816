"""Common parts of adapters of LiDAR odometry: sweeps with times, their IMU samples, and the timestamps of poses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import IMU_COLUMNS, Array, Frame
from slamhive.runtime.messages import PointCloud
from slamhive.runtime.paths import run_paths
from slamhive.runtime.pcd import write_pcd
from slamhive.runtime.point_times import PointTimes, SweepInstant
from slamhive.runtime.trajectory import Poses, Trajectories

POINTS = "points"
"""The role of the LiDAR."""


@dataclass(frozen=True, eq=False)
class Sweep:
    """One sweep of the LiDAR.

    Attributes:
        number: Counts all frames of the recording from 0.
        cloud: The points, each in the frame of the sensor at its own instant; at least one.
        since_start_s: (n,) seconds after the start of the sweep for each point; None if the LiDAR states no times.
        start_s: The start of the sweep.
        duration_s: How long it takes.
        imu: (m, 7) float64 ``t, gyro xyz, acc xyz`` (s, rad/s, m/s²): the samples up to the end of the sweep that no
            earlier sweep has. Empty without an IMU.
    """

    number: int
    cloud: PointCloud
    since_start_s: Array | None
    start_s: float
    duration_s: float
    imu: Array

    @property
    def points_m(self) -> Array:
        """(n, 3) float64."""
        return self.cloud.points_m

    @property
    def end_s(self) -> float:
        """The end of the sweep."""
        return self.start_s + self.duration_s

    @property
    def fractions(self) -> Array:
        """(n,) the part of the sweep that is over at each point, 0 to 1; empty if the LiDAR states no times."""
        if self.since_start_s is None:
            return np.empty(0)
        return np.clip(self.since_start_s / self.duration_s, 0.0, 1.0)

    @property
    def offsets_s(self) -> Array:
        """(n,) seconds after the start of the sweep, none negative; zeros if the LiDAR states no times."""
        return np.zeros(len(self.points_m)) if self.since_start_s is None else np.maximum(self.since_start_s, 0.0)

    @property
    def imu_acc_first(self) -> Array:
        """(m, 7) ``t, acc xyz, gyro xyz``, the order of many LiDAR-inertial systems."""
        return np.ascontiguousarray(self.imu[:, [0, 4, 5, 6, 1, 2, 3]])

    def instant_s(self, instant: SweepInstant) -> float:
        """The start, middle or end of the sweep."""
        return self.start_s + instant.fraction * self.duration_s


class ScanOdometry(ABC):
    """An algorithm that takes one sweep after the other.

    A subclass sets ``package``, the Python distribution that it wraps, and ``pose_at``, the instant of a sweep that a
    pose describes, and implements :meth:`register`. One that corrects poses later implements :meth:`final_poses`; with
    ``also_live`` it leaves the poses of :meth:`register` as a further trajectory. A map is saved if the algorithm has a
    parameter ``save_map`` and the subclass implements :meth:`map_points_m`.
    """

    package: ClassVar[str]
    pose_at: SweepInstant = SweepInstant.END
    also_live: ClassVar[bool] = False

    def __init__(self, config: RunConfig) -> None:
        self.values = config.parameters
        self.times = PointTimes.of(self.values, float(self.values["points_rate_hz"]), POINTS, f"{POINTS}_")
        self._imu = np.empty((0, IMU_COLUMNS))
        self._stamps_s: list[float] = []
        self._poses: list[Array] = []

    @abstractmethod
    def register(self, sweep: Sweep) -> Array | None:
        """The pose (4, 4) of the sensor in the world at :attr:`pose_at`; None if the sweep has none."""

    def map_points_m(self) -> Array:
        """The points (n, 3) of the map in the world, m."""
        raise NotImplementedError

    def final_poses(self) -> Array:
        """The poses (n, 4, 4) of all registered sweeps after the last one; by default those that were found live."""
        return np.array(self._poses)

    def process(self, frame: Frame) -> bool:
        """Register the sweep; an empty one has no pose."""
        self._imu = np.vstack((self._imu, frame.imu))
        cloud = frame.points(POINTS)
        if len(cloud.points_m) == 0:
            return False
        sweep = self._sweep(frame, cloud)
        pose = self.register(sweep)
        if pose is None:
            return False
        self._stamps_s.append(sweep.instant_s(self.pose_at))
        self._poses.append(np.array(pose))
        return True

    def finish(self) -> Poses | Trajectories:
        """One pose for each registered sweep, and the map if it was asked for."""
        poses = self.final_poses() if self._poses else np.empty((0, 4, 4))
        if self.values.get("save_map"):  # with all that the final poses know
            write_pcd(run_paths().result / "Map.pcd", self.map_points_m())
        if len(poses) != len(self._stamps_s):
            raise InvalidInput(f"{self.package} has {len(poses)} poses for {len(self._stamps_s)} registered sweeps")
        stamps_s = np.array(self._stamps_s)
        if not self.also_live:
            return Poses(stamps_s, poses)
        return Trajectories(Poses(stamps_s, poses), {"live": Poses(stamps_s, np.array(self._poses).reshape(-1, 4, 4))})

    def about(self) -> dict[str, Any]:
        """The package that ran."""
        return {"package": self.package, "version": version(self.package)}

    def _sweep(self, frame: Frame, cloud: PointCloud) -> Sweep:
        """The sweep of a frame, with the IMU samples that belong to it."""
        until_end = self._imu[:, 0] <= self.times.end_s(frame.stamp_s)
        imu, self._imu = self._imu[until_end], self._imu[~until_end]
        return Sweep(
            frame.number,
            cloud,
            self.times.since_start_s(cloud, frame.stamp_s) if self.times.field else None,
            self.times.start_s(frame.stamp_s),
            self.times.scan_duration_s,
            imu,
        )


def within_range(points_m: Array, least_m: float, most_m: float) -> Array:
    """(n,) bool: which of the points (n, 3) lie between two distances from the sensor."""
    distances_m = np.linalg.norm(points_m, axis=1)
    within: Array = (distances_m >= least_m) & (distances_m <= most_m)
    return within
