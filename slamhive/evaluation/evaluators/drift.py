"""Drift from start to end where ground truth exists at both ends only, and errors of scale.

The estimate is aligned with the ground truth at its start, and again with that at its end. Without drift, both
alignments would be equal. Engel, Usenko, Cremers, "A Photometrically Calibrated Benchmark For Monocular Visual
Odometry", arXiv 1607.02555. Schubert et al., "The TUM VI Benchmark", IROS 2018, has ground truth of the same kind.
"""

from __future__ import annotations

import numpy as np

from slamhive.domain.protocol import Alignment
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators.base import MetricValues, Paired, absent
from slamhive.evaluation.evaluators.pairs import path_m
from slamhive.trajectory.alignment import Similarity, align, align_umeyama
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import quats_from_rotations, rotation_angles_rad

_SHORTEST = 0.5
"""A pair whose ends are nearer than this share of its path says little about the scale."""


class StartEndDrift:
    """Drift of the estimate from the first part of the ground truth to the last."""

    keys = ("drift.alignment", "drift.rotation", "drift.scale", "drift.end")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the ground truth has no gap longer than the protocol's threshold."""
        stamps_s = paired.reference.stamps_s
        gaps_s = np.diff(stamps_s)
        longest = int(gaps_s.argmax())
        if gaps_s[longest] <= paired.protocol.gap_threshold_s:
            return absent(
                self.keys, "the ground truth covers the whole run; drift is for ground truth at its ends only"
            )
        start = _aligned_part(paired, paired.matched_reference.stamps_s <= stamps_s[longest], "start")
        end = _aligned_part(paired, paired.matched_reference.stamps_s > stamps_s[longest], "end")
        moved_m = start.points(paired.estimate.positions_m)
        apart_m = np.linalg.norm(end.points(paired.estimate.positions_m) - moved_m, axis=1)
        last_m = start.points(paired.matched_estimate.positions_m[-1:])[0] - paired.matched_reference.positions_m[-1]
        path = float(np.linalg.norm(np.diff(moved_m, axis=0), axis=1).sum())
        quats = [quats_from_rotations(part.rotation[None]) for part in (start, end)]
        values = {
            "drift.alignment": float(np.sqrt(np.mean(apart_m**2))),
            "drift.rotation": float(np.rad2deg(rotation_angles_rad(*quats)[0])),
            "drift.scale": 100.0 * abs(end.scale / start.scale - 1.0),
            "drift.end": 100.0 * float(np.linalg.norm(last_m)) / path,
        }
        return MetricValues(values)


class ScaleErrors:
    """How far the estimate's scale is off as a whole, and how much it changes along the way."""

    keys = ("scale.error", "scale.drift")

    def evaluate(self, paired: Paired) -> MetricValues:
        """The scale error before alignment. It means nothing for a single camera."""
        values: dict[str, float] = {}
        missing: dict[str, str] = {}
        reference, estimate = paired.matched_reference, paired.matched_estimate
        try:
            scale = align_umeyama(estimate.positions_m, reference.positions_m, scaled=True).scale
            values["scale.error"] = 100.0 * abs(1.0 / scale - 1.0)
        except InvalidInput as error:
            missing["scale.error"] = error.message
        ratios = local_scales(reference, estimate, paired.protocol.rpe_delta_m)
        if len(ratios) > 0:
            values["scale.drift"] = 100.0 * float(np.abs(ratios - 1.0).mean())
        else:
            delta_m = paired.protocol.rpe_delta_m
            missing["scale.drift"] = f"no two poses {delta_m:g} m of path apart are half as far apart directly"
        return MetricValues(values, missing)


class AppliedAlignment:
    """Reports the alignment as metrics."""

    keys = ("alignment.scale", "alignment.time_offset")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Both are always known."""
        return MetricValues({"alignment.scale": paired.transform.scale, "alignment.time_offset": paired.time_offset_s})


def local_scales(reference: Poses, estimate: Poses, delta_m: float) -> FloatArray:
    """Estimated over true distance of poses ``delta_m`` of true path apart, over that of their sums; shape (m,).

    A pair is a pose and the first one that is at least so much further on.
    """
    path = path_m(reference)
    j = np.searchsorted(path, path + delta_m)
    i = np.flatnonzero(j < len(path))
    j = j[i]
    true_m, estimated_m = (
        np.linalg.norm(poses.positions_m[j] - poses.positions_m[i], axis=1) for poses in (reference, estimate)
    )
    kept = true_m >= _SHORTEST * delta_m
    if not estimated_m[kept].any():
        return np.empty(0)
    ratios: FloatArray = estimated_m[kept] / true_m[kept] * (true_m[kept].sum() / estimated_m[kept].sum())
    return ratios


def _aligned_part(paired: Paired, chosen: np.ndarray[tuple[int], np.dtype[np.bool_]], words: str) -> Similarity:
    """The alignment over the matched poses of one end."""
    alignment = _ALIGNMENTS.get(paired.protocol.alignment, Alignment.SE3)
    indices = np.flatnonzero(chosen)
    try:
        return align(alignment, paired.matched_estimate.take(indices), paired.matched_reference.take(indices))
    except InvalidInput as error:
        raise InvalidInput(f"drift needs an alignment at the {words} of the ground truth: {error.message}") from None


_ALIGNMENTS = {
    Alignment.SIM3: Alignment.SIM3,
    Alignment.SCALE: Alignment.SIM3,
    Alignment.YAW_POSITION: Alignment.YAW_POSITION,
}
"""How both ends are aligned; by SE(3) for other alignments, since drift needs aligned ends."""
