"""Pairs of poses and the relative errors over them, vectorised; used by RPE and segment errors."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import inverse_quats, multiply_quats, rotation_angles_rad, rotations_from_quats

IndexArray = npt.NDArray[np.intp]
Pairs = tuple[IndexArray, IndexArray]
"""The first and the second pose of each pair, shape (m,) each."""


def relative_errors(reference: Poses, estimate: Poses, pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """Errors of the estimated motion between the poses of each pair, in m and rad, shape (m,) each.

    Sturm et al., IROS 2012, equation (1): E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j). The norm of its translation is that of the
    difference of the two motions' translations, its angle that of the rotation between their rotations.

    Args:
        reference: Poses Q, n of them.
        estimate: Poses P, n of them, matched with the reference.
        pairs: Which i and j.
    """
    i, j = pairs
    differences_m = _steps_m(estimate, i, j) - _steps_m(reference, i, j)
    turns = [_turns(poses, i, j) for poses in (reference, estimate)]
    return np.linalg.norm(differences_m, axis=1), rotation_angles_rad(*turns)


def path_m(poses: Poses) -> FloatArray:
    """Path length from the first pose to each, shape (n,)."""
    return _accumulated(np.linalg.norm(np.diff(poses.positions_m, axis=0), axis=1))


def turned_rad(poses: Poses) -> FloatArray:
    """Sum of the rotation angles from pose to pose up to each, shape (n,)."""
    return _accumulated(rotation_angles_rad(poses.quats_xyzw[:-1], poses.quats_xyzw[1:]))


def all_pairs(values: FloatArray, delta: float, tolerance: float) -> Pairs:
    """Each pose with the later one whose value is nearest to its own plus ``delta``, if no further off than that.

    Args:
        values: Never decreasing, one for each pose: time, path, rotation; shape (n,).
        delta: How far apart the values of a pair shall be, above 0.
        tolerance: How far off they may be. Of two as near, and of several with equal values, the first is taken.
    """
    count = len(values)
    i = np.arange(count - 1)
    targets = values[:-1] + delta
    above = np.searchsorted(values, targets)
    below = np.searchsorted(values, values[np.maximum(above - 1, 0)])
    below, above = np.maximum(below, i + 1), np.clip(above, i + 1, count - 1)
    nearer_below = np.abs(values[below] - targets) <= np.abs(values[above] - targets)
    j = np.where(nearer_below, below, above)
    kept = np.abs(values[j] - values[:-1] - delta) <= tolerance
    return i[kept], j[kept]


def consecutive_pairs(values: FloatArray, delta: float) -> Pairs:
    """One pair after the other: each ends, and the next begins, at the first pose ``delta`` further on; as evo does."""
    listed: Sequence[float] = values.tolist()
    ends = [0]
    while (end := bisect_left(listed, listed[ends[-1]] + delta)) < len(listed):
        ends.append(max(end, ends[-1] + 1))
    return np.array(ends[:-1], dtype=np.intp), np.array(ends[1:], dtype=np.intp)


def statistics(key: str, errors: FloatArray, names: Sequence[str]) -> dict[str, float]:
    """Those of ``names`` of the errors, shape (m,), m >= 1, as metrics ``<key>.<name>``."""
    return {f"{key}.{name}": _STATISTICS[name](errors) for name in names}


_STATISTICS: Mapping[str, Callable[[FloatArray], float]] = {
    "rmse": lambda errors: float(np.sqrt(np.mean(errors**2))),
    "mean": lambda errors: float(errors.mean()),
    "median": lambda errors: float(np.median(errors)),
    "std": lambda errors: float(errors.std()),
    "max": lambda errors: float(errors.max()),
}


def _steps_m(poses: Poses, i: IndexArray, j: IndexArray) -> FloatArray:
    """Positions at j as seen from the poses at i, shape (m, 3)."""
    rotations = rotations_from_quats(poses.quats_xyzw)[i]
    steps: FloatArray = np.einsum("nij,ni->nj", rotations, poses.positions_m[j] - poses.positions_m[i])
    return steps


def _turns(poses: Poses, i: IndexArray, j: IndexArray) -> FloatArray:
    """Orientations at j as seen from those at i, quaternions (m, 4)."""
    return multiply_quats(inverse_quats(poses.quats_xyzw[i]), poses.quats_xyzw[j])


def _accumulated(steps: FloatArray) -> FloatArray:
    return np.concatenate(([0.0], np.cumsum(steps)))
