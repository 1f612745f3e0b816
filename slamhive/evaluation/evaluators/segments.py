"""Segment (sub-trajectory) errors over given path lengths, or shares of the whole path.

Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial) Odometry", IROS 2018,
as in rpg_trajectory_evaluation: a segment from every pose, to the pose nearest to its length.
"""

from __future__ import annotations

import math

import numpy as np

from slamhive.domain.metrics.trajectories import SEGMENT_PERCENTS
from slamhive.domain.protocol import Protocol
from slamhive.evaluation.evaluators.base import ROTATIONS_UNKNOWN, Figures, Paired, absent
from slamhive.evaluation.evaluators.pairs import all_pairs, path_m, relative_errors
from slamhive.trajectory.model import FloatArray

_TOLERANCE = 0.2
"""How far a segment's length may be off, as a share of it, unless the protocol gives metres."""


class SegmentErrors:
    """Percent and degrees per metre, over all segments and for each length."""

    keys = (
        "segment.translation",
        "segment.rotation",
        *(f"segment.{part}.{percent}pct" for percent in SEGMENT_PERCENTS for part in ("translation", "rotation")),
    )

    def evaluate(self, paired: Paired) -> Figures:
        """Where the protocol gives lengths, there are no figures by share of the path."""
        if not paired.rotations_known:
            return absent(self.keys, ROTATIONS_UNKNOWN)
        whole_m = paired.matched_reference.path_length_m
        lengths_m = segment_lengths_m(paired.protocol, whole_m)
        found = [_errors(paired, length_m) for length_m in lengths_m]
        percents, rotations = (np.concatenate([entry[part] for entry in found] or [np.empty(0)]) for part in (0, 1))
        if len(percents) == 0:
            return absent(self.keys, f"the path of {whole_m:.4g} m has no segment of {_words(lengths_m)}")
        values = {"segment.translation": float(percents.mean()), "segment.rotation": float(rotations.mean())}
        if paired.protocol.segment_lengths_m:
            reason = "the protocol gives the segments' lengths in metres"
            return Figures(values, {key: reason for key in self.keys if key.endswith("pct")})
        missing: dict[str, str] = {}
        for percent, (translations, turns) in zip(SEGMENT_PERCENTS, found, strict=True):
            keys = (f"segment.translation.{percent}pct", f"segment.rotation.{percent}pct")
            if len(translations) == 0:
                missing |= dict.fromkeys(keys, f"no segment is as long as {percent} % of the path")
            else:
                values |= dict(zip(keys, (float(translations.mean()), float(turns.mean())), strict=True))
        return Figures(values, missing)


def segment_lengths_m(protocol: Protocol, whole_m: float) -> tuple[float, ...]:
    """The protocol's lengths, or shares of the path cut to centimetres as rpg does; none where those are nothing."""
    if protocol.segment_lengths_m:
        return protocol.segment_lengths_m
    lengths_m = tuple(math.floor(percent * whole_m) / 100.0 for percent in SEGMENT_PERCENTS)
    return lengths_m if lengths_m[0] > 0 else ()


def _errors(paired: Paired, length_m: float) -> tuple[FloatArray, FloatArray]:
    """Percent and degrees per metre of each segment of one length."""
    tolerance_m = paired.protocol.segment_tolerance_m
    if tolerance_m is None:
        tolerance_m = _TOLERANCE * length_m
    pairs = all_pairs(path_m(paired.matched_reference), length_m, tolerance_m)
    errors_m, errors_rad = relative_errors(paired.matched_reference, paired.aligned, pairs)
    return 100.0 * errors_m / length_m, np.rad2deg(errors_rad) / length_m


def _words(lengths_m: tuple[float, ...]) -> str:
    return ", ".join(f"{length_m:g}" for length_m in lengths_m) + " m" if lengths_m else "a centimetre or more"
