"""Relative pose errors by frames, seconds and degrees, and the rotation part of that by metres.

The definition is Sturm et al.'s, "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, equations (1) to
(3). Pairs are those of evo, which picks them on the estimate; by seconds, which evo lacks, and all pairs by degrees,
where evo compares every pose with every other, they are those of the TUM RGB-D benchmark's script: the pose nearest to
the delta along the trajectory.
"""

from __future__ import annotations

import numpy as np

from slamhive.domain.protocol import Protocol, RpePairs
from slamhive.evaluation.evaluators.base import ROTATIONS_UNKNOWN, Figures, Paired, absent
from slamhive.evaluation.evaluators.pairs import (
    Pairs,
    all_pairs,
    consecutive_pairs,
    path_m,
    relative_errors,
    statistics,
    turned_rad,
)
from slamhive.trajectory.model import FloatArray, Poses

_FEW = ("rmse", "median", "max")
_MAIN = ("rmse", "mean", "median", "max")
_TOLERANCE = 0.1
"""How far the distance of a pair may be off, as a share of the delta."""


class RelativeErrors:
    """RPE over pairs that are apart by so many frames, seconds or degrees, and the rotation part over metres."""

    keys = (
        *(f"rpe_rot.{name}" for name in _MAIN),
        *(
            f"{part}.{unit}.{name}"
            for unit in ("frames", "seconds", "degrees")
            for part in ("rpe", "rpe_rot")
            for name in _FEW
        ),
    )

    def evaluate(self, paired: Paired) -> Figures:
        """A delta that no pair has leaves its figures out."""
        if not paired.rotations_known:
            return absent(self.keys, ROTATIONS_UNKNOWN)
        values: dict[str, float] = {}
        missing: dict[str, str] = {}
        for suffix, (pairs, delta) in choose_pairs(paired.aligned, paired.protocol).items():
            if len(pairs[0]) == 0:
                missing |= {key: f"no pair of poses is {delta} apart" for key in self.keys if _has(key, suffix)}
                continue
            errors_m, errors_rad = relative_errors(paired.matched_reference, paired.aligned, pairs)
            if suffix:
                values |= statistics(f"rpe{suffix}", errors_m, _FEW)
            values |= statistics(f"rpe_rot{suffix}", np.rad2deg(errors_rad), _FEW if suffix else _MAIN)
        return Figures(values, missing)


def choose_pairs(poses: Poses, protocol: Protocol) -> dict[str, tuple[Pairs, str]]:
    """{ending of the metric's name: the pairs, and in words how far they are apart}."""
    every = protocol.rpe_pairs is RpePairs.ALL
    return {
        "": (_by_value(path_m(poses), protocol.rpe_delta_m, every=every), f"{protocol.rpe_delta_m:g} m of path"),
        ".frames": (
            _by_frames(len(poses), protocol.rpe_delta_frames, every=every),
            f"{protocol.rpe_delta_frames} frames",
        ),
        ".seconds": (_by_value(poses.stamps_s, protocol.rpe_delta_s, every=every), f"{protocol.rpe_delta_s:g} s"),
        ".degrees": (
            _by_value(np.rad2deg(turned_rad(poses)), protocol.rpe_delta_deg, every=every),
            f"{protocol.rpe_delta_deg:g} degrees",
        ),
    }


def _by_value(values: FloatArray, delta: float, *, every: bool) -> Pairs:
    return all_pairs(values, delta, _TOLERANCE * delta) if every else consecutive_pairs(values, delta)


def _by_frames(count: int, delta: int, *, every: bool) -> Pairs:
    i = np.arange(0, max(count - delta, 0), 1 if every else delta)
    return i, i + delta


def _has(key: str, suffix: str) -> bool:
    """Whether the metric is of the pairs with this ending: ``rpe_rot.max`` is of those without."""
    return key.rsplit(".", 1)[0] in (f"rpe{suffix}", f"rpe_rot{suffix}")
