"""Coverage of the recording by the estimate, losses of tracking, and a score of both."""

from __future__ import annotations

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics.trajectories import SCORE_LIMIT_M
from slamhive.domain.protocol import Alignment, Association, Duplicates, FrameFit, Protocol
from slamhive.evaluation.evaluators.base import UNCERTAINTIES, MetricValues, Paired, absent
from slamhive.evaluation.evaluators.relative import path_m
from slamhive.trajectory.alignment import Similarity, align, align_umeyama
from slamhive.trajectory.completeness import covers, measure_completeness, measure_own_coverage
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.pose_file import read_uncertainties
from slamhive.trajectory.transforms import quats_from_rotations, rotation_angles_rad

_FRAME_KEYS = (
    "alignment.frame_rotation",
    "alignment.frame_rotation_sigma",
    "alignment.lever_arm",
    "alignment.lever_arm_sigma",
)


class TrackingCoverage:
    """Coverage and gaps, by the protocol's gap threshold and by the estimate's own spacing."""

    keys = ("tracked_fraction", "gap.max", "gap.count", "tracked.path", "tracked.time", "gap.own")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Measure over the time span of the whole ground truth."""
        found = measure_completeness(
            paired.estimate.stamps_s, paired.reference.stamps_s, paired.protocol.gap_threshold_s
        )
        own = measure_own_coverage(paired.estimate.stamps_s, paired.reference, paired.protocol.gap_threshold_s)
        return MetricValues(
            {
                "tracked_fraction": found.tracked_fraction,
                "gap.max": found.longest_gap_s,
                "gap.count": float(found.gap_count),
                "tracked.path": own.path_share,
                "tracked.time": own.time_share,
                "gap.own": own.gap_s,
            }
        )


class Robustness:
    """Time to the first pose, losses of tracking, completeness-aware score."""

    keys = ("time_to_first_pose", "tracking.losses", "completeness.score")

    def evaluate(self, paired: Paired) -> MetricValues:
        """There is no score if the poses of the ground truth are further apart than the gap threshold."""
        start_s, end_s = float(paired.reference.stamps_s[0]), float(paired.reference.stamps_s[-1])
        gap_s = paired.protocol.gap_threshold_s
        values = {
            "time_to_first_pose": max(0.0, float(paired.estimate.stamps_s[0]) - start_s),
            "tracking.losses": float(count_losses(paired.estimate.stamps_s, start_s, end_s, gap_s)),
        }
        steps_s = np.diff(paired.reference.stamps_s)
        known_s = float(steps_s[steps_s <= gap_s].sum())
        if known_s == 0:
            reason = f"the poses of the ground truth are more than {gap_s:g} s apart, the gap threshold"
            return MetricValues(values, {"completeness.score": reason})
        # The protocol may hold a pose where the estimate has none: it does not count as covered.
        errors_m = np.linalg.norm(paired.aligned.positions_m - paired.matched_reference.positions_m, axis=1)
        if paired.protocol.association is Association.HOLD:
            stamps_s = paired.matched_reference.stamps_s
            errors_m[~covers(paired.estimate.stamps_s, stamps_s, paired.protocol.gap_threshold_s)] = np.inf
        covered_s = score_seconds(paired.matched_reference.stamps_s, np.asarray(errors_m), gap_s, SCORE_LIMIT_M)
        return MetricValues({**values, "completeness.score": covered_s / known_s})


def count_losses(stamps_s: FloatArray, start_s: float, end_s: float, gap_s: float) -> int:
    """Gaps longer than ``gap_s`` between poses inside the span, and one more if the poses end that long before it."""
    gaps_s = np.diff(np.append(np.clip(stamps_s, start_s, end_s), end_s))
    return int(np.count_nonzero(gaps_s > gap_s))


def score_seconds(stamps_s: FloatArray, errors_m: FloatArray, gap_s: float, limit_m: float) -> float:
    """Time integral of max(0, 1 - error / limit), which is the area under "time within x" up to the limit, over it.

    For one error e the share within x is a step at e, and the area under it from 0 to the limit is limit - e. Errors
    are interpolated between matched poses no further apart than ``gap_s``; longer times are left out. Where the error
    crosses the limit between two poses, only the triangle on the side of the smaller error counts.

    Args:
        stamps_s: Of the matched poses, never decreasing, shape (n,).
        errors_m: Their errors, shape (n,).
        gap_s: A longer time without a pose is not tracked.
        limit_m: Larger errors are as bad as no pose.
    """
    goodness = 1.0 - errors_m / limit_m
    steps_s = np.diff(stamps_s)
    tracked = (steps_s <= gap_s) & (np.maximum(goodness[:-1], goodness[1:]) > 0)
    better, worse = (choose(goodness[:-1], goodness[1:])[tracked] for choose in (np.maximum, np.minimum))
    crossing = worse < 0
    means = (better + worse) / 2.0
    means[crossing] = better[crossing] ** 2 / (2.0 * (better[crossing] - worse[crossing]))
    return float((steps_s[tracked] * means).sum())


# Drift from start to end where ground truth exists at both ends only, and errors of scale.
#
# The estimate is aligned with the ground truth at its start, and again with that at its end. Without drift, both
# alignments would be equal. Engel, Usenko, Cremers, "A Photometrically Calibrated Benchmark For Monocular Visual
# Odometry", arXiv 1607.02555. Schubert et al., "The TUM VI Benchmark", IROS 2018, has ground truth of the same kind.


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
    """Error of the estimate's scale as a whole, and its drift along the way."""

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

    keys = ("alignment.scale", "alignment.time_offset", *_FRAME_KEYS)

    def evaluate(self, paired: Paired) -> MetricValues:
        """Scale and offset are always known. The transform between frames is there only if the protocol fits one."""
        values = {"alignment.scale": paired.transform.scale, "alignment.time_offset": paired.time_offset_s}
        fit, fitted = paired.protocol.frame_fit, paired.fitted
        if fitted is not None and fit is not FrameFit.LEVER_ARM and fitted.rotation_sigma_deg is not None:
            values |= dict(zip(_FRAME_KEYS[:2], (fitted.angle_deg, fitted.rotation_sigma_deg), strict=True))
        if fitted is not None and fit is not FrameFit.ROTATION:
            values |= dict(zip(_FRAME_KEYS[2:], (fitted.arm_length_m, fitted.arm_length_sigma_m), strict=True))
        return MetricValues(values)


class TruthFloor:
    """The ATE that the uncertainty of the ground truth gives alone: sqrt(mean of sigma_x^2 + sigma_y^2 + sigma_z^2)."""

    keys = ("ate.truth_floor",)

    def evaluate(self, paired: Paired) -> MetricValues:
        """There is none where the dataset states no uncertainty; that of each pose outweighs the constant one."""
        if UNCERTAINTIES in paired.files:
            sigmas_m = read_uncertainties(paired.files[UNCERTAINTIES], paired.matched_reference.stamps_s)
            return MetricValues({"ate.truth_floor": float(np.sqrt(np.mean((sigmas_m**2).sum(axis=1))))})
        if paired.uncertainty_m is None:
            return MetricValues({})
        return MetricValues({"ate.truth_floor": float(np.sqrt(3.0)) * paired.uncertainty_m})


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


# The score of the Hilti x Trimble SLAM Challenge 2026: 100 for no error, 1 for an error of 10 m, for each pose.
#
# The organisers' site gives the formula. That errors are in metres, and how poses are matched, is from the local
# evaluation script that a participant published with the repository of the challenge (``evaluate.py``).


HILTI = Protocol(Alignment.SE3, association_tolerance_s=0.05, duplicates=Duplicates.KEEP)
HIGHEST = 100.0
DECAY_PER_M = np.log(100.0) / 10.0
"""0.4605: the score of a pose is 1 at an error of 10 m."""
SKIPPED_S = 5.0
"""The LiDAR of the ground truth starts meanwhile."""
LEAST_COVERAGE = 0.99


class HiltiScore:
    """Mean over the poses of the ground truth of 100 exp(-0.4605 e), where e is the distance in metres."""

    keys = ("hilti.score",)

    def evaluate(self, paired: Paired) -> MetricValues:
        """Zero if less than 99 % of the ground truth after its first 5 s has a pose. Only under this protocol."""
        if paired.protocol != HILTI:
            return MetricValues({})
        truth, estimate = paired.reference, paired.estimate
        kept = truth.stamps_s >= truth.stamps_s[0] + SKIPPED_S
        if not kept.any():
            raise InvalidInput(f"the ground truth ends within its first {SKIPPED_S:g} s", "use a longer recording")
        stamps_s, positions_m = truth.stamps_s[kept], truth.positions_m[kept]
        nearest = _nearest(estimate.stamps_s, stamps_s)
        matched = np.abs(estimate.stamps_s[nearest] - stamps_s) <= HILTI.association_tolerance_s
        if np.mean(matched) < LEAST_COVERAGE:
            return MetricValues({"hilti.score": 0.0})
        estimated_m, true_m = estimate.positions_m[nearest[matched]], positions_m[matched]
        transform = align_umeyama(estimated_m, true_m, scaled=False)
        errors_m = np.linalg.norm(transform.points(estimated_m) - true_m, axis=1)
        return MetricValues({"hilti.score": float(np.mean(HIGHEST * np.exp(-DECAY_PER_M * errors_m)))})


def _nearest(stamps_s: FloatArray, wanted_s: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
    """For each of ``wanted_s`` the place of the nearest of the sorted ``stamps_s``; the earlier of two."""
    after = np.clip(np.searchsorted(stamps_s, wanted_s), 1, max(len(stamps_s) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps_s) - 1)
    return np.where(wanted_s - stamps_s[before] <= stamps_s[after] - wanted_s, before, after)
