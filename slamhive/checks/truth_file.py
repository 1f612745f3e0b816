"""The ground truth as it lies in its file, with all its mistakes, and poses of it at given times."""

from __future__ import annotations

import numpy as np

from slamhive.checks.evidence import Array, Evidence, Truth
from slamhive.domain.dataset import Dataset
from slamhive.errors import SlamHiveError
from slamhive.trajectory.evidence import overlap
from slamhive.trajectory.interpolation import interpolate
from slamhive.trajectory.model import QUATERNION_TOLERANCE, Poses, Trajectory
from slamhive.trajectory.table import count_columns, parse_table, read_bounded
from slamhive.trajectory.transforms import rotations_from_quats
from slamhive.trajectory.tum import LAYOUT, POSITIONS_LAYOUT

MOST_POSES = 1_000_000
"""The first ones; a longer file needs no more to be judged."""


def read_truth(dataset: Dataset) -> tuple[Truth | None, str | None]:
    """The rows of the ground-truth file, or why they cannot be read; two None for a dataset without."""
    path = dataset.groundtruth_path
    if path is None:
        return None, None
    try:
        data = read_bounded(path)
        positions_only = count_columns(data) == 4
        layout, columns = (POSITIONS_LAYOUT, 4) if positions_only else (LAYOUT, 8)
        rows = parse_table(data, path.name, columns, layout).values[:MOST_POSES]
    except SlamHiveError as error:
        return None, str(error)
    if not np.isfinite(rows).all():
        index = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        return None, f"{path.name}: pose {index} holds a value that is not a number"
    without = positions_only or not rows[:, 4:8].any()
    quats = np.full((len(rows), 4), np.nan) if without else rows[:, 4:8]
    return Truth(rows[:, 0], rows[:, 1:4], quats), None


def clean_poses(evidence: Evidence) -> Trajectory | str:
    """The poses that can be used, in order of time, or why there are none with orientations."""
    truth = evidence.truth
    if truth is None:
        return evidence.truth_problem or "the dataset has no ground truth"
    if np.isnan(truth.quats_xyzw).any() or positions_only(evidence):
        return "the ground truth has positions only"
    norms = np.linalg.norm(truth.quats_xyzw, axis=1)
    kept = np.abs(norms - 1.0) <= QUATERNION_TOLERANCE
    order = np.argsort(truth.times_s[kept], kind="stable")
    times_s, first = np.unique(truth.times_s[kept][order], return_index=True)
    if len(times_s) < 2:
        return "the ground truth has fewer than two valid poses"
    chosen = np.flatnonzero(kept)[order][first]
    return Trajectory(times_s, truth.positions_m[chosen], truth.quats_xyzw[chosen])


def usable_poses(evidence: Evidence) -> Trajectory | str:
    """As :func:`clean_poses`, if they are of the time of the recording."""
    if evidence.truth is not None and not meets_recording(evidence):
        return "ground truth and recording share no time"
    return clean_poses(evidence)


def meets_recording(evidence: Evidence) -> bool:
    """Whether ground truth and recording share any time."""
    truth = evidence.truth
    if truth is None:
        return False
    return overlap((float(truth.times_s.min()), float(truth.times_s.max())), recorded(evidence)) > 0


def recorded(evidence: Evidence) -> tuple[float, float]:
    """First and last time of the recording by the clock of the headers, in s."""
    begin_s = evidence.header_start_ns * 1e-9
    return begin_s, begin_s + evidence.span_s


def with_quats(poses: Trajectory, quats_xyzw: Array) -> Trajectory:
    """The same positions with other orientations, (n, 4)."""
    return Trajectory(poses.stamps_s, poses.positions_m, quats_xyzw)


def positions_only(evidence: Evidence) -> bool:
    """Whether ``dataset.yaml`` says that orientations mean nothing."""
    truth = evidence.dataset.groundtruth
    return truth is not None and truth.positions_only


def transforms_at(poses: Trajectory, times_s: Array, longest_gap_s: float) -> Array:
    """``T_world_body`` at ``times_s``, (n, 4, 4); NaN outside the ground truth and in its gaps."""
    found: Poses = interpolate(poses, times_s)
    T = np.tile(np.eye(4), (len(times_s), 1, 1))
    T[:, :3, :3] = rotations_from_quats(found.quats_xyzw)
    T[:, :3, 3] = found.positions_m
    after = np.searchsorted(poses.stamps_s, times_s)
    inside = (times_s >= poses.stamps_s[0]) & (times_s <= poses.stamps_s[-1])
    after = np.clip(after, 1, len(poses) - 1)
    inside &= poses.stamps_s[after] - poses.stamps_s[after - 1] <= longest_gap_s
    T[~inside] = np.nan
    return T


LONGEST_GAP_S = 0.5
"""Interpolating the ground truth over a longer time invents motion."""


def median_step_s(poses: Trajectory) -> float:
    """Median time between poses."""
    return float(np.median(np.diff(poses.stamps_s)))


def usable_gap_s(poses: Trajectory) -> float:
    """Up to which time between poses the ground truth may be interpolated."""
    return max(LONGEST_GAP_S, 3 * median_step_s(poses)) if median_step_s(poses) < LONGEST_GAP_S else LONGEST_GAP_S
