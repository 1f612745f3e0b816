"""Relative pose errors by frames, seconds and degrees, and the rotation part of that by metres.

The definition is that of Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, equations (1)
to (3). Pairs are those of evo, which chooses them on the estimate. Pairs by seconds, which evo lacks, and all pairs by
degrees are those of the TUM RGB-D benchmark's script. It takes each pose with the one nearest to the delta along the
trajectory. (By degrees, evo compares every pose with every other.) A protocol with TUM's pairs follows that script,
``evaluate_rpe.py --fixed_delta``, throughout.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamhive.domain.protocol import Protocol, RpePairs
from slamhive.evaluation.evaluators.base import MetricValues, Paired, absent
from slamhive.trajectory.association import nearest_as_tum
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import inverse_quats, multiply_quats, rotation_angles_rad, rotations_from_quats

# Pairs of poses and the relative errors over them, vectorised; used by RPE and segment errors.


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


def distance_errors_m(reference: Poses, estimate: Poses, pairs: Pairs) -> FloatArray:
    """Differences between the estimated and the true distances of the positions of each pair, in m, shape (m,).

    The ``point_distance`` of evo (https://github.com/MichaelGrupp/evo, ``evo.core.metrics.RPE``), the absolute value of
    |q_j - q_i| - |p_j - p_i|. Arguments as those of :func:`relative_errors`; orientations are not used.
    """
    i, j = pairs
    true_m, estimated_m = (
        np.linalg.norm(poses.positions_m[j] - poses.positions_m[i], axis=1) for poses in (reference, estimate)
    )
    return np.asarray(np.abs(true_m - estimated_m))


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


BoolArray = npt.NDArray[np.bool_]

_NAMES = ("rmse", "mean", "median", "max")
_TOLERANCE = 0.1
"""How far the distance of a pair may be off, as a share of the delta."""
_INTERVALS = 2.0
"""TUM's script takes the ground-truth pose that is nearest in time, within this many of its intervals."""


class RelativeErrors:
    """RPE over pairs that are a number of frames, seconds or degrees apart, and the rotation part over metres."""

    keys = (
        *(f"rpe_rot.{name}" for name in _NAMES),
        *(
            f"{part}.{unit}.{name}"
            for unit in ("frames", "seconds", "degrees")
            for part in ("rpe", "rpe_rot")
            for name in (*_NAMES, *(("pairs",) if part == "rpe" else ()))
        ),
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """The metrics of a delta that no pair has are missing."""
        if not paired.rotations_known:
            return absent(self.keys, paired.rotations_unknown)
        values: dict[str, float] = {}
        missing: dict[str, str] = {}
        compared = compare(paired)
        for suffix in ("", ".frames", ".seconds", ".degrees"):
            pairs, delta = compared.pairs(suffix)
            if len(pairs[0]) == 0:
                missing |= {key: f"no pair of poses is {delta} apart" for key in self.keys if _has(key, suffix)}
                continue
            errors_m, errors_rad = relative_errors(compared.reference, compared.estimate, pairs)
            if suffix:
                values |= {**statistics(f"rpe{suffix}", errors_m, _NAMES), f"rpe{suffix}.pairs": float(len(errors_m))}
            values |= statistics(f"rpe_rot{suffix}", np.rad2deg(errors_rad), _NAMES)
        return MetricValues(values, missing)


class DistanceErrors:
    """RPE of distances between positions, over pairs that are metres of path, frames or seconds apart."""

    keys = tuple(f"rpe_point{suffix}.{name}" for suffix in ("", ".frames", ".seconds") for name in (*_NAMES, "pairs"))

    def evaluate(self, paired: Paired) -> MetricValues:
        """Needs no orientations. The metrics of a delta that no pair has are missing."""
        values: dict[str, float] = {}
        missing: dict[str, str] = {}
        compared = compare(paired)
        for suffix in ("", ".frames", ".seconds"):
            pairs, delta = compared.pairs(suffix)
            if len(pairs[0]) == 0:
                absent_keys = (f"rpe_point{suffix}.{name}" for name in (*_NAMES, "pairs"))
                missing |= dict.fromkeys(absent_keys, f"no pair of poses is {delta} apart")
                continue
            errors_m = distance_errors_m(compared.reference, compared.estimate, pairs)
            values |= {
                **statistics(f"rpe_point{suffix}", errors_m, _NAMES),
                f"rpe_point{suffix}.pairs": float(len(errors_m)),
            }
        return MetricValues(values, missing)


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """Poses that relative errors are taken of.

    Attributes:
        protocol: Says which pairs.
        reference: The ground truth, one pose for each of ``estimate``.
        estimate: The estimate, aligned.
        counts: Whether each may be part of a pair of TUM's script, shape (n,).
    """

    protocol: Protocol
    reference: Poses
    estimate: Poses
    counts: BoolArray

    def pairs(self, suffix: str) -> tuple[Pairs, str]:
        """The pairs of the metrics ``rpe<suffix>``, and in words how far they are apart."""
        protocol, poses = self.protocol, self.estimate
        if suffix == ".frames":
            delta, count = protocol.rpe_delta_frames, len(poses)
            if protocol.rpe_pairs is RpePairs.TUM:
                return self._by_value(np.arange(count, dtype=np.float64), delta), f"{delta} frames"
            i = np.arange(0, max(count - delta, 0), 1 if protocol.rpe_pairs is RpePairs.ALL else delta)
            return (i, i + delta), f"{delta} frames"
        if suffix == ".seconds":
            return self._by_value(poses.stamps_s, protocol.rpe_delta_s), f"{protocol.rpe_delta_s:g} s"
        if suffix == ".degrees":
            turned_deg = np.rad2deg(turned_rad(poses))
            return self._by_value(turned_deg, protocol.rpe_delta_deg), f"{protocol.rpe_delta_deg:g} degrees"
        return self._by_value(path_m(poses), protocol.rpe_delta_m), f"{protocol.rpe_delta_m:g} m of path"

    def _by_value(self, values: FloatArray, delta: float) -> Pairs:
        if self.protocol.rpe_pairs is RpePairs.TUM:
            # The later one comes first, as the script sees the motion from there; the last pose ends no pair.
            i = np.arange(len(values))
            j = nearest_as_tum(values, values + delta)
            kept = (j < len(values) - 1) & self.counts & self.counts[j]
            return j[kept], i[kept]
        if self.protocol.rpe_pairs is RpePairs.ALL:
            return all_pairs(values, delta, _TOLERANCE * delta)
        return consecutive_pairs(values, delta)


def compare(paired: Paired) -> Compared:
    """The matched poses; or every pose of the estimate, each with the nearest of the ground truth, as TUM's script."""
    if paired.protocol.rpe_pairs is not RpePairs.TUM:
        every = np.ones(len(paired.aligned), dtype=bool)
        return Compared(paired.protocol, paired.matched_reference, paired.aligned, every)
    estimate, truth_s = paired.aligned_estimate, paired.reference.stamps_s
    nearest = nearest_as_tum(truth_s, estimate.stamps_s)
    near = np.abs(truth_s[nearest] - estimate.stamps_s) <= _INTERVALS * np.median(np.diff(truth_s))
    return Compared(paired.protocol, paired.reference.take(nearest), estimate, near)


def _has(key: str, suffix: str) -> bool:
    """Tell if the metric is of the pairs with this ending: ``rpe_rot.max`` is of those without."""
    return key.rsplit(".", 1)[0] in (f"rpe{suffix}", f"rpe_rot{suffix}")
