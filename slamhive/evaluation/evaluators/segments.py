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

import numpy as np

from slamhive.domain.metrics.segments import LONG_LENGTHS_M, SEGMENT_PERCENTS, SHORT_LENGTHS_M, SPREAD, length_name
from slamhive.domain.protocol import Protocol, SegmentRule
from slamhive.evaluation.evaluators.base import MetricValues, Paired, absent
from slamhive.evaluation.evaluators.pairs import Pairs, all_pairs, path_m, relative_errors
from slamhive.trajectory.model import FloatArray

_TOLERANCE = 0.2
"""How far a segment's length may be off, as a share of it, unless the protocol gives metres."""
_SPREAD_PARTS = ("metres", "degrees")


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
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
        whole_m = _whole_m(paired)
        lengths = _lengths(paired.protocol, whole_m)
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


def _whole_m(paired: Paired) -> float:
    """Length of the path that shares refer to."""
    whole = paired.protocol.segment_rule is SegmentRule.RPG
    return (paired.reference if whole else paired.matched_reference).path_length_m


def _lengths(protocol: Protocol, whole_m: float) -> list[_Length]:
    """The protocol's lengths, or shares of the path cut to centimetres, as rpg_trajectory_evaluation cuts them."""
    if not protocol.segment_lengths_m:
        return [
            _Length(
                math.trunc(percent / 100 * whole_m * 100) / 100, f"{percent} % of the path", ratios=f".{percent}pct"
            )
            for percent in SEGMENT_PERCENTS
        ]
    return [
        _Length(
            length_m,
            f"{length_m:g} m",
            ratios=f".{length_name(length_m)}" if length_m in SHORT_LENGTHS_M else None,
            spread=length_name(length_m) if length_m in LONG_LENGTHS_M else None,
        )
        for length_m in protocol.segment_lengths_m
    ]


def _segments(paired: Paired, length_m: float) -> Segments:
    """The errors of the segments of one length, as the protocol's rule has them."""
    tolerance_m = paired.protocol.segment_tolerance_m
    if tolerance_m is None:
        tolerance_m = _TOLERANCE * length_m
    reference, path = paired.matched_reference, path_m(paired.matched_reference)
    if paired.protocol.segment_rule is SegmentRule.ETH3D:
        first, last = _pairs_as_eth3d(path, length_m, tolerance_m)
        errors_m, errors_rad = relative_errors(reference, paired.aligned, (last, first))
        return Segments(errors_m, np.rad2deg(errors_rad), path[last] - path[first])
    first, last = all_pairs(path, length_m, tolerance_m)
    if paired.protocol.segment_rule is SegmentRule.RPG:
        # The tool drops starts without an end, and then numbers the rest as if it had not.
        first = np.arange(len(first))
    errors_m, errors_rad = relative_errors(reference, paired.aligned, (first, last))
    return Segments(errors_m, np.rad2deg(errors_rad), np.full(len(first), length_m))


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


def _joined(found: Sequence[Segments]) -> Segments:
    return Segments(
        np.concatenate([entry.errors_m for entry in found]),
        np.concatenate([entry.errors_deg for entry in found]),
        np.concatenate([entry.over_m for entry in found]),
    )


def _metrics(length: _Length, segments: Segments) -> dict[str, float]:
    ratios = {} if length.ratios is None else _ratios(length.ratios, segments)
    return ratios if length.spread is None else ratios | _spread(length.spread, segments)


def _ratios(ending: str, segments: Segments) -> dict[str, float]:
    """Means in % and degrees per metre, and the number of segments."""
    translation = float((100.0 * segments.errors_m / segments.over_m).mean())
    rotation = float((segments.errors_deg / segments.over_m).mean())
    return dict(zip(_ratio_keys(ending), (translation, rotation, float(len(segments))), strict=True))


def _spread(name: str, segments: Segments) -> dict[str, float]:
    """Mean, median and standard deviation in m and degrees, and the number of segments; one alone has no deviation."""
    values = {f"segment.count.{name}": float(len(segments))}
    for part, errors in zip(_SPREAD_PARTS, (segments.errors_m, segments.errors_deg), strict=True):
        values[f"segment.{part}.{name}.mean"] = float(errors.mean())
        values[f"segment.{part}.{name}.median"] = float(np.median(errors))
        if len(errors) > 1:
            values[f"segment.{part}.{name}.std"] = float(errors.std(ddof=1))
    return values
