"""Relative pose errors by frames, seconds and degrees, and the rotation part of that by metres.

The definition is that of Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, equations (1)
to (3). Pairs are those of evo, which chooses them on the estimate. Pairs by seconds, which evo lacks, and all pairs by
degrees are those of the TUM RGB-D benchmark's script. It takes each pose with the one nearest to the delta along the
trajectory. (By degrees, evo compares every pose with every other.) A protocol with TUM's pairs follows that script,
``evaluate_rpe.py --fixed_delta``, throughout.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamhive.domain.protocol import Protocol, RpePairs
from slamhive.evaluation.evaluators.base import MetricValues, Paired, absent
from slamhive.evaluation.evaluators.pairs import (
    Pairs,
    all_pairs,
    consecutive_pairs,
    path_m,
    relative_errors,
    statistics,
    turned_rad,
)
from slamhive.trajectory.association import nearest_as_tum
from slamhive.trajectory.model import FloatArray, Poses

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
            return self._by_frames(protocol.rpe_delta_frames), f"{protocol.rpe_delta_frames} frames"
        if suffix == ".seconds":
            return self._by_value(poses.stamps_s, protocol.rpe_delta_s), f"{protocol.rpe_delta_s:g} s"
        if suffix == ".degrees":
            turned_deg = np.rad2deg(turned_rad(poses))
            return self._by_value(turned_deg, protocol.rpe_delta_deg), f"{protocol.rpe_delta_deg:g} degrees"
        return self._by_value(path_m(poses), protocol.rpe_delta_m), f"{protocol.rpe_delta_m:g} m of path"

    def _by_frames(self, delta: int) -> Pairs:
        count, rule = len(self.estimate), self.protocol.rpe_pairs
        if rule is RpePairs.TUM:
            return self._by_value(np.arange(count, dtype=np.float64), delta)
        i = np.arange(0, max(count - delta, 0), 1 if rule is RpePairs.ALL else delta)
        return i, i + delta

    def _by_value(self, values: FloatArray, delta: float) -> Pairs:
        if self.protocol.rpe_pairs is RpePairs.TUM:
            return _pairs_as_tum(values, delta, self.counts)
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


def _pairs_as_tum(values: FloatArray, delta: float, counts: BoolArray) -> Pairs:
    """Each pose with the one nearest to the delta further on, however far that is, unless it is the last.

    The later one comes first: the script sees the motion from there.
    """
    i = np.arange(len(values))
    j = nearest_as_tum(values, values + delta)
    kept = (j < len(values) - 1) & counts & counts[j]
    return j[kept], i[kept]


def _has(key: str, suffix: str) -> bool:
    """Whether the metric is of the pairs with this ending: ``rpe_rot.max`` is of those without."""
    return key.rsplit(".", 1)[0] in (f"rpe{suffix}", f"rpe_rot{suffix}")
