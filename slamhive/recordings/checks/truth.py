"""The ground-truth file by itself and against the time of the recording."""

from __future__ import annotations

import numpy as np

from slamhive.base.errors import SlamHiveError
from slamhive.domain.dataset import Dataset, Finding, NotChecked, Severity
from slamhive.recordings.checks.evidence import TRUTH, Array, DatasetEvidence, Findings, Truth
from slamhive.trajectory.evidence import find_unit, overlap
from slamhive.trajectory.layout import POSITIONS_LAYOUT, TUM_LAYOUT, TimeUnit
from slamhive.trajectory.model import QUATERNION_TOLERANCE, Poses, Trajectory, is_constant
from slamhive.trajectory.table import count_columns, parse_table, read_bounded
from slamhive.trajectory.transforms import interpolate, rotation_angles_rad, rotations_from_quats

# The ground truth as it lies in its file, with all its mistakes, and poses of it at given times.


MOST_POSES = 1_000_000
"""The first ones; a longer file needs no more to be judged."""


def read_truth(dataset: Dataset) -> tuple[Truth | None, str | None]:
    """The rows of the ground-truth file, or why they cannot be read; two None for a dataset without."""
    path = dataset.groundtruth_path
    if path is None:
        return None, None
    try:
        data = read_bounded(path)
        positions_only = count_columns(data) == 4
        layout, columns = (POSITIONS_LAYOUT, 4) if positions_only else (TUM_LAYOUT, 8)
        rows = parse_table(data, path.name, columns, layout).values[:MOST_POSES]
    except SlamHiveError as error:
        return None, str(error)
    if not np.isfinite(rows).all():
        index = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        return None, f"{path.name}: pose {index} holds a value that is not a number"
    without = positions_only or not rows[:, 4:8].any()
    quats = np.full((len(rows), 4), np.nan) if without else rows[:, 4:8]
    return Truth(rows[:, 0], rows[:, 1:4], quats), None


def clean_poses(evidence: DatasetEvidence) -> Trajectory | str:
    """The poses that can be used, in order of time, or why there are none with orientations."""
    truth = evidence.truth
    if truth is None:
        return evidence.truth_problem or "the dataset has no ground truth"
    if np.isnan(truth.quats_xyzw).any() or positions_only(evidence):
        return "the ground truth has positions only"
    norms = np.linalg.norm(truth.quats_xyzw, axis=1)
    kept = np.abs(norms - 1.0) <= QUATERNION_TOLERANCE
    order = np.argsort(truth.times_s[kept], kind="stable")
    times_s, first = np.unique(truth.times_s[kept][order], return_index=True)
    if len(times_s) < 2:
        return "the ground truth has fewer than two valid poses"
    chosen = np.flatnonzero(kept)[order][first]
    return Trajectory(times_s, truth.positions_m[chosen], truth.quats_xyzw[chosen])


def usable_poses(evidence: DatasetEvidence) -> Trajectory | str:
    """The same as :func:`clean_poses`, if they are of the time of the recording."""
    if evidence.truth is not None and not meets_recording(evidence):
        return "ground truth and recording share no time"
    return clean_poses(evidence)


def meets_recording(evidence: DatasetEvidence) -> bool:
    """Tell if ground truth and recording share any time."""
    truth = evidence.truth
    if truth is None:
        return False
    return overlap((float(truth.times_s.min()), float(truth.times_s.max())), recorded(evidence)) > 0


def recorded(evidence: DatasetEvidence) -> tuple[float, float]:
    """First and last time of the recording by the clock of the headers, in s."""
    begin_s = evidence.header_start_ns * 1e-9
    return begin_s, begin_s + evidence.span_s


def with_quats(poses: Trajectory, quats_xyzw: Array) -> Trajectory:
    """The same positions with other orientations, (n, 4)."""
    return Trajectory(poses.stamps_s, poses.positions_m, quats_xyzw)


def positions_only(evidence: DatasetEvidence) -> bool:
    """Tell if ``dataset.yaml`` says that orientations mean nothing."""
    truth = evidence.dataset.groundtruth
    return truth is not None and truth.positions_only


def transforms_at(poses: Trajectory, times_s: Array, longest_gap_s: float) -> Array:
    """``T_world_body`` at ``times_s``, (n, 4, 4); NaN outside the ground truth and in its gaps."""
    found: Poses = interpolate(poses, times_s)
    T = np.tile(np.eye(4), (len(times_s), 1, 1))
    T[:, :3, :3] = rotations_from_quats(found.quats_xyzw)
    T[:, :3, 3] = found.positions_m
    after = np.searchsorted(poses.stamps_s, times_s)
    inside = (times_s >= poses.stamps_s[0]) & (times_s <= poses.stamps_s[-1])
    after = np.clip(after, 1, len(poses) - 1)
    inside &= poses.stamps_s[after] - poses.stamps_s[after - 1] <= longest_gap_s
    T[~inside] = np.nan
    return T


LONGEST_GAP_S = 0.5
"""Interpolating the ground truth over a longer time invents motion."""


def median_step_s(poses: Trajectory) -> float:
    """Median time between poses."""
    return float(np.median(np.diff(poses.stamps_s)))


def usable_gap_s(poses: Trajectory) -> float:
    """Up to which time between poses the ground truth may be interpolated."""
    return max(LONGEST_GAP_S, 3 * median_step_s(poses)) if median_step_s(poses) < LONGEST_GAP_S else LONGEST_GAP_S


FULL_COVERAGE = 0.9
"""A tracker is started after the recording and stopped before its end; a tenth is common, more deserves a look."""
LONG_GAP_S = 1.0
"""Interpolating over more than this invents motion; evaluations associate poses within far less."""
SLOWEST_HZ = 2.0
"""Between poses further apart a body turns too much for anything to be compared."""
FASTEST_MPS = 100.0
"""Faster than any vehicle of a SLAM dataset; positions in mm make walking pace 1000 m/s."""
JUMP_FACTOR, JUMP_M, JUMP_RAD = 5.0, 0.1, np.deg2rad(15)
"""A step is a jump if it is this many times the steps around it, and longer than noise of a tracker."""
GRAVE_JUMP_M, GRAVE_SHARE = 1.0, 0.01
"""Jumps beyond one of these spoil the error of a whole run; smaller ones are lost in it."""
AROUND = 5
"""Steps before and after a step that say what is usual there."""

CHECKS = ("truth-file", "truth-times", "truth-coverage", "truth-rate", "truth-jumps", "truth-quaternions", "truth-kind")


def ground_truth(evidence: DatasetEvidence) -> Findings:
    """The file can be read; then every check of its content, or why none is done."""
    declared, truth = evidence.dataset.groundtruth, evidence.truth
    if declared is None:
        for check in CHECKS:
            yield NotChecked(check, TRUTH, "the dataset has no ground truth")
        return
    if truth is None:
        yield _finding(
            "truth-file",
            Severity.ERROR,
            f"The ground truth cannot be read: {evidence.truth_problem}.",
            "put the file back, or remove groundtruth from dataset.yaml",
            expected=f"the file {declared.file}",
        )
        for check in CHECKS[1:]:
            yield NotChecked(check, TRUTH, "the ground truth cannot be read")
        return
    yield from _times(evidence, truth)
    yield from _coverage(evidence, truth)
    yield from _rate(truth)
    yield from _jumps(evidence, truth)
    yield from _kind(evidence, truth)
    yield from _quaternions(evidence, truth)


def _times(evidence: DatasetEvidence, truth: Truth) -> Findings:
    steps_s = np.diff(truth.times_s)
    bad = np.flatnonzero(steps_s <= 0) + 1
    if len(bad):
        back = int((steps_s < 0).sum())
        yield _finding(
            "truth-times",
            Severity.ERROR,
            f"Poses of the ground truth are not later than the pose before them; {back} of {len(bad)} are earlier.",
            "sort the poses by timestamp and remove copies",
            at_s=evidence.since_start_s(truth.times_s[bad[0]]),
            count=len(bad),
            expected="timestamps that increase",
        )
    if not meets_recording(evidence) and len(truth.times_s) > 1:
        unit = find_unit(truth.times_s, None, recorded(evidence)).value
        if unit not in (None, TimeUnit.S):
            yield _finding(
                "truth-times",
                Severity.ERROR,
                f"The timestamps of the ground truth look like {unit}, not seconds.",
                f"divide the first column of the file by {unit.per_second:g}",
                value=float(truth.times_s[0]),
                unit="as read: s",
                expected=f"{recorded(evidence)[0]:.3f} s to {recorded(evidence)[1]:.3f} s",
            )


def _coverage(evidence: DatasetEvidence, truth: Truth) -> Findings:
    begin_s, end_s = recorded(evidence)
    times_s = np.unique(truth.times_s)
    if not meets_recording(evidence):
        unit = find_unit(times_s, None, (begin_s, end_s)).value if len(times_s) > 1 else None
        if unit in (None, TimeUnit.S):
            yield _finding(
                "truth-coverage",
                Severity.ERROR,
                "Ground truth and recording share no time.",
                "shift the timestamps of the ground truth to the clock of the message headers",
                value=float(times_s[0] - begin_s),
                unit="s after the start",
                expected=f"{begin_s:.3f} s to {end_s:.3f} s",
            )
        else:
            yield NotChecked("truth-coverage", TRUTH, f"the timestamps look like {unit}")
        return
    inside = times_s[(times_s >= begin_s) & (times_s <= end_s)]
    steps_s = np.diff(np.concatenate(([begin_s], inside, [end_s])))
    allowed_s = max(LONG_GAP_S, 3 * float(np.median(np.diff(times_s))) if len(times_s) > 1 else LONG_GAP_S)
    long = np.flatnonzero(steps_s > allowed_s)
    covered = 1.0 - float(steps_s[long].sum()) / max(end_s - begin_s, 1e-9)
    if covered < FULL_COVERAGE or (len(long) and long.min() > 0 and long.max() < len(steps_s) - 1):
        yield _finding(
            "truth-coverage",
            Severity.WARNING,
            f"The ground truth covers {covered:.0%} of the recording; {len(long)} stretches are without poses.",
            "results count for the covered part alone; cut the recording, or add the missing poses",
            at_s=float(np.concatenate(([begin_s], inside))[long[0]] - begin_s),
            count=len(long),
            value=round(100 * covered, 1),
            unit="%",
            expected=f"at least {FULL_COVERAGE:.0%}, no gap over {allowed_s:.3g} s",
        )


def _rate(truth: Truth) -> Findings:
    if len(truth.times_s) < 2:
        yield NotChecked("truth-rate", TRUTH, "the ground truth has one pose")
        return
    step_s = float(np.median(np.abs(np.diff(truth.times_s))))
    if 1.0 / SLOWEST_HZ < step_s < 1e5:
        yield _finding(
            "truth-rate",
            Severity.WARNING,
            f"The ground truth has a pose every {step_s:.3g} s.",
            "use a denser ground truth, or evaluate with a protocol that allows such gaps",
            value=1.0 / step_s,
            unit="Hz",
            expected=f"at least {SLOWEST_HZ:g} Hz",
        )


def _jumps(evidence: DatasetEvidence, truth: Truth) -> Findings:
    steps_s = np.diff(truth.times_s)
    if not meets_recording(evidence):
        yield NotChecked("truth-jumps", TRUTH, "ground truth and recording share no time")
        return
    if len(steps_s) <= 2 * AROUND:
        yield NotChecked("truth-jumps", TRUTH, f"{len(truth.times_s)} poses are too few")
        return
    duration_s = np.maximum(steps_s, 1e-9)
    lengths_m = np.linalg.norm(np.diff(truth.positions_m, axis=0), axis=1)
    far = _unusual(lengths_m / duration_s, duration_s, JUMP_M)
    quats = truth.quats_xyzw
    known = not np.isnan(quats).any() and not positions_only(evidence)
    angles_rad = rotation_angles_rad(quats[:-1], quats[1:]) if known else np.zeros(len(steps_s))
    turned = _unusual(angles_rad / duration_s, duration_s, JUMP_RAD)
    at = np.flatnonzero((far | turned) & (steps_s > 0) & (steps_s < LONG_GAP_S)) + 1
    if len(at):
        grave = lengths_m[at - 1].max() > GRAVE_JUMP_M or len(at) > GRAVE_SHARE * len(steps_s)
        yield _finding(
            "truth-jumps",
            Severity.ERROR if grave else Severity.WARNING,
            f"The ground truth jumps by up to {lengths_m[at - 1].max():.3g} m and "
            f"{np.rad2deg(angles_rad[at - 1].max()):.3g} deg from one pose to the next.",
            "remove the poses around the jumps: the tracker lost its target there",
            at_s=evidence.since_start_s(truth.times_s[at[0]]),
            count=len(at),
            value=float(lengths_m[at - 1].max()),
            unit="m",
            expected=f"steps below {JUMP_FACTOR:g} times those around them",
        )
    speed_mps = float(np.median(lengths_m / duration_s))
    if speed_mps > FASTEST_MPS:
        yield _finding(
            "truth-scale",
            Severity.ERROR,
            f"The ground truth moves at {speed_mps:.4g} m/s: its positions look like millimetres.",
            "divide the positions by 1000",
            value=speed_mps,
            unit="m/s",
            expected=f"below {FASTEST_MPS:g} m/s",
        )


def _unusual(speeds: Array, duration_s: Array, least: float) -> Array:
    """Steps that the speeds around them do not explain, (n,) bool."""
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(speeds, AROUND, mode="edge"), 2 * AROUND + 1)
    usual = np.median(windows, axis=1)
    return np.asarray((speeds > JUMP_FACTOR * usual) & ((speeds - usual) * duration_s > least))


def _quaternions(evidence: DatasetEvidence, truth: Truth) -> Findings:
    if np.isnan(truth.quats_xyzw).any() or positions_only(evidence):
        yield NotChecked("truth-quaternions", TRUTH, "the ground truth has positions only")
        return
    off = np.abs(np.linalg.norm(truth.quats_xyzw, axis=1) - 1.0)
    bad = np.flatnonzero(off > QUATERNION_TOLERANCE)
    if len(bad):
        worst = int(off.argmax())
        yield _finding(
            "truth-quaternions",
            Severity.ERROR,
            "Quaternions of the ground truth have a norm other than 1.",
            "write unit quaternions qx qy qz qw; the columns may be another representation",
            at_s=evidence.since_start_s(truth.times_s[bad[0]]),
            count=len(bad),
            value=float(np.linalg.norm(truth.quats_xyzw[worst])),
            expected=f"1 within {QUATERNION_TOLERANCE:g}",
        )


def _kind(evidence: DatasetEvidence, truth: Truth) -> Findings:
    declared = positions_only(evidence)
    if np.isnan(truth.quats_xyzw).all():
        if not declared:
            yield _positions_only("The ground truth has no orientations, and dataset.yaml does not say so.")
        return
    if declared:
        return
    if is_constant(truth.quats_xyzw, truth.positions_m):
        yield _positions_only("The orientation of the ground truth never changes, although its path turns.")


def _positions_only(message: str) -> Finding:
    return _finding(
        "truth-kind",
        Severity.WARNING,
        message,
        "write positions_only: true below groundtruth in dataset.yaml; rotation errors are left out then",
        expected="orientations, or positions_only: true",
    )


def _finding(check: str, severity: Severity, message: str, remedy: str, **more: object) -> Finding:
    return Finding(check, severity, TRUTH, message, remedy, **more)  # type: ignore[arg-type]
