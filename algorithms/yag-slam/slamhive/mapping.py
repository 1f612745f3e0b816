"""YAG SLAM under the container contract: laser scans and odometry in, poses of the laser after loop closures out."""

from __future__ import annotations

import sys
from importlib.metadata import version
from typing import Any

import numpy as np
from yag_slam.graph_slam import GraphSlam
from yag_slam.models import LocalizedRangeScan
from yag_slam.scan_matching import Scan2DMatcherCpp

from slamhive.runtime.app import run
from slamhive.runtime.calibration import transform
from slamhive.runtime.config import RunConfig
from slamhive.runtime.frames import Frame
from slamhive.runtime.messages import LaserScan
from slamhive.runtime.trajectory import Poses, Trajectories

LOOP_RESOLUTION_M = 0.05
"""As of YAG SLAM's own defaults: loops are looked for on a coarser grid."""


class YagSlam:
    """Matches scans against the last ones of a graph, closes loops, and optimises the graph.

    Between the scans of the graph, odometry counts. The live trajectory has no loop closures that come later.
    """

    def __init__(self, config: RunConfig) -> None:
        values = config.parameters
        self._T_body_laser = transform(values, "odometry", "laser")
        self._step_m, self._step_rad = values["min_distance"], values["min_rotation"]
        self._longest_m = float(values["range_threshold"])
        self._farthest_m = float(values.get("laser_maximum_range_m", 81.0))
        common = {"range_threshold": self._longest_m, "smear_deviation": values["smear_deviation"]}
        near = {**common, "search_size": values["search_size"], "resolution": values["resolution"]}
        far = {**common, "search_size": values["loop_search_size"], "resolution": LOOP_RESOLUTION_M}
        self._slam = GraphSlam(
            Scan2DMatcherCpp(near),
            Scan2DMatcherCpp(far, loop=True) if values["close_loops"] else None,
            scan_buffer_len=values["scan_buffer_len"],
            loop_search_dist=values["loop_search_distance"],
            loop_search_min_chain_size=values["loop_chain_size"],
            min_response_coarse=values["min_response_coarse"],
            min_response_fine=values["min_response_fine"],
        )
        self._T_odom_body = np.eye(4)
        self._T_odom_node: np.ndarray | None = None
        self._stamps_s: list[float] = []
        self._nodes: list[int] = []
        self._since_node: list[np.ndarray] = []
        """The pose of each scan relative to its node of the graph, from odometry."""
        self._live: list[np.ndarray] = []
        self._loops = 0

    def process(self, frame: Frame) -> None:
        """Add the scan to the graph if the robot has moved since the last one there."""
        if len(frame.odometry):
            self._T_odom_body = _planar(*frame.odometry[-1, 1:3], _yaw_rad(frame.odometry[-1, 4:8]))
        T_odom_laser = self._T_odom_body @ self._T_body_laser
        if self._T_odom_node is None or self._has_moved(T_odom_laser):
            _, closed = self._slam.process_scan(self._scan(frame.laser_scan("laser"), T_odom_laser))
            self._loops += bool(closed)
            self._T_odom_node = T_odom_laser
        self._stamps_s.append(frame.stamp_s)
        self._nodes.append(len(self._slam.graph.vertices) - 1)
        self._since_node.append(np.linalg.inv(self._T_odom_node) @ T_odom_laser)
        self._live.append(self._node_pose(-1) @ self._since_node[-1])

    def finish(self) -> Trajectories:
        """One pose of the laser for each scan."""
        print(f"loop closures: {self._loops}", flush=True)
        if not self._stamps_s:
            none = Poses(np.zeros(0), np.zeros((0, 4, 4)))
            return Trajectories(none, {})
        stamps_s = np.array(self._stamps_s)
        nodes = np.array([self._node_pose(number) for number in range(len(self._slam.graph.vertices))])
        final = nodes[np.array(self._nodes)] @ np.array(self._since_node)
        return Trajectories(Poses(stamps_s, final), {"live": Poses(stamps_s, np.array(self._live))})

    def about(self) -> dict[str, Any]:
        """The package that runs."""
        return {"package": "yag-slam", "version": version("yag-slam")}

    def _has_moved(self, T_odom_laser: np.ndarray) -> bool:
        step = np.linalg.inv(self._T_odom_node) @ T_odom_laser
        turned_rad = abs(np.arctan2(step[1, 0], step[0, 0]))
        return bool(np.hypot(*step[:2, 3]) >= self._step_m or turned_rad >= self._step_rad)

    def _node_pose(self, number: int) -> np.ndarray:
        pose = self._slam.graph.vertices[number].obj.corrected_pose
        return _planar(pose.x, pose.y, pose.euler[-1])

    def _scan(self, scan: LaserScan, T_odom_laser: np.ndarray) -> LocalizedRangeScan:
        step_rad = float(scan.angles_rad[1] - scan.angles_rad[0])
        # Beams without a return become longer than what is matched.
        ranges_m = np.nan_to_num(scan.ranges_m, nan=self._farthest_m + 1.0)
        return LocalizedRangeScan(
            ranges_m,
            float(scan.angles_rad[0]),
            float(scan.angles_rad[-1]),
            step_rad,
            0.0,
            self._farthest_m,
            min(self._longest_m, self._farthest_m),
            *T_odom_laser[:2, 3],
            float(np.arctan2(T_odom_laser[1, 0], T_odom_laser[0, 0])),
        )


def _planar(x_m: float, y_m: float, yaw_rad: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw_rad), -np.sin(yaw_rad)], [np.sin(yaw_rad), np.cos(yaw_rad)]]
    T[:2, 3] = x_m, y_m
    return T


def _yaw_rad(quat_xyzw: np.ndarray) -> float:
    x, y, z, w = quat_xyzw
    return float(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


if __name__ == "__main__":
    sys.exit(run(YagSlam))
