"""LiDAR sweeps: empty ones, ranges, times of points, and the direction in which they turn."""

from __future__ import annotations

import numpy as np

from slamhive.domain.calibration import LidarLayout
from slamhive.domain.dataset import NotChecked, Severity
from slamhive.domain.sensors import SensorKind
from slamhive.recordings.checks.evidence import Array, DatasetEvidence, Findings, StreamEvidence, Sweeps
from slamhive.recordings.checks.geometry import matrix
from slamhive.recordings.checks.timestamps import period_s
from slamhive.recordings.checks.truth import transforms_at, usable_gap_s, usable_poses
from slamhive.runtime.point_times import PointTimes, SweepInstant, TimeUnit
from slamhive.trajectory.model import Trajectory

EMPTY_SHARE = 0.1
"""Fewer points than this share of the median: packets are lost, or the sensor is covered."""
FARTHEST_M = 500.0
"""No LiDAR of a SLAM dataset measures the median point further away; ranges in mm do."""
NEAREST_M = 0.05
OUTSIDE_SHARE = 0.01
"""Of the points beyond the declared range; noise at its edge is less."""
ZERO_SHARE = 0.5
"""Half of the points at the origin: returns without an echo that should be left out."""
SPAN_RANGE = (0.5, 1.5)
"""Time of the points of a sweep over its period. Some sensors are blind behind, and have half a turn."""
OUTSIDE_PERIODS = 0.5
TURN_RAD = np.deg2rad(120)
"""A turning sensor turns at least this much between its first and its last point."""
SEAM_RATIO = 2.0
"""How many times closer the ends of sweeps must fit in reverse order."""
MOVED_M, FEWEST_SEAMS = 0.05, 2
"""Sweeps at rest fit in both orders, to the noise of ranges."""
STAMP_SHARE = 0.5


def sweeps_of(evidence: DatasetEvidence, *more: SensorKind) -> list[tuple[StreamEvidence, Sweeps]]:
    """The LiDARs, and sensors of kinds ``more``, whose messages are read."""
    streams = evidence.of_kind(SensorKind.LIDAR, *more)
    return [(stream, stream.sweeps) for stream in streams if stream.sweeps is not None]


def empty_sweeps(evidence: DatasetEvidence) -> Findings:
    """Every sweep has points."""
    for stream, sweeps in sweeps_of(evidence, SensorKind.LASER):
        usual = float(np.median(sweeps.counts))
        empty = np.flatnonzero(sweeps.counts <= EMPTY_SHARE * usual)
        if len(empty):
            yield stream.finding(
                "lidar-empty",
                Severity.WARNING,
                f"Sweeps of {stream.sensor.name} have hardly any points.",
                "remove these sweeps; look for lost packets",
                **evidence.where(stream, empty),
                value=float(sweeps.counts[empty].max()),
                unit="points",
                expected=f"about {usual:.0f} points",
            )


def ranges(evidence: DatasetEvidence) -> Findings:
    """Points are at distances that the sensor can measure, in metres."""
    for stream, sweeps in sweeps_of(evidence, SensorKind.LASER):
        if len(sweeps.ranges_m) == 0:
            yield NotChecked("lidar-ranges", stream.sensor.name, "no sweep has a point")
            continue
        typical_m = float(np.median(sweeps.ranges_m))
        nearest_m = _declared(stream, "minimum_range_m", 0.0)
        farthest_m = _declared(stream, "maximum_range_m", np.inf)
        outside = float(np.mean((sweeps.ranges_m > 1.05 * farthest_m) | (sweeps.ranges_m < 0.95 * nearest_m)))
        if typical_m > FARTHEST_M or typical_m < NEAREST_M:
            what = f"half of its points are {typical_m:.3g} m away or further: the unit is wrong, probably mm"
            if typical_m < NEAREST_M:
                what = f"half of its points are {typical_m:.3g} m away or nearer: the unit is wrong, probably km"
            value, unit, expected = typical_m, "m", f"{NEAREST_M} m to {FARTHEST_M:g} m"
        elif outside > OUTSIDE_SHARE:
            what = f"{outside:.0%} of its points are outside the range of the sensor"
            value, unit, expected = round(100 * outside, 1), "%", f"{nearest_m:g} m to {farthest_m:g} m"
        elif sweeps.zero_share > ZERO_SHARE:
            what = f"{sweeps.zero_share:.0%} of its points are at the origin"
            value, unit, expected = round(100 * sweeps.zero_share, 1), "%", f"at most {ZERO_SHARE:.0%}"
        else:
            continue
        yield stream.finding(
            "lidar-ranges",
            Severity.ERROR if typical_m > FARTHEST_M or typical_m < NEAREST_M else Severity.WARNING,
            f"{stream.sensor.name}: {what}.",
            "write points in metres, leave out those without an echo, or correct the range in dataset.yaml",
            value=value,
            unit=unit,
            expected=expected,
        )


def point_times(evidence: DatasetEvidence) -> Findings:
    """The points have the times that dataset.yaml declares."""
    for stream, sweeps in sweeps_of(evidence):
        name = stream.sensor.name
        if sweeps.layout_problem is not None:
            yield stream.finding(
                "lidar-point-times", Severity.ERROR, f"{sweeps.layout_problem}.", "correct dataset.yaml"
            )
            continue
        times = LidarLayout.of(stream.sensor).times
        if not times.field:
            yield NotChecked("lidar-point-times", name, "dataset.yaml declares no time of points")
        elif times.field not in sweeps.fields:
            yield stream.finding(
                "lidar-point-times",
                Severity.ERROR,
                f"Points of {name} have no field {times.field!r}; they have {', '.join(sweeps.fields)}.",
                "correct point_time_field in dataset.yaml, or write '' if the sweeps are corrected for motion",
                expected=f"a field {times.field!r}",
            )
        elif len(sweeps.times_s) == 0:
            yield NotChecked("lidar-point-times", name, "no sweep with points was read")
        else:
            yield from _place_in_sweep(stream, sweeps, times)


def _place_in_sweep(stream: StreamEvidence, sweeps: Sweeps, times: PointTimes) -> Findings:
    period = period_s(stream) or 1.0 / stream.sensor.rate_hz
    first_s, last_s = (float(value) for value in np.median(sweeps.times_s, axis=0))
    ratio = (last_s - first_s) / period
    fitting = [unit for unit in TimeUnit if _spans(ratio * unit.seconds / times.unit.seconds)]
    if not _spans(ratio):
        remedy = f"write point_time_unit: {fitting[0]}" if fitting else "check point_time_field and the conversion"
        what, value_s = f"span {last_s - first_s:.3g} s, a sweep takes {period:.3g} s", last_s - first_s
    elif first_s < -OUTSIDE_PERIODS * period or last_s > (1 + OUTSIDE_PERIODS) * period:
        remedy = "correct `point_time_reference` and `stamp` in dataset.yaml"
        what, value_s = f"begin {first_s:.3g} s after the start of the sweep", first_s
    else:
        return
    yield stream.finding(
        "lidar-point-times",
        Severity.ERROR,
        f"The points of a sweep of {stream.sensor.name} {what}.",
        remedy,
        value=value_s,
        unit="s",
        expected=f"times from 0 to {period:.3g} s",
    )


def _spans(ratio: float) -> bool:
    return SPAN_RANGE[0] <= ratio <= SPAN_RANGE[1]


def direction(evidence: DatasetEvidence) -> Findings:
    """Times of points increase as the sensor turns, in the same direction in every sweep."""
    for stream, sweeps in sweeps_of(evidence):
        turns = sweeps.turns_rad[np.isfinite(sweeps.turns_rad)]
        if len(turns) < 2 or float(np.median(np.abs(turns))) < TURN_RAD:
            yield NotChecked("lidar-direction", stream.sensor.name, "times of points show no turning sensor")
            continue
        if (turns > 0).any() and (turns < 0).any():
            yield stream.finding(
                "lidar-direction",
                Severity.ERROR,
                f"{stream.sensor.name} turns one way in {int((turns > 0).sum())} sweeps and the other way in "
                f"{int((turns < 0).sum())}.",
                "the times of points are wrong in some sweeps: convert the raw packets again",
                value=float(min((turns > 0).sum(), (turns < 0).sum())),
                unit="sweeps",
                expected="one direction",
            )
            continue
        seams = sweeps.seams_m[np.nan_to_num(sweeps.seams_m).max(axis=1) > MOVED_M]
        if len(seams) < FEWEST_SEAMS:
            yield NotChecked("lidar-direction", stream.sensor.name, "too few sweeps move between begin and end")
            continue
        forward_m, backward_m = (float(value) for value in np.nansum(seams, axis=0))
        if forward_m > SEAM_RATIO * backward_m:
            yield stream.finding(
                "lidar-direction",
                Severity.ERROR,
                f"Times of points of {stream.sensor.name} run backwards: sweeps end where the one before began.",
                "subtract the times from the duration of the sweep when the recording is converted",
                value=forward_m / max(backward_m, 1e-6),
                unit="times worse in order of time",
                expected=f"below {SEAM_RATIO:g}",
            )


def meaning_of_timestamp(evidence: DatasetEvidence) -> Findings:
    """The header timestamp is that of the start of the sweep, where dataset.yaml says so."""
    for stream, sweeps in sweeps_of(evidence):
        if len(sweeps.times_s) == 0 or LidarLayout.of(stream.sensor).times.stamp is not SweepInstant.START:
            yield NotChecked("lidar-stamp", stream.sensor.name, "its timestamp is not said to be the start of sweeps")
            continue
        sweep_s = float(np.median(sweeps.times_s[:, 1] - sweeps.times_s[:, 0]))
        delay_s = float(np.median(stream.received_ns - stream.header_ns)) * 1e-9
        if 0 <= delay_s < STAMP_SHARE * sweep_s:
            yield stream.finding(
                "lidar-stamp",
                Severity.WARNING,
                f"Sweeps of {stream.sensor.name} are recorded {delay_s * 1e3:.3g} ms after they are said to begin.",
                "write `stamp: end` in dataset.yaml, or check that the recorder wrote receive times",
                value=delay_s,
                unit="s",
                expected=f"at least {sweep_s:.3g} s",
            )


def _declared(stream: StreamEvidence, key: str, default: float) -> float:
    value = stream.sensor.calibration.get(key, default)
    return float(value) if isinstance(value, int | float) else default


# The motion of a LiDAR between sweeps, by registration, against ground truth and extrinsics.


SOURCE_POINTS, ITERATIONS = 400, 8
CLOSEST_SHARE = 0.7
"""Share of the closest points that a step of the registration uses: the rest was hidden before."""
LEAST_MOVED_M, LEAST_TURNED_RAD = 0.15, np.deg2rad(4)
"""Sweeps that are compared; less motion drowns in the distortion of the sweeps by the motion."""
ALLOWED_SHARE, ALLOWED_M, ALLOWED_RAD = 0.4, 0.1, float(np.deg2rad(1.5))
"""Difference from the expected motion: that share of it, and distortion and noise."""
FEWEST_PAIRS = 2
LONGEST_S = 1.0
"""Sweeps further apart have too little in common."""
WELL_MATCHED_M = 0.15
"""Median distance of matched points, as a share of 5 m; a larger one says that registration failed."""


def lidar_and_truth(evidence: DatasetEvidence) -> Findings:
    """Register sweeps, and compare their motion with that of the ground truth."""
    poses = usable_poses(evidence)
    for stream, _ in sweeps_of(evidence):
        if isinstance(poses, str):
            yield NotChecked("lidar-motion", stream.sensor.name, poses)
            continue
        ratios = _ratios(stream, poses)
        if len(ratios) < FEWEST_PAIRS:
            yield NotChecked("lidar-motion", stream.sensor.name, "too few sweeps that move and can be registered")
        elif float(np.median(ratios)) > 1.0:
            yield stream.finding(
                "lidar-motion",
                Severity.ERROR,
                f"Sweeps of {stream.sensor.name} move otherwise than ground truth and extrinsics say.",
                "correct T_body_sensor in dataset.yaml, or the frame of the ground truth",
                value=float(np.median(ratios)),
                unit="times the allowed difference",
                expected="at most 1",
            )


def _ratios(stream: StreamEvidence, poses: Trajectory) -> list[float]:
    """For each pair of sweeps that can be compared: difference of the motions over what is allowed."""
    assert stream.sweeps is not None
    clouds = [entry for entry in stream.sweeps.clouds if entry[0] < len(stream.header_ns)]
    times_s = np.array([stream.header_ns[index] for index, _ in clouds]) * 1e-9
    if len(clouds) < 2:
        return []
    T_world_lidar = transforms_at(poses, times_s, usable_gap_s(poses)) @ matrix(stream.sensor.T_body_sensor)
    ratios = []
    for place in range(len(clouds) - 1):
        expected = np.linalg.inv(T_world_lidar[place]) @ T_world_lidar[place + 1]
        apart_s = times_s[place + 1] - times_s[place]
        if not 0 < apart_s < LONGEST_S or not np.isfinite(expected).all() or not _moved(expected):
            continue
        found = register(clouds[place + 1][1], clouds[place][1], expected)
        if found is not None:
            ratios.append(_ratio(expected, found))
    return ratios


def _moved(T: Array) -> bool:
    return bool(np.linalg.norm(T[:3, 3]) > LEAST_MOVED_M or _angle_rad(T) > LEAST_TURNED_RAD)


def _ratio(expected: Array, found: Array) -> float:
    off = np.linalg.inv(expected) @ found
    allowed_m = ALLOWED_M + ALLOWED_SHARE * float(np.linalg.norm(expected[:3, 3]))
    allowed_rad = ALLOWED_RAD + ALLOWED_SHARE * _angle_rad(expected)
    off_m, off_rad = float(np.linalg.norm(off[:3, 3])), _angle_rad(off)
    return max(off_m / allowed_m, off_rad / allowed_rad)


def _angle_rad(T: Array) -> float:
    return float(np.arccos(np.clip((float(np.trace(T[:3, :3])) - 1) / 2, -1.0, 1.0)))


def register(source: Array, target: Array, guess: Array) -> Array | None:
    """The transform (4, 4) that lays ``source`` (n, 3) on ``target`` (m, 3), from a guess; None if they do not fit.

    Iterative closest points (Besl and McKay 1992) on the closest share of the points (Chetverikov et al. 2002).
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - 0.2 s, only for recordings with LiDAR and ground truth

    tree = cKDTree(target)
    points = source[:: max(1, len(source) // SOURCE_POINTS)].astype(np.float64)
    T = np.array(guess)
    apart = np.zeros(0)
    for _ in range(ITERATIONS):
        moved = points @ T[:3, :3].T + T[:3, 3]
        distances, nearest = tree.query(moved)
        close = distances <= np.quantile(distances, CLOSEST_SHARE)
        # The rigid transform that brings the moved points nearest to the others (Kabsch 1976).
        own, others = moved[close], target[nearest[close]].astype(np.float64)
        U, _, Vt = np.linalg.svd((others - others.mean(axis=0)).T @ (own - own.mean(axis=0)))
        step = np.eye(4)
        step[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        step[:3, 3] = others.mean(axis=0) - step[:3, :3] @ own.mean(axis=0)
        T = step @ T
        apart = distances
    return T if float(np.median(apart)) < WELL_MATCHED_M * 5 else None
