"""Trajectories that the published tools were run on: recorded ones, and a made-up one with what they stumble over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slamhive.trajectory.kitti import read_kitti
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.model import Trajectory

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
EVO, RUNS = DATA / "evo_trajectories", DATA / "euroc_vio_runs"

RECORDED = {
    "freiburg1_xyz rgbdslam": (EVO / "freiburg1_xyz-groundtruth.txt", EVO / "freiburg1_xyz-rgbdslam.txt"),
    "freiburg1_xyz ORB keyframes": (EVO / "freiburg1_xyz-groundtruth.txt", EVO / "freiburg1_xyz-ORB_kf_mono.txt"),
    **{
        f"{system} {sequence}": (RUNS / sequence / "groundtruth.txt", RUNS / system / sequence / "0.txt")
        for system, sequence in (
            ("vio_mono", "MH_01"),
            ("vio_mono", "V2_03"),
            ("vislam_ba", "MH_03"),
            ("vislam_rp", "V2_01"),
        )
    },
}
"""{name: ground truth and estimate} in TUM's format."""


def recorded(name: str) -> tuple[Trajectory, Trajectory]:
    """Ground truth and estimate of one of :data:`RECORDED`."""
    truth, estimate = RECORDED[name]
    return read_tum(truth), read_tum(estimate)


def kitti(name: str) -> Trajectory:
    """The ground truth (``gt``) or the estimate (``ORB``) of KITTI 00."""
    return read_kitti(EVO / f"KITTI_00_{name}.txt", EVO / "KITTI_00_gt_times.txt")


def synthetic() -> tuple[Trajectory, Trajectory]:
    """A minute of flight, and an estimate of it that drifts.

    The ground truth pauses once, and stands still once to the last digit. The estimate comes at other times, is lost
    for 4 s, and consists of a few keyframes at the end, some of them half-way between two that are 2 s apart.
    """
    truth_s = np.round(np.arange(0, 60, 0.01), 6)
    truth_s = truth_s[(truth_s < 12) | (truth_s > 12.4)]
    moving_s = np.where(truth_s < 30, truth_s, np.maximum(truth_s - 0.5, 30.0))
    truth = Trajectory(truth_s, np.round(_positions_m(moving_s), 9), _rotations(moving_s).as_quat())
    estimate_s = np.round(np.arange(0.003, 59.9, 0.05), 6)
    sparse = np.round(np.arange(len(estimate_s)) % 10) == 0
    estimate_s = estimate_s[((estimate_s < 20) | (estimate_s > 24)) & ((estimate_s < 45) | sparse)]
    flown_s = np.where(estimate_s < 30, estimate_s, np.maximum(estimate_s - 0.5, 30.0))
    wobble = np.column_stack([np.sin(1.7 * flown_s), np.cos(2.3 * flown_s), np.sin(0.9 * flown_s + 1)])
    positions_m = 1.01 * _positions_m(flown_s) + 0.02 * wobble + 0.002 * flown_s[:, None] * [1.0, -0.5, 0.25]
    turned = Rotation.from_rotvec(0.01 * wobble) * _rotations(flown_s)
    world = Rotation.from_euler("z", 50, degrees=True)
    seen_m = world.apply(positions_m) + np.array([3.0, -2.0, 1.0])
    return truth, Trajectory(estimate_s, np.round(seen_m, 9), (world * turned).as_quat())


def _positions_m(time_s: np.ndarray) -> np.ndarray:
    return np.column_stack([8 * np.sin(0.25 * time_s), 6 * np.sin(0.4 * time_s + 0.3), 1.5 * np.sin(0.7 * time_s)])


def _rotations(time_s: np.ndarray) -> Rotation:
    angles = np.column_stack([0.4 * time_s, 0.2 * np.sin(0.5 * time_s), 0.3 * np.sin(0.8 * time_s)])
    return Rotation.from_euler("zyx", angles)
