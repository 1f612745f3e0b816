"""Metrics over segments of a trajectory: those of the KITTI devkit, and those of path lengths or shares of the path."""

from __future__ import annotations

from dataclasses import dataclass, replace

from slamhive.domain.metrics.model import Direction, Group, Metric, neutral

KITTI_LENGTHS_M = (100, 200, 300, 400, 500, 600, 700, 800)
"""Segment lengths of the KITTI odometry devkit."""
KITTI_STEP = 10
"""A segment starts at every tenth pose."""
SEGMENT_PERCENTS = (10, 20, 30, 40, 50)
"""Segment lengths in percent of the ground truth's path, unless the protocol gives lengths."""
SHORT_LENGTHS_M = (0.5, 1.0, 1.5, 2.0)
"""Lengths that have percent and degrees per metre of their own: those of ETH3D."""
LONG_LENGTHS_M = (8.0, 16.0, 24.0, 32.0, 40.0, 48.0)
"""Lengths that have metres and degrees of their own: those of OpenVINS."""
SPREAD = ("mean", "median", "std")
"""What OpenVINS lists of each length."""

_KITTI = "Geiger et al., CVPR 2012, and the KITTI odometry devkit (evaluate_odometry.cpp)"
_ZHANG = "Zhang and Scaramuzza, A Tutorial on Quantitative Trajectory Evaluation, IROS 2018"
_ETH3D = "Schops et al., BAD SLAM, CVPR 2019, and its evaluation program"
_OPENVINS = "Geneva et al., OpenVINS, ICRA 2020, and its ov_eval"
_WORDS = {"mean": "Mean", "median": "Median", "std": "Standard deviation (divisor n - 1)"}


def length_name(length_m: float) -> str:
    """A segment length as the keys of metrics have it: ``8m``, ``50cm``."""
    return f"{length_m:g}m" if length_m == int(length_m) else f"{100 * length_m:g}cm"


def _segment(key: str, label: str, unit: str, definition: str, source: str) -> Metric:
    return Metric(key, label, unit, Direction.LOWER, definition, True, Group.SEGMENTS, source)


@dataclass(frozen=True, slots=True)
class _Family:
    """Metrics of one kind of segment: how their keys and names begin, and what their number is called."""

    key: str
    label: str
    count: str
    source: str

    def whole(self, how: str) -> list[Metric]:
        """Those over all segments, which ``how`` describes."""
        return self._ratios(
            "",
            "",
            f"Mean translation error over segment length: {how}; the estimate scaled as aligned.",
            f"Mean rotation error over segment length: {how}.",
        )

    def one_length(self, suffix: str, length: str, which: str, source: str = "") -> list[Metric]:
        """Those over the segments of one length alone: the keys' ending, the length in short, and in a clause."""
        return self._ratios(
            f".{suffix}",
            f" {length}",
            f"As {self.label} translation, over the segments {which} alone.",
            f"As {self.label} rotation, over the segments {which} alone.",
            source,
        )

    def _ratios(self, ending: str, length: str, translation: str, rotation: str, source: str = "") -> list[Metric]:
        """Translation in percent, rotation in degrees per metre, and the number of segments."""
        source = source or self.source
        count = f"{self.key}.{self.count}{ending}"
        errors = [
            _segment(f"{self.key}.translation{ending}", f"{self.label} translation{length}", "%", translation, source),
            _segment(f"{self.key}.rotation{ending}", f"{self.label} rotation{length}", "deg/m", rotation, source),
        ]
        what = f"Number of segments that {self.label} translation{length} and rotation{length} are means of."
        number = _segment(count, f"{self.label} {self.count}{length}", "", what, source)
        return [*(replace(metric, counted_by=count) for metric in errors), neutral(number)]


def _kitti() -> list[Metric]:
    family = _Family("kitti", "KITTI", "segments", _KITTI)
    metrics = family.whole(
        f"segments of {KITTI_LENGTHS_M[0]} to {KITTI_LENGTHS_M[-1]} m of ground-truth path from every {KITTI_STEP}th "
        "frame, pooled. Path lengths are in single precision as in the devkit; a frame without a pose rejects the run"
    )
    for length_m in KITTI_LENGTHS_M:
        metrics += family.one_length(f"{length_m}m", f"{length_m} m", f"of {length_m} m")
    return metrics


def _segments() -> list[Metric]:
    family = _Family("segment", "Segment", "count", _ZHANG)
    metrics = family.whole(
        "segments from every matched pose, as long as 10, 20, 30, 40 and 50 % of the ground truth's path, all pooled. "
        "Each ends at the pose nearest to its length and within 20 % of it, unless the protocol says otherwise"
    )
    for percent in SEGMENT_PERCENTS:
        metrics += family.one_length(f"{percent}pct", f"{percent} %", f"as long as {percent} % of the path")
    for length_m in SHORT_LENGTHS_M:
        which = f"of {length_m:g} m, where the protocol has them,"
        metrics += family.one_length(length_name(length_m), f"{length_m:g} m", which, _ETH3D)
    for length_m in LONG_LENGTHS_M:
        metrics += _spread(length_m)
    return metrics


def _spread(length_m: float) -> list[Metric]:
    """Metres and degrees of the segments of one length, and their number."""
    name, where = length_name(length_m), f"of the segments of {length_m:g} m, where the protocol has them"
    count = f"segment.count.{name}"
    parts = {
        "metres": ("m", "translation", "translation error in metres"),
        "degrees": ("deg", "rotation", "rotation error in degrees"),
    }
    metrics = [
        replace(
            _segment(
                f"segment.{key}.{name}.{statistic}",
                f"Segment {part} {length_m:g} m {statistic}",
                unit,
                f"{_WORDS[statistic]} of the {error} {where}.",
                _OPENVINS,
            ),
            counted_by=count,
        )
        for key, (unit, part, error) in parts.items()
        for statistic in SPREAD
    ]
    number = _segment(count, f"Segment count {length_m:g} m", "", f"Number {where}.", _OPENVINS)
    return [*metrics, neutral(number)]


SEGMENT_METRICS = (*_kitti(), *_segments())
