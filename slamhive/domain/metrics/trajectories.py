"""Metrics of an estimated trajectory against a ground-truth trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace

from slamhive.domain.metrics.model import STATISTICS, Direction, Group, Metric, higher, neutral, statistics

# Metrics over segments of a trajectory: those of the KITTI devkit, and those of path lengths or shares of the path.


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
    return [*metrics, *_segments_of_distances()]


def _segments_of_distances() -> list[Metric]:
    """Errors of the distance between the ends of a segment, for which no orientations are needed."""
    how = (
        "Mean difference between the estimated and the true distance from the start of a segment to its end, over the "
        "segment's length along the path. It needs no orientations, and is blind to a wrong direction. Segments"
    )
    endings = [
        ("", "", "as for Segment translation"),
        *((f".{p}pct", f" {p} %", f"of {p} % of the path") for p in SEGMENT_PERCENTS),
    ]
    return [
        metric
        for ending, length, which in endings
        for metric in (
            replace(
                _segment(
                    f"segment_point.error{ending}", f"Segment distance{length}", "%", f"{how} {which}.", "SLAM Hive"
                ),
                counted_by=f"segment_point.count{ending}",
            ),
            neutral(
                _segment(
                    f"segment_point.count{ending}",
                    f"Segment distance count{length}",
                    "",
                    f"Number of segments that Segment distance{length} is a mean of.",
                    "SLAM Hive",
                )
            ),
        )
    ]


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


SCORE_LIMIT_M = 1.0
"""The completeness score looks at errors up to this."""

_ALL = tuple(STATISTICS)
_MAIN = ("rmse", "mean", "median", "max")

_EVO = "evo (https://github.com/MichaelGrupp/evo)"
_STURM = "Sturm et al., A Benchmark for the Evaluation of RGB-D SLAM Systems, IROS 2012, eq. (1) to (3)"
_TUM_SCRIPT = "pairs after the script of the TUM RGB-D benchmark, which has no tolerance"
_AS_EVO = "pairs as evo, or as the script of the TUM RGB-D benchmark if the protocol says so"
_PAIRS = {
    "": _AS_EVO,
    ".frames": _AS_EVO,
    ".seconds": _TUM_SCRIPT,
    ".degrees": f"consecutive pairs as evo; all {_TUM_SCRIPT}",
}
_ENGEL = "Engel et al., A Photometrically Calibrated Benchmark For Monocular Visual Odometry, arXiv 1607.02555"
_OURS = "SLAM Hive"


def _one(key: str, label: str, unit: str, group: Group, definition: str, source: str = _OURS) -> Metric:
    return Metric(key, label, unit, Direction.LOWER, definition, needs_protocol=True, group=group, source=source)


def _absolute() -> list[Metric]:
    where = "the absolute trajectory error: distance between aligned estimate and ground-truth positions"
    turn = "the absolute rotation error: angle of the rotation between aligned estimate and ground-truth orientations"
    return [
        *statistics(_one("ate", "ATE", "m", Group.ABSOLUTE, where, _EVO), _ALL),
        *statistics(_one("ate_rot", "ATE rotation", "deg", Group.ABSOLUTE, turn, _EVO), _MAIN),
        *_relative_size(),
        Metric(
            "hilti.score",
            "Hilti 2026 score",
            "",
            Direction.HIGHER,
            "The mean of 100 exp(-0.4605 e) over the poses of the ground truth after its first 5 s, where e is the "
            "distance in metres after SE(3) alignment. It is 0 if less than 99 % of these poses have one of the "
            "estimate within 0.05 s. Only under the protocol hilti-2026.",
            group=Group.ABSOLUTE,
            source="Hilti x Trimble SLAM Challenge 2026",
        ),
    ]


def _relative_size() -> list[Metric]:
    repeats = "the run's repeats: runs of the same configuration evaluated under the same protocol that tracked enough"
    return [
        _one(
            "ate.per_path",
            "ATE per path",
            "%",
            Group.ABSOLUTE,
            "ATE RMSE over the length of the true path between the first and the last matched pose.",
        ),
        _one(
            "ate.per_extent",
            "ATE per extent",
            "%",
            Group.ABSOLUTE,
            "ATE RMSE over the root mean square distance of the matched true positions from their mean, which is the "
            "ATE RMSE of an estimate that never moves.",
        ),
        neutral(
            _one(
                "ate.truth_floor",
                "ATE floor of the ground truth",
                "m",
                Group.ABSOLUTE,
                "Root of the mean squared standard deviation of the matched true positions, over all three axes, where "
                "the dataset states it. It is the ATE RMSE that the uncertainty of the ground truth gives alone, so "
                "smaller differences between runs mean nothing.",
            )
        ),
        neutral(
            _one(
                "ate.over_repeats",
                "ATE over repeats",
                "",
                Group.ABSOLUTE,
                f"ATE RMSE over the median of {repeats}; three at least. It changes when a repeat is evaluated.",
            )
        ),
        neutral(
            _one(
                "ate.repeats_limit",
                "Limit of ATE over repeats",
                "",
                Group.ABSOLUTE,
                "ATE over repeats above which the run has diverged. It is exp(3 sigma), with sigma from the logarithms "
                f"of the errors of {repeats}. Sigma is 1.4826 times the median deviation of those below the median. "
                "The limit is at least 4, at most 6, and at least 0.1 m above the median.",
            )
        ),
    ]


def _relative() -> list[Metric]:
    all_pairs = "If the protocol takes all pairs, each pose is paired with the nearest one within a tenth of the delta"
    chosen = {
        "frames": "in frames (1)",
        "seconds": f"in seconds (1 s). {all_pairs}",
        "degrees": (
            f"in degrees (10) of rotation summed along the estimate. {all_pairs}. In evo, any two poses whose "
            "orientations differ by this angle are a pair. They may be far apart in time, so that evo measures drift"
        ),
    }
    metres = (
        "in metres (1 m) of estimated path. If the protocol takes all pairs, their paths differ from the delta by at "
        "most a tenth"
    )
    metrics = _both_parts("", "RPE", metres, (_ALL, _MAIN))
    for unit, delta in chosen.items():
        metrics += _both_parts(f".{unit}", f"RPE by {unit}", delta, (_MAIN, _MAIN))
    metrics += _of_distances("", "Distance RPE", metres)
    for unit in ("frames", "seconds"):
        metrics += _of_distances(f".{unit}", f"Distance RPE by {unit}", chosen[unit])
    return metrics


def _of_distances(suffix: str, label: str, delta: str) -> list[Metric]:
    """Errors of the distance between the two positions of a pair, for which no orientations are needed."""
    pairs = f"The poses of a pair are the protocol's RPE delta apart, {delta}"
    what = (
        "the difference between the estimated and the true distance from one position of a pair to the other. It needs "
        f"no orientations, and is blind to a wrong direction. {pairs}"
    )
    source = f"{_EVO}, point_distance; {_PAIRS[suffix]}"
    count = f"rpe_point{suffix}.pairs"
    errors = statistics(_one(f"rpe_point{suffix}", label, "m", Group.RELATIVE, what, source), _MAIN)
    number = _one(count, f"{label} pairs", "", Group.RELATIVE, f"Number of pairs. {pairs}.", source)
    return [*(replace(metric, counted_by=count) for metric in errors), neutral(number)]


def _both_parts(suffix: str, label: str, delta: str, names: tuple[tuple[str, ...], tuple[str, ...]]) -> list[Metric]:
    pairs = f"The poses of a pair are the protocol's RPE delta apart, {delta}"
    moved = f"the translation part of the relative pose error. {pairs}"
    turned = f"the rotation angle of the relative pose error. {pairs}"
    source = f"{_STURM}; {_PAIRS[suffix]}"
    count = f"rpe{suffix}.pairs"
    group = Group.RELATIVE
    errors = [
        *statistics(_one(f"rpe{suffix}", label, "m", group, moved, source), names[0]),
        *statistics(_one(f"rpe_rot{suffix}", f"{label} rotation", "deg", group, turned, source), names[1]),
    ]
    number = _one(count, f"{label} pairs", "", group, f"Number of pairs. {pairs}.", source)
    return [*(replace(metric, counted_by=count) for metric in errors), neutral(number)]


def _drift_and_scale() -> list[Metric]:
    group = Group.DRIFT
    ends = (
        "It exists only if ground truth covers only start and end, with a gap longer than the gap threshold. "
        "T_A aligns the estimate with the part before the longest gap, T_E with the part after it, both as the "
        "protocol aligns"
    )
    return [
        _one(
            "drift.alignment",
            "Drift e_align",
            "m",
            group,
            f"Root mean square distance between the whole estimate moved by T_A and by T_E. {ends}.",
            f"{_ENGEL}, alignment error",
        ),
        _one("drift.rotation", "Drift rotation", "deg", group, f"Angle of T_E T_A^-1. {ends}.", _ENGEL),
        _one(
            "drift.scale",
            "Drift scale",
            "%",
            group,
            f"Change of scale |s_E / s_A - 1| between T_A and T_E. It is 0 unless the alignment has a scale. {ends}.",
            _ENGEL,
        ),
        _one(
            "drift.end",
            "End drift",
            "%",
            group,
            f"Distance at the last matched pose between the estimate moved by T_A and ground truth, over the path of "
            f"the estimate moved by T_A. {ends}.",
            "Schubert et al., The TUM VI Benchmark, IROS 2018, and its followers",
        ),
        _one(
            "scale.error",
            "Scale error",
            "%",
            group,
            "|s - 1|. The factor s says how much too large the estimate is before any alignment. It is the inverse of "
            "the least-squares Sim(3) scale. It means nothing for one camera, which cannot know its scale.",
            "Umeyama, PAMI 1991, eq. (42)",
        ),
        _one(
            "scale.drift",
            "Scale drift",
            "%",
            group,
            "Mean |r / r0 - 1| over pairs of matched poses. The second pose of a pair is the first one at least the "
            "RPE delta (1 m) of ground-truth path after the other. The ratio r is the distance of the estimated "
            "positions over that of the true ones. The ratio r0 is the same for the sums of all pairs, so a constant "
            "scale error is not drift. Pairs that end near their start (under half of the delta) are left out. "
            "rpg_trajectory_evaluation intends this but takes distances from the origin.",
            f"{_ZHANG} (intent)",
        ),
        neutral(
            _one(
                "alignment.time_offset",
                "Time offset",
                "s",
                group,
                "Added to the estimate's timestamps to match the ground truth's clock: given by the protocol, or "
                "found by its search.",
            )
        ),
        neutral(
            _one(
                "alignment.scale",
                "Scale",
                "",
                group,
                "Factor applied to the estimate by an alignment that leaves the scale open, Sim(3) or the scale alone; "
                "1 for every other.",
                "Umeyama, PAMI 1991, eq. (42)",
            )
        ),
        *_fitted_frame(),
    ]


def _fitted_frame() -> list[Metric]:
    where = "between the frames of estimate and ground truth, if the protocol fits one (frame_fit)"
    error = "Standard error, with neighbouring errors that are alike counted as one, of the fitted"
    parts = (
        ("frame_rotation", "Fitted rotation", "deg", f"Angle of the constant rotation {where}."),
        ("frame_rotation_sigma", "Fitted rotation, standard error", "deg", f"{error} rotation."),
        ("lever_arm", "Fitted lever arm", "m", f"Length of the constant translation {where}."),
        (
            "lever_arm_sigma",
            "Fitted lever arm, standard error",
            "m",
            f"{error} lever arm along the axes that are known.",
        ),
    )
    return [neutral(_one(f"alignment.{key}", label, unit, Group.DRIFT, text)) for key, label, unit, text in parts]


def _completeness() -> list[Metric]:
    group = Group.COMPLETENESS
    return [
        higher(
            _one(
                "tracked_fraction",
                "Tracked fraction",
                "",
                group,
                "Share of the ground truth's time span covered by the estimate, gaps taken out, clamped to 0..1.",
            )
        ),
        higher(
            _one(
                "tracked.path",
                "Tracked path",
                "",
                group,
                "Share of the true path covered by the estimate, gaps taken out, 0..1. A gap is longer than gap.own. "
                "Standing still covers no path, so a late start or a keyframe system that rests then loses nothing.",
            )
        ),
        higher(
            _one(
                "tracked.time",
                "Tracked time",
                "",
                group,
                "Share of the ground truth's time span covered by the estimate, gaps longer than gap.own taken out, "
                "0..1.",
            )
        ),
        neutral(
            _one(
                "gap.own",
                "Own gap threshold",
                "s",
                group,
                "What counts as a gap by the estimate's own spacing: ten times its median interval. It is at most a "
                "tenth of the ground truth's time span and at least the protocol's gap threshold, since keyframes are "
                "far apart.",
            )
        ),
        _one("gap.max", "Longest gap", "s", group, "Longest time without a pose inside the ground truth's span."),
        _one(
            "gap.count",
            "Gaps",
            "",
            group,
            "How many times there is no pose for longer than the gap threshold of the protocol inside the ground "
            "truth's span, its start and its end included.",
        ),
        _one(
            "time_to_first_pose",
            "Time to first pose",
            "s",
            group,
            "From the ground truth's first timestamp to the estimate's; 0 if the estimate starts before.",
        ),
        _one(
            "tracking.losses",
            "Tracking losses",
            "",
            group,
            "How often the estimate has a gap longer than the gap threshold after its start, or ends that much before "
            "the ground truth.",
        ),
        higher(
            _one(
                "completeness.score",
                "Completeness score",
                "",
                group,
                f"Area under the curve 'share of the ground truth's time within x m', x from 0 to {SCORE_LIMIT_M:g} m, "
                "over its maximum. 1 means always tracked without error. Time without a pose counts as not within. "
                "Gaps of the ground truth longer than the gap threshold do not count.",
                "After the ranking of ETH3D (Schops et al., BAD SLAM, CVPR 2019), over time instead of sequences",
            )
        ),
    ]


TRAJECTORY_METRICS = (
    *_absolute(),
    *_relative(),
    *SEGMENT_METRICS,
    *_drift_and_scale(),
    *_completeness(),
)
