"""Common mistakes behind a large error. Each is undone, and reported only if the error then collapses.

Little is tried on a pair that looks right, so this costs a few per cent of an evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from slamhive.domain.hint import Hint
from slamhive.domain.protocol import Alignment, Association
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators.base import Paired
from slamhive.evaluation.mistakes import (
    COLLAPSE,
    GOOD_SHARE,
    SUSPICIOUS_SHARE,
    Fit,
    fit_poses,
    mistaken_convention,
    rms_m,
    thinned,
)
from slamhive.evaluation.pairing import shifted
from slamhive.trajectory.alignment import align
from slamhive.trajectory.association import associate
from slamhive.trajectory.evidence import misread_unit
from slamhive.trajectory.model import FloatArray
from slamhive.trajectory.offset import COARSE_STEP_S, coarse_offset, position_misfit, search_offset, turning_misfit

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
    unit = _time_unit(paired)
    if unit is not None:
        return (unit,)
    fit = fit_poses(
        thinned(paired.matched_reference), thinned(paired.matched_estimate), rotations=paired.rotations_known
    )
    if fit is None:
        return ()
    convention = mistaken_convention(fit)
    found = [
        convention or _gravity(paired, fit, ate_m) or _time_offset(paired, fit, ate_m),
        _scale(paired, fit),
        _straight(paired, fit, ate_m),
    ]
    return tuple(hint for hint in found if hint is not None)


def _time_unit(paired: Paired) -> Hint | None:
    """Timestamps that hardly overlap, and would in another unit."""
    found = misread_unit(paired.estimate.stamps_s, paired.reference.stamps_s)
    return None if found is None else Hint("time_unit", f"{found.sentence}.", found.remedy)


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
    guess_s = _guessed_offset_s(paired, suspicious=ate_m > SUSPICIOUS_SHARE * fit.size_m)
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


def _guessed_offset_s(paired: Paired, *, suspicious: bool) -> float | None:
    """The offset that the rates of motion suggest, or a small one; None if the error gives no reason to search."""
    small_s, share = _first_order_offset_s(paired)
    if share < ALONG_MOTION and not suspicious:
        return None
    by_turning = paired.rotations_known
    coarse_s = coarse_offset(paired.reference, paired.estimate, OFFSET_WITHIN_S, by_turning=by_turning)
    return coarse_s or (small_s if share >= ALONG_MOTION else None)


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
        reference, estimate = associate(paired.reference, shifted(paired.estimate, offset_s), protocol)
        transform = align(protocol.alignment, estimate, reference, protocol.align_poses)
    except InvalidInput:
        return None
    if 2 * len(reference) < len(paired.matched_reference):
        return None
    return rms_m(transform.points(estimate.positions_m) - reference.positions_m)


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
