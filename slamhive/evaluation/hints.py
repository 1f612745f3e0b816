"""Common mistakes behind a large error. Each is undone, and reported only if the error then collapses.

Little is tried on a pair that looks right, so this costs a few per cent of an evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Association, FrameFit
from slamhive.domain.verdict import Hint
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.pairing import image_times, shifted
from slamhive.trajectory.alignment import FrameOffset, Similarity, align, align_umeyama, fit_offset
from slamhive.trajectory.association import (
    COARSE_STEP_S,
    associate,
    coarse_offset,
    orientation_spread_deg,
    position_misfit,
    search_offset,
    sparse_truth,
    turning_misfit,
)
from slamhive.trajectory.evidence import misread_unit
from slamhive.trajectory.model import FloatArray, Poses, lacking
from slamhive.trajectory.transforms import inverse_quats, rotations_from_quats

# Poses that were written in another convention than they are read in. Each mistake is undone to see if it was made.


TRIED_POSES = 300
"""This many of the matched poses are enough."""
SUSPICIOUS_SHARE = 0.1
"""A position error above this share of the path's size is suspicious."""
SUSPICIOUS_DEG = 5.0
"""Orientations that differ from the ground truth by more are suspicious; those of real systems differ by less."""
COLLAPSE, GOOD_SHARE = 0.3, 0.2
"""A mistake is reported if undoing it leaves at most these shares of the position error and of the path's size, ..."""
ROTATION_COLLAPSE, ROTATION_GAIN_DEG = 0.5, 2.0
"""... or at most this share of the spread of orientations, and at least so many degrees less."""
KEPT = 1.2
"""The other of the two errors may grow by this factor."""
AMBIGUOUS = 3.0
"""An explanation that leaves up to this many times as much error may be right as well."""

Undo = Callable[[Poses], Poses]


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Agreement of matched poses if position, rotation and scale are free.

    Attributes:
        reference: Poses of the ground truth.
        estimate: As many of the estimate.
        transform: The alignment.
        ate_m: RMSE of the aligned positions.
        size_m: RMS distance of the ground truth from its middle.
        spread_deg: Spread of the orientation errors; None if orientations are not known.
    """

    reference: Poses
    estimate: Poses
    transform: Similarity
    ate_m: float
    size_m: float
    spread_deg: float | None


@dataclass(frozen=True, slots=True)
class Mistake:
    """A convention that may have been mistaken, by whoever wrote the estimate or the ground truth.

    Attributes:
        key: Of the hint.
        found: Describes it; ``{}`` stands for the file.
        remedy: What to do.
        undo: Turns wrong poses into right ones.
        truth_remedy: What to do if the ground truth is wrong; None if the two cases cannot be separated.
    """

    key: str
    found: str
    remedy: str
    undo: Undo
    truth_remedy: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """A mistake that explains the errors, and the fit without it."""

    mistake: Mistake
    of_truth: bool
    undone: Fit

    @property
    def left(self) -> float:
        """The remaining errors, as shares of the path's size and of a right angle."""
        return self.undone.ate_m / self.undone.size_m + (self.undone.spread_deg or 0.0) / 90.0


def thinned(poses: Poses) -> Poses:
    """Some hundreds of the poses, evenly spread."""
    return poses.take(np.unique(np.linspace(0, len(poses) - 1, TRIED_POSES).astype(np.intp)))


def fit_poses(reference: Poses, estimate: Poses, *, rotations: bool) -> Fit | None:
    """The fit of matched poses; None if they do not determine one."""
    try:
        transform = align_umeyama(estimate.positions_m, reference.positions_m, scaled=True)
    except InvalidInput:
        return None
    ate_m = rms_m(transform.points(estimate.positions_m) - reference.positions_m)
    size_m = rms_m(reference.positions_m - reference.positions_m.mean(axis=0))
    spread_deg = orientation_spread_deg(reference, estimate) if rotations else None
    return Fit(reference, estimate, transform, ate_m, size_m, spread_deg)


def rms_m(vectors_m: FloatArray) -> float:
    """Root of the mean squared length of vectors, shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors_m**2, axis=1))))


def mistaken_convention(fit: Fit) -> Hint | None:
    """The mistake that explains the errors best; None if none does, or if the errors are small.

    Some mistakes explain nearly as much in the ground truth as in the estimate; the hint then names both.
    """
    if not _positions_suspicious(fit) and not _rotations_suspicious(fit):
        return None
    explained = [entry for entry in _tried(fit) if _explains(fit, entry.undone)]
    if not explained:
        return None
    best = min(explained, key=lambda entry: entry.left)
    alike = [
        entry for entry in explained if entry.mistake.key == best.mistake.key and entry.left <= AMBIGUOUS * best.left
    ]
    # The best one of the estimate, then the best one of the ground truth, where there are any.
    owned = [[entry for entry in alike if entry.of_truth is of_truth] for of_truth in (False, True)]
    entries = [min(same, key=lambda entry: entry.left) for same in owned if same]
    owners = " or ".join(_OWNERS[entry.of_truth] for entry in entries)
    remedies = [(entry.mistake.truth_remedy or "") if entry.of_truth else entry.mistake.remedy for entry in entries]
    best = min(entries, key=lambda entry: entry.left)
    return Hint(
        best.mistake.key,
        f"{best.mistake.found.format(owners)}: {_collapse_words(fit, best.undone)}.",
        "; or ".join(remedies),
    )


def _tried(fit: Fit) -> Iterator[_Explanation]:
    for mistake in MISTAKES:
        for of_truth in (False, True) if mistake.truth_remedy is not None else (False,):
            undone = fit_poses(
                mistake.undo(fit.reference) if of_truth else fit.reference,
                fit.estimate if of_truth else mistake.undo(fit.estimate),
                rotations=fit.spread_deg is not None,
            )
            if undone is not None:
                yield _Explanation(mistake, of_truth, undone)


_OWNERS = {False: "the estimate", True: "the ground truth"}


def _positions_suspicious(fit: Fit) -> bool:
    return fit.ate_m > SUSPICIOUS_SHARE * fit.size_m


def _rotations_suspicious(fit: Fit) -> bool:
    return fit.spread_deg is not None and fit.spread_deg > SUSPICIOUS_DEG


def _explains(fit: Fit, undone: Fit) -> bool:
    """Tell if one of the errors collapses while the other does not grow."""
    positions, before = undone.ate_m / undone.size_m, fit.ate_m / fit.size_m
    positions_collapse = _positions_suspicious(fit) and positions <= COLLAPSE * before and positions <= GOOD_SHARE
    if fit.spread_deg is None or undone.spread_deg is None:
        return positions_collapse
    gain_deg = fit.spread_deg - undone.spread_deg
    rotations_collapse = (
        _rotations_suspicious(fit)
        and undone.spread_deg <= ROTATION_COLLAPSE * fit.spread_deg
        and gain_deg >= ROTATION_GAIN_DEG
    )
    if positions_collapse:
        return rotations_collapse or undone.spread_deg <= max(KEPT * fit.spread_deg, SUSPICIOUS_DEG)
    return rotations_collapse and positions <= KEPT * before


def _collapse_words(fit: Fit, undone: Fit) -> str:
    words = []
    if undone.ate_m / undone.size_m <= COLLAPSE * fit.ate_m / fit.size_m:
        words.append(
            f"the position error falls from {fit.ate_m / fit.size_m:.0%} to {undone.ate_m / undone.size_m:.1%} of the "
            "path's size"
        )
    if fit.spread_deg is not None and undone.spread_deg is not None and undone.spread_deg < fit.spread_deg:
        words.append(
            f"the orientations follow the ground truth to {undone.spread_deg:.1f} deg instead of {fit.spread_deg:.1f}"
        )
    return "with that undone " + " and ".join(words)


def _inverted(poses: Poses) -> Poses:
    """T_body_world for T_world_body: R^T and -R^T p."""
    positions_m = -np.einsum("nji,nj->ni", rotations_from_quats(poses.quats_xyzw), poses.positions_m)
    return Poses(poses.stamps_s, positions_m, inverse_quats(poses.quats_xyzw))


def _turned_back(poses: Poses) -> Poses:
    return Poses(poses.stamps_s, poses.positions_m, inverse_quats(poses.quats_xyzw))


def _mirrored(axis: int, *, turning: bool) -> Undo:
    """Positions with one axis reversed; with ``turning`` the orientations as well: M R M, as in a left-handed world."""
    signs_m = np.where(np.arange(3) == axis, -1.0, 1.0)
    signs = np.append(-signs_m, 1.0) if turning else np.ones(4)
    return lambda poses: Poses(poses.stamps_s, poses.positions_m * signs_m, poses.quats_xyzw * signs)


def _order(read_as: str, places: int) -> Mistake:
    return Mistake(
        "quaternion_order",
        "The quaternions of {} seem to stand in another order than they are read in",
        f"write the estimate as qx qy qz qw, or import it again with --quaternion-order {read_as}",
        lambda poses: Poses(poses.stamps_s, poses.positions_m, np.roll(poses.quats_xyzw, places, axis=1)),
        f"write the ground truth as qx qy qz qw, or import it again with --groundtruth-quaternion-order {read_as}",
    )


def _mirror(undo: Undo) -> Mistake:
    return Mistake(
        "mirrored_axes",
        "The path of {} seems to be mirrored, as in left-handed axes",
        "reverse the axis that points the wrong way, so that the axes are right-handed",
        undo,
    )


MISTAKES = (
    _order("wxyz", -1),
    _order("xyzw", 1),
    Mistake(
        "inverse_poses",
        "The poses of {} seem to be inverted, T_body_world instead of T_world_body",
        "write the estimated pose of the body in the world, which is the inverse of what is written",
        _inverted,
        "write the true pose of the body in the world, and import the dataset again",
    ),
    Mistake(
        "inverse_rotations",
        "The orientations of {} seem to be inverted, from world to body instead of from body to world",
        "write the orientation of the body in the world: reverse the signs of qx qy qz",
        _turned_back,
    ),
    _mirror(_mirrored(2, turning=True)),
    *(_mirror(_mirrored(axis, turning=False)) for axis in range(3)),
)


_SCALING = (Alignment.SIM3, Alignment.SCALE)


def find_hints(paired: Paired, values: Mapping[str, float]) -> tuple[Hint, ...]:
    """The likely mistakes in the pair; none if it looks right.

    Args:
        paired: The pair that was evaluated.
        values: Metrics of the evaluators; without ``ate.rmse`` there are no hints.
    """
    ate_m = values.get("ate.rmse")
    if ate_m is None:
        return ()
    misread = misread_unit(paired.estimate.stamps_s, paired.reference.stamps_s)
    if misread is not None:
        return (Hint("time_unit", f"{misread.sentence}.", misread.remedy),)
    fit = fit_poses(
        thinned(paired.matched_reference), thinned(paired.matched_estimate), rotations=paired.rotations_known
    )
    if fit is None:
        return ()
    convention = mistaken_convention(fit)
    # A wrong clock also shows as a lever arm along the motion, so it comes first.
    mistaken = convention or _gravity(paired, fit, ate_m) or _time_offset(paired, fit, ate_m)
    scale = _scale(paired, fit)
    found = [
        mistaken or (None if scale else _frame_offset(paired, fit)),
        _fitted_frame(paired),
        _truth_floor(ate_m, values.get("ate.truth_floor")),
        scale,
        _straight(paired, fit, ate_m),
        _sparse(paired),
    ]
    return tuple(hint for hint in found if hint is not None)


def _sparse(paired: Paired) -> Hint | None:
    """A ground truth of few poses, most of which no pose of the estimate is near enough to."""
    matched = len(np.unique(paired.matched_reference.stamps_s))
    remedy = sparse_truth(paired.reference, paired.estimate, paired.protocol, matched)
    if remedy is None:
        return None
    return Hint(
        "sparse_truth",
        f"Only {matched} of {len(paired.reference)} poses of the ground truth have one of the estimate within "
        f"{paired.protocol.association_tolerance_s:g} s.",
        remedy,
    )


LEAST_TILT_DEG = 20.0


def _gravity(paired: Paired, fit: Fit, ate_m: float) -> Hint | None:
    """A z axis that does not point up, which alignment by yaw does not change."""
    if paired.protocol.alignment is not Alignment.YAW_POSITION or ate_m <= SUSPICIOUS_SHARE * fit.size_m:
        return None
    tilt_deg = math.degrees(math.acos(max(-1.0, min(1.0, float(fit.transform.rotation[2, 2])))))
    if tilt_deg < LEAST_TILT_DEG or fit.ate_m > COLLAPSE * ate_m or fit.ate_m > GOOD_SHARE * fit.size_m:
        return None
    return Hint(
        "gravity",
        f"The z axis of the estimate does not point up: it is tilted by {tilt_deg:.0f} deg against that of the ground "
        f"truth. Alignment by yaw keeps the tilt; without it the position error falls from {ate_m:.3g} m to "
        f"{fit.ate_m:.3g} m.",
        "turn the world of the estimate so that z points up, or evaluate with --align se3",
    )


OFFSET_WITHIN_S = 10.0
LEAST_OFFSET_S = 0.01
OFFSET_COLLAPSE, LARGE_OFFSET_COLLAPSE = 0.4, 0.8
"""An offset is reported if at most this share of the error is left without it; the second is for large offsets."""
LARGE_OFFSET_S = 0.1
"""More than the delay of a frame: the clocks differ. Found by rotation only, since drift moves the best positions."""
ALONG_MOTION = 0.5
"""An offset moves poses along their path, in proportion to speed. Least share of the squared error that does so."""


def _time_offset(paired: Paired, fit: Fit, ate_m: float) -> Hint | None:
    """A clock that is ahead or behind."""
    protocol = paired.protocol
    if protocol.offset_search_s > 0 or protocol.association is Association.INDEX:
        return None
    small_s, share = _first_order_offset_s(paired)
    if share < ALONG_MOTION and ate_m <= SUSPICIOUS_SHARE * fit.size_m:
        return None
    coarse_s = coarse_offset(paired.reference, paired.estimate, OFFSET_WITHIN_S, by_turning=paired.rotations_known)
    guess_s = coarse_s or (small_s if share >= ALONG_MOTION else None)
    if guess_s is None or not _falls_to(_ate_with_offset_m(paired, guess_s), LARGE_OFFSET_COLLAPSE * ate_m):
        return None
    offset_s = _refined_offset_s(paired, guess_s)
    if offset_s is None or abs(offset_s) < LEAST_OFFSET_S:
        return None
    left_m = _ate_with_offset_m(paired, offset_s)
    large = abs(offset_s) >= LARGE_OFFSET_S and paired.rotations_known
    if left_m is None or not _falls_to(left_m, (LARGE_OFFSET_COLLAPSE if large else OFFSET_COLLAPSE) * ate_m):
        return None
    return Hint(
        "time_offset",
        f"The clock of the estimate is {abs(offset_s):.3f} s {'late' if offset_s < 0 else 'early'}: with "
        f"{offset_s:+.3f} s added to its timestamps the position error falls from {ate_m:.3g} m to {left_m:.3g} m.",
        f"evaluate under a protocol with offset_search_s: {max(1, math.ceil(2 * abs(offset_s)))}, "
        f"or with time_offset_s: {offset_s:.3f}",
    )


def _falls_to(left_m: float | None, most_m: float) -> bool:
    return left_m is not None and left_m <= most_m


def _first_order_offset_s(paired: Paired) -> tuple[float, float]:
    """The offset that explains most of the position error if errors grow with speed, and the share of its square."""
    reference = paired.matched_reference
    steps_s = reference.stamps_s[2:] - reference.stamps_s[:-2]
    kept = (steps_s > 0) & (steps_s <= paired.protocol.gap_threshold_s)
    speeds = (reference.positions_m[2:] - reference.positions_m[:-2])[kept] / steps_s[kept, None]
    errors_m = (paired.aligned.positions_m - reference.positions_m)[1:-1][kept]
    along = float((speeds * errors_m).sum())
    squared_speeds, squared_m = float((speeds**2).sum()), float((errors_m**2).sum())
    if squared_speeds == 0 or squared_m == 0:
        return 0.0, 0.0
    return along / squared_speeds, along**2 / (squared_speeds * squared_m)


def _refined_offset_s(paired: Paired, guess_s: float) -> float | None:
    """The offset near the guess where the motion fits best; None if there is no best one, as with few keyframes."""
    reference, estimate = paired.reference, paired.estimate
    if paired.rotations_known:
        misfit = turning_misfit(reference, estimate)
    else:
        misfit = position_misfit(reference, estimate, paired.protocol.alignment)
    try:
        return search_offset(misfit, guess_s, 2 * COARSE_STEP_S)
    except InvalidInput:
        return None


def _ate_with_offset_m(paired: Paired, offset_s: float) -> float | None:
    protocol = paired.protocol
    try:
        reference, estimate = associate(
            paired.reference, shifted(paired.estimate, offset_s), protocol, image_times(paired.files, protocol)
        )
        transform = align(protocol.alignment, estimate, reference, protocol.align_poses)
    except InvalidInput:
        return None
    if 2 * len(reference) < len(paired.matched_reference):
        return None
    return rms_m(transform.points(estimate.positions_m) - reference.positions_m)


LEAST_TURN_DEG, TURN_SPREAD = 4.0, 0.3
"""A constant rotation is reported above this angle if the orientations stray by at most this share of it."""
ARM_COLLAPSE, ARM_SIGMAS = 1 / 3, 5.0
"""A lever arm is reported if at most this share of the position error is left with it, and it is that certain."""


def _frame_offset(paired: Paired, fit: Fit) -> Hint | None:
    """A constant transform between the frames of estimate and ground truth: another sensor, an antenna, a prism."""
    if paired.fitted is not None or lacking(fit.estimate.quats_xyzw, fit.estimate.positions_m):
        return None
    oriented, scaled = paired.rotations_known, paired.protocol.alignment in _SCALING
    if scaled and not oriented:
        return None
    offset = fit_offset(fit.reference, fit.estimate, oriented=oriented, scaled=scaled)
    along_m, aside_m = _extents_m(fit.reference.positions_m)[:2]
    turned = (
        offset.spread_deg is not None
        and aside_m > STRAIGHT * along_m  # else alignment turns the estimate about the line as it likes
        and offset.angle_deg >= LEAST_TURN_DEG
        and offset.spread_deg <= TURN_SPREAD * offset.angle_deg
    )
    shifted_away = (
        offset.after_m <= ARM_COLLAPSE * offset.before_m
        and offset.arm_length_m >= ARM_SIGMAS * offset.arm_length_sigma_m
    )
    if not turned and not shifted_away:
        return None
    words = []
    if turned:
        words.append(
            f"The orientations of the estimate differ from the ground truth by a constant rotation of "
            f"{offset.angle_deg:.1f} +- {offset.rotation_sigma_deg:.2g} deg, from which they stray by "
            f"{offset.spread_deg:.1f} deg only."
        )
    if shifted_away:
        words.append(
            f"With a constant lever arm of {_numbers(offset.arm_m)} +- {_numbers(offset.arm_sigma_m)} m the position "
            f"error falls from {offset.before_m:.3g} m to {offset.after_m:.3g} m."
        )
    fitted = FrameFit.POSE if turned and shifted_away else FrameFit.ROTATION if turned else FrameFit.LEVER_ARM
    return Hint("frame_offset", " ".join(words), _frame_remedy(paired, offset, fitted))


def _frame_remedy(paired: Paired, offset: FrameOffset, fit: FrameFit) -> str:
    """Words that state what the fit means for protocol and dataset."""
    T = np.eye(4)
    if fit is not FrameFit.LEVER_ARM:
        T[:3, :3] = offset.rotation
    if fit is not FrameFit.ROTATION:
        T[:3, 3] = offset.arm_m
    T = paired.T_body_estimate @ T
    if not paired.rotations_known:
        stated = (
            f"write lever_arm_m: [{_numbers(T[:3, 3], ', ')}] of the antenna or prism into dataset.yaml or a protocol"
        )
    else:
        numbers = ", ".join(f"{value:.6g}" for value in (np.round(T, 9) + 0.0).ravel())
        stated = (
            "name the sensor that the estimate describes (slamhive evaluate --sensor-frame), or evaluate under a "
            f"protocol with T_body_sensor: [{numbers}]"
        )
    return f"{stated}; frame_fit: {fit} fits and reports it each time"


def _numbers(values: FloatArray, between: str = " ") -> str:
    return between.join("open" if not np.isfinite(value) else f"{value:.3f}" for value in values)


def _fitted_frame(paired: Paired) -> Hint | None:
    """The transform that the protocol has fitted: it is no longer part of the errors."""
    offset, fit = paired.fitted, paired.protocol.frame_fit
    if offset is None or fit is None:
        return None
    words = []
    if fit is not FrameFit.LEVER_ARM:
        words.append(f"a rotation of {offset.angle_deg:.2f} +- {offset.rotation_sigma_deg:.2g} deg")
    if fit is not FrameFit.ROTATION:
        words.append(
            f"a lever arm of {_numbers(offset.arm_m)} +- {_numbers(offset.arm_sigma_m)} m, which changed the position "
            f"error from {offset.before_m:.3g} m to {offset.after_m:.3g} m"
        )
    # The transform is part of T_body_estimate here already.
    nothing = replace(offset, rotation=np.eye(3), arm_m=np.zeros(3))
    return Hint(
        "frame_fitted",
        f"The protocol fitted {' and '.join(words)}, so neither counts as an error.",
        _frame_remedy(paired, nothing, FrameFit.POSE).split(";")[0],
    )


FLOOR_TIMES = 2.0
"""An error below this many times the floor says more about the ground truth than about the system."""


def _truth_floor(ate_m: float, floor_m: float | None) -> Hint | None:
    """An error that the uncertainty of the ground truth explains."""
    if floor_m is None or ate_m > FLOOR_TIMES * floor_m:
        return None
    return Hint(
        "truth_floor",
        f"The position error of {ate_m:.3g} m is near the {floor_m:.3g} m that the uncertainty of the ground truth "
        "gives alone.",
        f"do not rank runs by differences below {floor_m:.3g} m",
    )


_FACTORS = {1000.0: "millimetres", 100.0: "centimetres", 0.001: "kilometres"}
"""The unit of an estimate that is too large by this factor."""
SCALE_TOLERANCE = 0.15
"""The scale of a real system is wrong by this share at most."""


def _scale(paired: Paired, fit: Fit) -> Hint | None:
    """An estimate that is not in metres."""
    if fit.ate_m > GOOD_SHARE * fit.size_m:
        return None
    times_too_large = 1.0 / fit.transform.scale
    for factor, unit in _FACTORS.items():
        # A free scale, as with one camera, can have any value: only factors of a thousand are reported.
        likely = paired.protocol.alignment not in _SCALING or factor != 100.0
        if likely and abs(times_too_large / factor - 1.0) <= SCALE_TOLERANCE:
            other = ", or the ground truth in millimetres" if factor < 1 else ""
            return Hint(
                "scale",
                f"The estimate is {times_too_large:.4g} times as large as the ground truth: it seems to be in "
                f"{unit}{other}.",
                "write positions in metres",
            )
    return None


STRAIGHT = 0.1
"""A path is straight if the RMS extent to the side is less than this share of that along it."""
LEAST_OPEN_DEG = 5.0


def _straight(paired: Paired, fit: Fit, ate_m: float) -> Hint | None:
    """A path so straight that the rotation about its direction is hardly known."""
    if paired.protocol.alignment not in (Alignment.SE3, Alignment.SIM3):
        return None
    along_m, aside_m = _extents_m(fit.reference.positions_m)[:2]
    open_deg = math.degrees(math.atan2(ate_m, aside_m))
    if aside_m > STRAIGHT * along_m or open_deg < LEAST_OPEN_DEG:
        return None
    return Hint(
        "straight_path",
        f"The path is nearly straight: it strays {aside_m:.2g} m from a line, and the position error is {ate_m:.2g} m. "
        f"So alignment may turn it about that line by up to about {open_deg:.0f} deg.",
        "do not compare orientations of this run, or align with first_pose, or with yaw_position where z points up",
    )


def _extents_m(positions_m: FloatArray) -> FloatArray:
    """RMS extents along the principal axes, the largest first, shape (3,)."""
    centred = positions_m - positions_m.mean(axis=0)
    extents: FloatArray = np.linalg.svd(centred, compute_uv=False) / math.sqrt(len(centred))
    return extents
