"""Segment (sub-trajectory) errors over given path lengths, or shares of the whole path.

Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation for Visual(-Inertial) Odometry", IROS 2018,
as in rpg_trajectory_evaluation: a segment from every pose, to the pose nearest to its length. OpenVINS lists metres
and degrees for each length. ETH3D (Schops et al., BAD SLAM, CVPR 2019) sees a segment from its last pose and divides
by the length that it really has.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics.trajectories import (
    KITTI_LENGTHS_M,
    KITTI_STEP,
    LONG_LENGTHS_M,
    SEGMENT_PERCENTS,
    SHORT_LENGTHS_M,
    SPREAD,
    length_name,
)
from slamhive.domain.protocol import Alignment, Association, SegmentRule
from slamhive.evaluation.evaluators.base import KITTI_ESTIMATE, KITTI_REFERENCE, MetricValues, Paired, absent
from slamhive.evaluation.evaluators.relative import (
    Pairs,
    all_pairs,
    distance_errors_m,
    path_m,
    relative_errors,
)
from slamhive.trajectory.kitti import read_kitti_matrices
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import rotations_from_quats

_TOLERANCE = 0.2
"""How far a segment's length may be off, as a share of it, unless the protocol gives metres."""
SHORTEST_M = 0.01
"""A shorter segment is none."""
_SPREAD_PARTS = ("metres", "degrees")


@dataclass(frozen=True, slots=True, eq=False)
class SegmentEvaluator:
    """Errors of segments in m and degrees, and the length in m that ratios are taken over, shape (m,) each."""

    errors_m: FloatArray
    errors_deg: FloatArray
    over_m: FloatArray

    def __len__(self) -> int:
        return len(self.errors_m)


@dataclass(frozen=True, slots=True)
class _Length:
    """One length of segments, in words, and what its metrics' keys end with, if it has any."""

    length_m: float
    words: str
    ratios: str | None = None
    spread: str | None = None

    @property
    def keys(self) -> tuple[str, ...]:
        """The metrics of this length alone."""
        ratios = () if self.ratios is None else _ratio_keys(self.ratios)
        return ratios + (() if self.spread is None else _spread_keys(self.spread))


def _ratio_keys(ending: str) -> tuple[str, ...]:
    return tuple(f"segment.{part}{ending}" for part in ("translation", "rotation", "count"))


def _spread_keys(name: str) -> tuple[str, ...]:
    listed = (f"segment.{part}.{name}.{statistic}" for part in _SPREAD_PARTS for statistic in SPREAD)
    return (*listed, f"segment.count.{name}")


class SegmentErrors:
    """Percent and degrees per metre over all segments; for each length the same, or metres and degrees, as tools do.

    Lengths that the protocol does not ask for are neither found nor missing.
    """

    keys = (
        *_ratio_keys(""),
        *(key for percent in SEGMENT_PERCENTS for key in _ratio_keys(f".{percent}pct")),
        *(key for length_m in SHORT_LENGTHS_M for key in _ratio_keys(f".{length_name(length_m)}")),
        *(key for length_m in LONG_LENGTHS_M for key in _spread_keys(length_name(length_m))),
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """All are missing if the path has no segment of any length."""
        # Shares refer to the whole path in rpg_trajectory_evaluation, and to the matched poses elsewhere.
        whole = paired.protocol.segment_rule is SegmentRule.RPG
        whole_m = (paired.reference if whole else paired.matched_reference).path_length_m
        if not paired.protocol.segment_lengths_m:
            # Shares of the path are cut to centimetres, as rpg_trajectory_evaluation cuts them.
            lengths = [
                _Length(
                    math.trunc(percent / 100 * whole_m * 100) / 100, f"{percent} % of the path", ratios=f".{percent}pct"
                )
                for percent in SEGMENT_PERCENTS
            ]
        else:
            lengths = [
                _Length(
                    length_m,
                    f"{length_m:g} m",
                    ratios=f".{length_name(length_m)}" if length_m in SHORT_LENGTHS_M else None,
                    spread=length_name(length_m) if length_m in LONG_LENGTHS_M else None,
                )
                for length_m in paired.protocol.segment_lengths_m
            ]
        asked = (*_ratio_keys(""), *(key for length in lengths for key in length.keys))
        if not paired.rotations_known:
            return absent(asked, paired.rotations_unknown)
        if lengths[0].length_m == 0:
            return absent(asked, f"the path of {whole_m:.4g} m has no segment of a centimetre or more")
        found = [_segments(paired, length.length_m) for length in lengths]
        if not any(map(len, found)):
            tried = ", ".join(f"{length.length_m:g}" for length in lengths)
            return absent(asked, f"the path of {whole_m:.4g} m has no segment of {tried} m")
        values = _ratios("", _joined(found))
        missing: dict[str, str] = {}
        for length, segments in zip(lengths, found, strict=True):
            if len(segments) > 0:
                values |= _metrics(length, segments)
            missing |= {key: f"no segment is as long as {length.words}" for key in length.keys if key not in values}
        return MetricValues(values, missing)


class SegmentDistances:
    """Errors of the distance between the ends of segments, in percent of the segments' length along the path.

    The segments are as long as shares of the path, also where the protocol gives lengths for the other segment errors.
    """

    keys = tuple(
        f"segment_point.{name}{ending}"
        for ending in ("", *(f".{percent}pct" for percent in SEGMENT_PERCENTS))
        for name in ("error", "count")
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """Needs no orientations. The metrics of a length that no segment has are missing."""
        reference, whole_m = paired.matched_reference, paired.matched_reference.path_length_m
        path = path_m(reference)
        found: dict[str, FloatArray] = {}
        for percent in SEGMENT_PERCENTS:
            length_m = percent / 100 * whole_m
            if length_m >= SHORTEST_M:
                pairs = all_pairs(path, length_m, _TOLERANCE * length_m)
                found[f".{percent}pct"] = 100.0 * distance_errors_m(reference, paired.aligned, pairs) / length_m
        found[""] = np.concatenate([np.empty(0), *found.values()])
        values = {
            f"segment_point.{name}{ending}": value
            for ending, errors in found.items()
            if len(errors)
            for name, value in (("error", float(errors.mean())), ("count", float(len(errors))))
        }
        reason = f"the path of {whole_m:.4g} m has no such segment of a centimetre or more"
        return MetricValues(values, {key: reason for key in self.keys if key not in values})


def _segments(paired: Paired, length_m: float) -> SegmentEvaluator:
    """The errors of the segments of one length, as the protocol's rule has them."""
    tolerance_m = paired.protocol.segment_tolerance_m
    if tolerance_m is None:
        tolerance_m = _TOLERANCE * length_m
    reference, path = paired.matched_reference, path_m(paired.matched_reference)
    if paired.protocol.segment_rule is SegmentRule.ETH3D:
        first, last = _pairs_as_eth3d(path, length_m, tolerance_m)
        errors_m, errors_rad = relative_errors(reference, paired.aligned, (last, first))
        return SegmentEvaluator(errors_m, np.rad2deg(errors_rad), path[last] - path[first])
    first, last = all_pairs(path, length_m, tolerance_m)
    if paired.protocol.segment_rule is SegmentRule.RPG:
        # The tool drops starts without an end, and then numbers the rest as if it had not.
        first = np.arange(len(first))
    errors_m, errors_rad = relative_errors(reference, paired.aligned, (first, last))
    return SegmentEvaluator(errors_m, np.rad2deg(errors_rad), np.full(len(first), length_m))


def _pairs_as_eth3d(path: FloatArray, length_m: float, tolerance_m: float) -> Pairs:
    """Segments as ETH3D's program finds their ends.

    From the end of the last segment it goes on as long as a pose is nearer to the length than that end is. It therefore
    overshoots, at first by as much as the length. It never leaves a pose at which the ground truth stands still, to the
    last digit. It stops when it reaches the last pose.
    """
    listed: list[float] = path.tolist()
    ends: list[int] = []
    end = 0
    for target in (path + length_m).tolist():
        if listed[end] < target and listed[end] < listed[end + 1]:
            end = bisect_left(listed, 2.0 * target - listed[end], lo=end) - 1
            if end == len(listed) - 1:
                break
        ends.append(end)
    first, last = np.arange(len(ends)), np.array(ends, dtype=np.intp)
    kept = (first < last) & (np.abs(path[last] - path[first] - length_m) <= tolerance_m)
    return first[kept], last[kept]


def _joined(found: Sequence[SegmentEvaluator]) -> SegmentEvaluator:
    return SegmentEvaluator(
        np.concatenate([entry.errors_m for entry in found]),
        np.concatenate([entry.errors_deg for entry in found]),
        np.concatenate([entry.over_m for entry in found]),
    )


def _metrics(length: _Length, segments: SegmentEvaluator) -> dict[str, float]:
    ratios = {} if length.ratios is None else _ratios(length.ratios, segments)
    return ratios if length.spread is None else ratios | _spread(length.spread, segments)


def _ratios(ending: str, segments: SegmentEvaluator) -> dict[str, float]:
    """Means in % and degrees per metre, and the number of segments."""
    translation = float((100.0 * segments.errors_m / segments.over_m).mean())
    rotation = float((segments.errors_deg / segments.over_m).mean())
    return dict(zip(_ratio_keys(ending), (translation, rotation, float(len(segments))), strict=True))


def _spread(name: str, segments: SegmentEvaluator) -> dict[str, float]:
    """Mean, median and standard deviation in m and degrees, and the number of segments; one alone has no deviation."""
    values = {f"segment.count.{name}": float(len(segments))}
    for part, errors in zip(_SPREAD_PARTS, (segments.errors_m, segments.errors_deg), strict=True):
        values[f"segment.{part}.{name}.mean"] = float(errors.mean())
        values[f"segment.{part}.{name}.median"] = float(np.median(errors))
        if len(errors) > 1:
            values[f"segment.{part}.{name}.std"] = float(errors.std(ddof=1))
    return values


# The KITTI odometry protocol: mean error over segments of 100 to 800 m.
#
# Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012, and the
# odometry devkit (``evaluate_odometry.cpp``). Its single precision is kept. In path lengths it decides where a
# segment ends; in the arc cosine and in sums over all segments it changes the sixth digit.


_PARTS = ("translation", "rotation", "segments")
_SAME_POSITION_M = 1e-6
"""Positions of one pose in two files, written with different digits."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiSegments:
    """Every segment: its nominal length in m, its errors as shares of that and in rad/m; shape (m,) each."""

    lengths_m: FloatArray
    translations: FloatArray
    rotations_radpm: FloatArray


class KittiProtocol:
    """Percent and degrees per metre, pooled and for each length."""

    keys = (
        "kitti.translation",
        "kitti.rotation",
        "kitti.segments",
        *(f"kitti.{part}.{length_m}m" for length_m in KITTI_LENGTHS_M for part in _PARTS),
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """Every pose of the ground truth needs one of the estimate, by time or, as in the devkit, by index."""
        if not paired.rotations_known:
            return absent(self.keys, paired.rotations_unknown)
        _check_complete(paired)
        found = kitti_segments(*(_published(paired) or map(_matrices, (paired.matched_reference, paired.aligned))))
        if len(found.lengths_m) == 0:
            path_m = paired.matched_reference.path_length_m
            shortest = f"the path is {path_m:.4g} m, the shortest segment {KITTI_LENGTHS_M[0]} m"
            return absent(self.keys, shortest)
        values = _means("", found, np.ones(len(found.lengths_m), dtype=bool))
        missing: dict[str, str] = {}
        for length_m in KITTI_LENGTHS_M:
            of_length = found.lengths_m == length_m
            if of_length.any():
                values |= _means(f".{length_m}m", found, of_length)
            else:
                reason = f"no segment is {length_m} m long"
                missing |= {f"kitti.{part}.{length_m}m": reason for part in _PARTS}
        return MetricValues(values, missing)


def kitti_segments(T_reference: FloatArray, T_estimate: FloatArray) -> KittiSegments:
    """The segments from every tenth pose, each to the first pose further along the path than its length.

    ``calcSequenceErrors`` of the devkit: E = (P_f^-1 P_l)^-1 (Q_f^-1 Q_l), |t| / L and acos((tr R - 1) / 2) / L.
    Matrices that are not quite orthonormal, as those of KITTI's files with their seven digits, are taken as they are.

    Args:
        T_reference: Poses Q, shape (n, 4, 4).
        T_estimate: Poses P, one for each of them.
    """
    # In single precision, as trajectoryDistances of the devkit adds it up.
    positions_m = T_reference[:, :3, 3]
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0).astype(np.float32), axis=1)
    path_m = np.concatenate((np.zeros(1, dtype=np.float32), np.cumsum(steps_m, dtype=np.float32)))
    starts = np.arange(0, len(positions_m), KITTI_STEP)
    ends = np.searchsorted(path_m, path_m[starts, None] + np.array(KITTI_LENGTHS_M, dtype=np.float32), side="right")
    kept = ends < len(positions_m)
    firsts, lasts = np.broadcast_to(starts[:, None], kept.shape)[kept], ends[kept]
    lengths_m = np.broadcast_to(np.array(KITTI_LENGTHS_M, dtype=np.float64), kept.shape)[kept]

    true = np.linalg.inv(T_reference[firsts]) @ T_reference[lasts]
    estimated = np.linalg.inv(T_estimate[firsts]) @ T_estimate[lasts]
    errors = (np.linalg.inv(estimated) @ true).astype(np.float32)
    translations_m = np.linalg.norm(errors[:, :3, 3], axis=1)
    traces = errors[:, 0, 0] + errors[:, 1, 1] + errors[:, 2, 2]
    cosines = np.clip((0.5 * (traces.astype(np.float64) - 1.0)).astype(np.float32), -1.0, 1.0)
    angles_rad = np.arccos(cosines).astype(np.float64)
    return KittiSegments(lengths_m, translations_m.astype(np.float64) / lengths_m, angles_rad / lengths_m)


def _matrices(poses: Poses) -> FloatArray:
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3, :3] = rotations_from_quats(poses.quats_xyzw)
    matrices[:, :3, 3] = poses.positions_m
    return matrices


def _published(paired: Paired) -> tuple[FloatArray, FloatArray] | None:
    """The poses of both as their KITTI files have them, if both come from one and nothing has moved them since.

    Their matrices have seven digits, and the devkit takes what is left of them to orthonormality for rotation.
    """
    protocol, files = paired.protocol, paired.files
    moved = protocol.alignment is not Alignment.NONE or not np.array_equal(paired.T_body_estimate, np.eye(4))
    if moved or protocol.association is not Association.INDEX or protocol.reference is not None:
        return None
    if KITTI_REFERENCE not in files or KITTI_ESTIMATE not in files:
        return None
    return _as_in(files[KITTI_REFERENCE], paired.matched_reference), _as_in(files[KITTI_ESTIMATE], paired.aligned)


def _as_in(path: Path, poses: Poses) -> FloatArray:
    """The matrices in the file at ``path``; raises InvalidInput if they are not those of the poses."""
    matrices = read_kitti_matrices(path)
    if len(matrices) != len(poses) or np.abs(matrices[:, :3, 3] - poses.positions_m).max() > _SAME_POSITION_M:
        raise InvalidInput(f"{path.name} does not hold the poses of the trajectory", "import it again")
    return matrices


def _means(suffix: str, found: KittiSegments, chosen: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> dict[str, float]:
    return {
        f"kitti.translation{suffix}": 100.0 * mean_as_devkit(found.translations[chosen]),
        f"kitti.rotation{suffix}": float(np.rad2deg(mean_as_devkit(found.rotations_radpm[chosen]))),
        f"kitti.segments{suffix}": float(np.count_nonzero(chosen)),
    }


def mean_as_devkit(errors: FloatArray) -> float:
    """Summed one after the other in single precision, as ``saveStats`` of the devkit does."""
    return float(np.cumsum(errors, dtype=np.float32)[-1]) / len(errors)


def _check_complete(paired: Paired) -> None:
    frames = len(paired.reference)
    matched = len(np.unique(paired.matched_reference.stamps_s))
    if matched == frames:
        return
    how = "by index" if paired.protocol.association is Association.INDEX else "by time"
    raise InvalidInput(
        f"the KITTI protocol takes a pose for every one of the ground truth: {matched} of {frames} are matched {how}",
        "compare at the frames' rate, or see the segment errors, which do not need every pose",
    )
