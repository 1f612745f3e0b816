"""The motion that images show against ground truth and extrinsics; the scales of depth, stereo and ground truth.

Given the motion of the body and the extrinsics, a point of an image can only reappear on a segment of the next image.
Where points are elsewhere, although some other motion explains them, ground truth or extrinsics contradict the images.
The motion has a length too: points of known depth show whether depth, stereo baseline and ground truth have one scale.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from slamhive.domain.dataset import Finding, NotChecked, Severity
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.checks.collect_images import WIDTH_PX
from slamhive.recordings.checks.evidence import TRUTH, Array, DatasetEvidence, Findings, MatchEvidence, StreamEvidence
from slamhive.recordings.checks.geometry import (
    calibrated,
    depth_of,
    depths_by_triangulation,
    explained_share,
    focal_px,
    matrix,
    misfits,
    typical,
)
from slamhive.recordings.checks.truth import transforms_at, usable_gap_s, usable_poses, with_quats
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import inverse_quats

FEWEST_MATCHES, FEWEST_PLACES = 20, 3
LEAST_MOVED_PX = 4.0
"""Median shift of points between the images; with less there is no motion to compare."""
ALLOWED_SHARE, ALLOWED_PX = 0.25, 1.5
"""Distance from where a point can be: that share of its shift, and noise of features in an image of 640 pixels."""
SUSPICIOUS, COLLAPSE = 0.25, 0.5
"""From this share of what is allowed, a mistake is reported that explains at least half of the distance."""
EXPLAINED = 0.5
SCALE_RANGE = (0.75, 1.33)
"""Median ratio of two lengths. Units and depth factors are off by 5 at least, baselines in a wrong unit by 10."""
FEWEST_LENGTHS = 30


def camera_and_truth(evidence: DatasetEvidence) -> Findings:
    """Compare each camera's motion with that of the ground truth."""
    poses = usable_poses(evidence)
    for stream in evidence.of_kind(SensorKind.CAMERA):
        if evidence.is_follower(stream):
            continue
        moves = poses if isinstance(poses, str) else _moves(stream, poses)
        if isinstance(poses, str) or isinstance(moves, str):
            yield NotChecked("camera-motion", stream.sensor.name, str(moves))
            yield from _scales(evidence, stream, [], str(moves))
            continue
        wrong = list(_directions(stream, poses, moves))
        yield from wrong
        contradicts = any(isinstance(entry, Finding) for entry in wrong)
        yield from _scales(evidence, stream, [] if contradicts else moves, "the motion contradicts the ground truth")


@dataclass(frozen=True, eq=False)
class _Move:
    """Matches, and the motion between them by ground truth and extrinsics (4, 4)."""

    matches: MatchEvidence
    T_second_first: Array


def _moves(stream: StreamEvidence, poses: Trajectory) -> list[_Move] | str:
    """The places with enough matches, enough motion in the image, and ground truth; or why there are too few."""
    if not stream.motion:
        return "the camera model is not known, or there are too few images"
    least = LEAST_MOVED_PX / focal_px(stream.sensor)
    moving = [
        match
        for match in stream.motion
        if len(match.first) >= FEWEST_MATCHES and np.median(np.linalg.norm(match.second - match.first, axis=1)) > least
    ]
    motions = _relative(moving, poses, matrix(stream.sensor.T_body_sensor))
    moves = [_Move(match, T) for match, T in zip(moving, motions, strict=True) if np.isfinite(T).all()]
    return moves if len(moves) >= FEWEST_PLACES else "the image hardly changes where the ground truth has poses"


def _relative(matches: list[MatchEvidence], poses: Trajectory, T_body_camera: Array) -> list[Array]:
    if not matches:
        return []
    gap_s = usable_gap_s(poses)
    first, second = (
        transforms_at(poses, np.array([getattr(match, which) for match in matches]) * 1e-9, gap_s) @ T_body_camera
        for which in ("first_ns", "second_ns")
    )
    return [
        np.linalg.inv(after) @ before
        if np.isfinite(before).all() and np.isfinite(after).all()
        else np.full((4, 4), np.nan)
        for before, after in zip(first, second, strict=True)
    ]


def _excess(moves: list[_Move], sensor: Sensor) -> float:
    """Median over places of the distance of points from where they can be, over what is allowed; 1 is the limit."""
    ratios = []
    focal = focal_px(sensor)
    noise_px = ALLOWED_PX * max(1.0, calibrated(sensor, "width") / WIDTH_PX)
    for move in moves:
        first, second = move.matches.first, move.matches.second
        apart_px = typical(misfits(first, second, move.T_second_first)) * focal
        shift_px = float(np.median(np.linalg.norm(second - first, axis=1))) * focal
        ratios.append(apart_px / (noise_px + ALLOWED_SHARE * shift_px))
    return float(np.median(ratios))


def _directions(stream: StreamEvidence, poses: Trajectory, moves: list[_Move]) -> Findings:
    name = stream.sensor.name
    excess = _excess(moves, stream.sensor)
    if excess <= SUSPICIOUS:
        return
    known = _explanation(stream.sensor, poses, [move.matches for move in moves], COLLAPSE * excess)
    if known is None and excess <= 1.0:
        return
    tolerance = 2 * ALLOWED_PX / focal_px(stream.sensor)
    explained = [explained_share(move.matches.first, move.matches.second, tolerance) for move in moves]
    if float(np.median(explained)) < EXPLAINED:
        yield NotChecked("camera-motion", name, "the matches between the images contradict each other")
        return
    about, what, remedy = known or (
        name,
        "the extrinsics are wrong",
        "correct T_body_sensor in dataset.yaml, or the frame of the ground truth",
    )
    yield Finding(
        "camera-motion" if about == name else "truth-orientation",
        Severity.ERROR,
        about,
        f"The images of {name} move otherwise than ground truth and extrinsics say: {what}.",
        remedy,
        topic=stream.sensor.topic if about == name else None,
        value=min(excess, 1e6),
        unit="times the allowed distance",
        expected="at most 1",
    )


def _explanation(
    sensor: Sensor, poses: Trajectory, matches: list[MatchEvidence], most: float
) -> tuple[str, str, str] | None:
    """Subject of a contradiction, the mistake that lowers it to ``most``, and the remedy; None without one."""
    T_body_camera = matrix(sensor.T_body_sensor)
    wxyz = with_quats(poses, np.roll(poses.quats_xyzw, -1, axis=1))
    inverse = with_quats(poses, inverse_quats(poses.quats_xyzw))
    tried = [
        (poses, np.linalg.inv(T_body_camera), sensor.name, "T_body_sensor is inverted", "invert it in dataset.yaml"),
        (wxyz, T_body_camera, TRUTH, "its quaternions are in the order w x y z", "write qx qy qz qw in its file"),
        (inverse, T_body_camera, TRUTH, "its orientations are inverted", "invert them in its file"),
        (
            poses,
            np.eye(4),
            sensor.name,
            "the ground truth is that of the camera",
            "write the identity as T_body_sensor",
        ),
    ]
    remedy = "turn T_body_sensor in dataset.yaml"
    for turn in _axis_turns():
        angle_deg = np.rad2deg(np.arccos(np.clip((np.trace(turn[:3, :3]) - 1) / 2, -1.0, 1.0)))
        what = f"the camera is turned by about {angle_deg:.0f} deg"
        tried.append((poses, turn @ T_body_camera, sensor.name, what, remedy))
    for other, T, about, what, remedy in tried:
        motions = _relative(matches, other, T)
        moves = [_Move(match, motion) for match, motion in zip(matches, motions, strict=True)]
        if _excess(moves, sensor) <= most:
            return about, what, remedy
    return None


def _axis_turns() -> list[Array]:
    """The 23 rotations (4, 4) that turn axes onto axes, without the identity."""
    turns = []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.eye(4)
            turn[:3, :3] = np.diag(signs)[:, order]
            if np.linalg.det(turn) > 0 and not np.array_equal(turn, np.eye(4)):
                turns.append(turn)
    return turns


def _scales(evidence: DatasetEvidence, stream: StreamEvidence, moves: list[_Move], reason: str) -> Findings:
    """Compare the lengths that depth images, stereo baseline and ground truth give for the same points."""
    depth = depth_of(stream.sensor, evidence.dataset)
    by_motion = [
        (move, depths_by_triangulation(move.matches.first, move.matches.second, move.T_second_first)) for move in moves
    ]
    depth_over_truth = _ratio([(_metres(move.matches, depth), Z) for move, Z in by_motion])
    stereo_over_truth = _ratio([(move.matches.stereo_depths_m, Z) for move, Z in by_motion])
    depth_over_stereo = _ratio([(_metres(match, depth), match.stereo_depths_m) for match in stream.motion])
    if depth is not None:
        # Stereo and ground truth tell of the depth only where they agree with each other.
        if depth_over_truth is None and depth_over_stereo is None:
            yield NotChecked("depth-scale", depth.name, "too few points have a depth and move enough")
        elif depth_over_stereo is not None and _off(depth_over_stereo) and not _off(stereo_over_truth):
            yield _scale_finding("depth-scale", depth.name, depth_over_stereo, "the stereo baseline")
        elif depth_over_stereo is None and depth_over_truth is not None and _off(depth_over_truth):
            yield _scale_finding("depth-scale", depth.name, depth_over_truth, "the ground truth")
    if stereo_over_truth is None and depth_over_truth is None:
        yield NotChecked("truth-scale", TRUTH, reason if not moves else "too few points have a depth and move enough")
    elif _off(stereo_over_truth) and (depth_over_truth is None or _off(depth_over_truth)):
        yield _scale_finding("truth-scale", TRUTH, 1.0 / (stereo_over_truth or 1.0), "the stereo baseline")
    elif _off(stereo_over_truth) and stream.partner is not None:
        yield _scale_finding("stereo-scale", stream.partner.name, stereo_over_truth or 1.0, "depth and ground truth")


def _scale_finding(check: str, about: str, ratio: float, other: str) -> Finding:
    remedy = {
        "depth-scale": "correct units_per_m in dataset.yaml (1000 for mm, 5000 for TUM RGB-D)",
        "truth-scale": "write the positions of the ground truth in metres",
        "stereo-scale": "correct the baseline in T_body_sensor, in metres",
    }[check]
    what = {"depth-scale": "Depths", "truth-scale": "Motions of the ground truth", "stereo-scale": "Stereo depths"}[
        check
    ]
    return Finding(
        check,
        Severity.ERROR,
        about,
        f"{what} are {ratio:.3g} times those by {other}.",
        remedy,
        value=ratio,
        unit="times",
        expected=f"{SCALE_RANGE[0]} to {SCALE_RANGE[1]}",
    )


def _off(ratio: float | None) -> bool:
    return ratio is not None and not SCALE_RANGE[0] <= ratio <= SCALE_RANGE[1]


def _metres(match: MatchEvidence, depth: Sensor | None) -> Array | None:
    if depth is None or match.depths_raw is None:
        return None
    return np.where(match.depths_raw > 0, match.depths_raw / calibrated(depth, "units_per_m"), np.nan)


def _ratio(pairs: list[tuple[Array | None, Array | None]]) -> float | None:
    """Median ratio of the first to the second depths of all points that have both; None if there are few."""
    ratios = [first / second for first, second in pairs if first is not None and second is not None]
    known = np.concatenate(ratios) if ratios else np.zeros(0)
    known = known[np.isfinite(known) & (known > 0)]
    return float(np.median(known)) if len(known) >= FEWEST_LENGTHS else None
