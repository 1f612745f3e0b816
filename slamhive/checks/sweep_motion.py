"""The motion of a LiDAR between sweeps, by registration, against ground truth and extrinsics."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Array, Evidence, Findings, Stream
from slamhive.checks.geometry import matrix
from slamhive.checks.sweeps import sweeps_of
from slamhive.checks.truth_file import transforms_at, usable_gap_s, usable_poses
from slamhive.domain.checks import NotChecked, Severity
from slamhive.trajectory.model import Trajectory

SOURCE_POINTS, ITERATIONS = 400, 8
CLOSEST_SHARE = 0.7
"""Share of the closest points that a step of the registration uses: the rest was hidden before."""
LEAST_MOVED_M, LEAST_TURNED_RAD = 0.15, np.deg2rad(4)
"""Sweeps that are compared; less motion drowns in the distortion of the sweeps by the motion."""
ALLOWED_SHARE, ALLOWED_M, ALLOWED_RAD = 0.4, 0.1, float(np.deg2rad(1.5))
"""Difference from the expected motion: that share of it, and distortion and noise."""
FEWEST_PAIRS = 2
LONGEST_S = 1.0
"""Sweeps further apart have too little in common."""
WELL_MATCHED_M = 0.15
"""Median distance of matched points, as a share of 5 m; a larger one says that registration failed."""


def lidar_and_truth(evidence: Evidence) -> Findings:
    """Register sweeps, and compare their motion with that of the ground truth."""
    poses = usable_poses(evidence)
    for stream, _ in sweeps_of(evidence):
        if isinstance(poses, str):
            yield NotChecked("lidar-motion", stream.sensor.name, poses)
            continue
        ratios = _ratios(stream, poses)
        if len(ratios) < FEWEST_PAIRS:
            yield NotChecked("lidar-motion", stream.sensor.name, "too few sweeps that move and can be registered")
        elif float(np.median(ratios)) > 1.0:
            yield stream.finding(
                "lidar-motion",
                Severity.ERROR,
                f"Sweeps of {stream.sensor.name} move otherwise than ground truth and extrinsics say.",
                "correct T_body_sensor in dataset.yaml, or the frame of the ground truth",
                value=float(np.median(ratios)),
                unit="times the allowed difference",
                expected="at most 1",
            )


def _ratios(stream: Stream, poses: Trajectory) -> list[float]:
    """For each pair of sweeps that can be compared: difference of the motions over what is allowed."""
    assert stream.sweeps is not None
    clouds = [entry for entry in stream.sweeps.clouds if entry[0] < len(stream.header_ns)]
    times_s = np.array([stream.header_ns[index] for index, _ in clouds]) * 1e-9
    if len(clouds) < 2:
        return []
    T_world_lidar = transforms_at(poses, times_s, usable_gap_s(poses)) @ matrix(stream.sensor.T_body_sensor)
    ratios = []
    for place in range(len(clouds) - 1):
        expected = np.linalg.inv(T_world_lidar[place]) @ T_world_lidar[place + 1]
        apart_s = times_s[place + 1] - times_s[place]
        if not 0 < apart_s < LONGEST_S or not np.isfinite(expected).all() or not _moved(expected):
            continue
        found = register(clouds[place + 1][1], clouds[place][1], expected)
        if found is not None:
            ratios.append(_ratio(expected, found))
    return ratios


def _moved(T: Array) -> bool:
    return bool(np.linalg.norm(T[:3, 3]) > LEAST_MOVED_M or _angle_rad(T) > LEAST_TURNED_RAD)


def _ratio(expected: Array, found: Array) -> float:
    off = np.linalg.inv(expected) @ found
    allowed_m = ALLOWED_M + ALLOWED_SHARE * float(np.linalg.norm(expected[:3, 3]))
    allowed_rad = ALLOWED_RAD + ALLOWED_SHARE * _angle_rad(expected)
    off_m, off_rad = float(np.linalg.norm(off[:3, 3])), _angle_rad(off)
    return max(off_m / allowed_m, off_rad / allowed_rad)


def _angle_rad(T: Array) -> float:
    return float(np.arccos(np.clip((float(np.trace(T[:3, :3])) - 1) / 2, -1.0, 1.0)))


def register(source: Array, target: Array, guess: Array) -> Array | None:
    """The transform (4, 4) that lays ``source`` (n, 3) on ``target`` (m, 3), from a guess; None if they do not fit.

    Iterative closest points (Besl and McKay 1992) on the closest share of the points (Chetverikov et al. 2002).
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - 0.2 s, only for recordings with LiDAR and ground truth

    tree = cKDTree(target)
    points = source[:: max(1, len(source) // SOURCE_POINTS)].astype(np.float64)
    T = np.array(guess)
    apart = np.zeros(0)
    for _ in range(ITERATIONS):
        moved = points @ T[:3, :3].T + T[:3, 3]
        distances, nearest = tree.query(moved)
        close = distances <= np.quantile(distances, CLOSEST_SHARE)
        T = _fit(moved[close], target[nearest[close]].astype(np.float64)) @ T
        apart = distances
    return T if float(np.median(apart)) < WELL_MATCHED_M * 5 else None


def _fit(points: Array, others: Array) -> Array:
    """The rigid transform that brings ``points`` nearest to ``others``, both (n, 3) (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd((others - others.mean(axis=0)).T @ (points - points.mean(axis=0)))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, others.mean(axis=0) - R @ points.mean(axis=0)
    return T
