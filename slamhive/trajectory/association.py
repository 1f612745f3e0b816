"""Association: pairs poses of the estimate with poses of the ground truth, and finds the offset of their clocks."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Association, Protocol
from slamhive.trajectory.alignment import align, align_umeyama
from slamhive.trajectory.evidence import misread_unit
from slamhive.trajectory.layout import QuaternionOrder
from slamhive.trajectory.model import FloatArray, Poses, Trajectory
from slamhive.trajectory.transforms import (
    interpolate,
    inverse_quats,
    multiply_quats,
    quats_from_rotations,
    rotation_angles_rad,
)

Indices = npt.NDArray[np.intp]


def associate(
    reference: Trajectory, estimate: Trajectory, protocol: Protocol, image_times_s: FloatArray | None = None
) -> tuple[Poses, Poses]:
    """Matched poses of ground truth and estimate, by the rule of ``protocol.association``.

    Args:
        reference: The ground truth.
        estimate: The estimate, its timestamps on the clock of the ground truth.
        protocol: Says how, and how far apart.
        image_times_s: When images were taken, on the clock of the ground truth, increasing, shape (k,). A protocol that
            holds the estimate compares at these times; None: at those of the ground truth.

    Raises:
        InvalidInput: No pose has a match, or, by index, their numbers differ.
    """
    how = protocol.association
    if how is Association.INDEX:
        if len(reference) != len(estimate):
            raise InvalidInput(
                f"poses are matched by index, but the estimate has {len(estimate)} and the ground truth "
                f"{len(reference)}",
                "choose an association by time, or a run that tracked every frame",
            )
        return reference, estimate
    if how is Association.INTERPOLATE:
        pair = interpolated(reference, estimate, protocol.interpolation_interval_s)
    elif how is Association.INTERPOLATE_ESTIMATE:
        pair = interpolated(estimate, reference, protocol.interpolation_interval_s)[::-1]
    elif how is Association.HOLD:
        pair = _held(reference, estimate, protocol.hold_interval_s, image_times_s)
    else:
        match = {Association.ONE_TO_ONE: match_one_to_one, Association.SWEEP: match_in_one_sweep}.get(
            how, match_nearest
        )
        of_reference, of_estimate = match(reference.stamps_s, estimate.stamps_s, protocol.association_tolerance_s)
        pair = reference.take(of_reference), estimate.take(of_estimate)
    if len(pair[0]) == 0:
        raise _no_match(reference, estimate, protocol, image_times_s)
    return pair


def match_nearest(reference_s: FloatArray, estimate_s: FloatArray, tolerance_s: float) -> tuple[Indices, Indices]:
    """For each timestamp of the shorter list the nearest of the other, if it is within the tolerance.

    The rule of evo (https://github.com/MichaelGrupp/evo, ``evo.core.sync``), ties included: not one to one.

    Args:
        reference_s: Increasing, shape (m,).
        estimate_s: Increasing, shape (n,).
        tolerance_s: Largest gap, itself allowed.

    Returns:
        The indices of the matched timestamps in both lists.
    """
    if len(estimate_s) > len(reference_s):
        of_estimate, of_reference = _nearest(reference_s, estimate_s, tolerance_s)
        return of_reference, of_estimate
    return _nearest(estimate_s, reference_s, tolerance_s)


def _nearest(short_s: FloatArray, long_s: FloatArray, tolerance_s: float) -> tuple[Indices, Indices]:
    """Indices into ``long_s`` and ``short_s``; of two that are equally near, the earlier."""
    upper = np.clip(np.searchsorted(long_s, short_s, side="right"), 0, len(long_s) - 1)
    lower = np.maximum(upper - 1, 0)
    above_s = long_s[upper] - short_s  # below 0 behind the end, where `inside` decides
    below_s = np.where(upper > 0, short_s - long_s[lower], np.inf)
    best = np.where(above_s < below_s, upper, lower)
    inside = (short_s >= long_s[0] - tolerance_s) & (short_s <= long_s[-1] + tolerance_s)
    matched = np.flatnonzero(inside & (np.minimum(above_s, below_s) <= tolerance_s))
    return best[matched], matched


def match_one_to_one(reference_s: FloatArray, estimate_s: FloatArray, tolerance_s: float) -> tuple[Indices, Indices]:
    """Pairs of timestamps less than the tolerance apart, taken by growing gap, each timestamp once.

    The rule of the TUM RGB-D benchmark's ``associate.py`` (Sturm et al., IROS 2012). Arguments and result as those of
    :func:`match_nearest`, but a gap of the tolerance itself is too large.
    """
    first = np.searchsorted(reference_s, estimate_s - tolerance_s, side="left")
    last = np.searchsorted(reference_s, estimate_s + tolerance_s, side="right")
    counts = last - first
    of_estimate = np.repeat(np.arange(len(estimate_s)), counts)
    begins = np.repeat(np.cumsum(counts) - counts, counts)
    of_reference = np.arange(len(of_estimate)) - begins + np.repeat(first, counts)
    gaps_s = np.abs(reference_s[of_reference] - estimate_s[of_estimate])
    near = gaps_s < tolerance_s
    of_reference, of_estimate, gaps_s = of_reference[near], of_estimate[near], gaps_s[near]
    free_reference, free_estimate = np.ones(len(reference_s), bool), np.ones(len(estimate_s), bool)
    taken: list[int] = []
    for pair in np.lexsort((of_estimate, of_reference, gaps_s)).tolist():
        i, j = of_reference[pair], of_estimate[pair]
        if free_reference[i] and free_estimate[j]:
            free_reference[i] = free_estimate[j] = False
            taken.append(pair)
    chosen = np.sort(np.array(taken, dtype=np.intp)) if taken else np.empty(0, dtype=np.intp)
    return of_reference[chosen], of_estimate[chosen]


def match_in_one_sweep(reference_s: FloatArray, estimate_s: FloatArray, tolerance_s: float) -> tuple[Indices, Indices]:
    """Each timestamp of the estimate in turn takes the nearest one of the ground truth after the last one taken.

    The rule of OpenVINS (https://github.com/rpng/open_vins, ``ov_eval``): one to one and in order, but what an earlier
    timestamp has taken is lost for a later one that would be nearer. Arguments and result as those of
    :func:`match_one_to_one`.
    """
    listed_s, wanted_s = reference_s.tolist(), estimate_s.tolist()
    of_reference: list[int] = []
    of_estimate: list[int] = []
    free = 0
    for own, best in enumerate(nearest_indices(reference_s, estimate_s).tolist()):
        taken = max(best, free)
        if taken < len(listed_s) and abs(listed_s[taken] - wanted_s[own]) < tolerance_s:
            of_reference.append(taken)
            of_estimate.append(own)
            free = taken + 1
    return np.array(of_reference, dtype=np.intp), np.array(of_estimate, dtype=np.intp)


def nearest_indices(values: FloatArray, wanted: FloatArray) -> Indices:
    """The index of the nearest of ``values``, never decreasing, for each of ``wanted``; of two as near, the earlier."""
    lower, upper, nearer = _around(values, wanted)
    return np.where(nearer > 0, upper, lower)


def nearest_as_tum(values: FloatArray, wanted: FloatArray) -> Indices:
    """The same as ``find_closest_index`` of TUM's ``evaluate_rpe.py`` finds it.

    Of two as near, that is the one which its binary search meets first, or the first value of all.
    """
    lower, upper, nearer = _around(values, wanted)
    found = np.where(nearer > 0, upper, lower)
    for tie in np.flatnonzero((nearer == 0) & (lower < upper) & (lower > 0)).tolist():
        begin, end = 0, len(values)
        while (middle := (begin + end) // 2) not in (lower[tie], upper[tie]):
            begin, end = (begin, middle) if middle > upper[tie] else (middle + 1, end)
        found[tie] = middle
    return found


def _around(values: FloatArray, wanted: FloatArray) -> tuple[Indices, Indices, Indices]:
    """The values' indices below and above each of ``wanted``, and which is nearer: 1 above, -1 below, 0 both."""
    above = np.searchsorted(values, wanted)
    lower, upper = np.maximum(above - 1, 0), np.minimum(above, len(values) - 1)
    nearer = np.sign(np.abs(values[lower] - wanted) - np.abs(values[upper] - wanted)).astype(np.intp)
    return lower, upper, nearer


def interpolated(trajectory: Trajectory, other: Trajectory, interval_s: float) -> tuple[Poses, Poses]:
    """One trajectory at those timestamps of the other that its own poses enclose, never beyond its ends.

    Args:
        trajectory: What is interpolated.
        other: What gives the timestamps.
        interval_s: The enclosing poses are no further apart than this; a pose with the timestamp itself needs no other.

    Returns:
        The interpolated poses, and those of the other at the same timestamps.
    """
    stamps_s = other.stamps_s
    after = np.searchsorted(trajectory.stamps_s, stamps_s, side="left")
    exact = np.zeros(len(stamps_s), bool)
    inside = after < len(trajectory)
    exact[inside] = trajectory.stamps_s[after[inside]] == stamps_s[inside]
    between = inside & (after > 0)
    close = np.zeros(len(stamps_s), bool)
    close[between] = trajectory.stamps_s[after[between]] - trajectory.stamps_s[after[between] - 1] <= interval_s
    kept = np.flatnonzero(exact | close)
    return interpolate(trajectory, stamps_s[kept]), other.take(kept)


SPARSE_GAIN = 2
"""Interpolation of the estimate is recommended if it matches at least this many times as many poses."""


def sparse_truth(reference: Trajectory, estimate: Trajectory, protocol: Protocol, matched: int) -> str | None:
    """Advice to interpolate the estimate, where the rule of the protocol passes by most poses of a sparse truth.

    Args:
        reference: The ground truth.
        estimate: The estimate, on the same clock.
        protocol: Its association takes poses within a tolerance, else there is no advice.
        matched: Number of poses that it has matched.
    """
    if protocol.association in _NOT_BY_TOLERANCE or len(reference) < 2 or len(estimate) < len(reference):
        return None
    # Of a live trajectory nearly all intervals are equal; those of keyframes differ, and long ones are not bridged.
    interval_s = 2.0 * float(np.median(np.diff(estimate.stamps_s)))
    could = len(interpolated(estimate, reference, max(interval_s, protocol.interpolation_interval_s))[1])
    if could < max(SPARSE_GAIN * matched, 3):
        return None
    every_s = float(np.median(np.diff(reference.stamps_s)))
    more = "" if interval_s <= protocol.interpolation_interval_s else f" and interpolation_interval_s: {interval_s:.2g}"
    return (
        f"evaluate under a protocol with association: interpolate_estimate{more}, which matches {could} of the "
        f"{len(reference)} poses of this ground truth, one every {every_s:.3g} s"
    )


_NOT_BY_TOLERANCE = {
    Association.INDEX,
    Association.HOLD,
    Association.INTERPOLATE,
    Association.INTERPOLATE_ESTIMATE,
}


def _held(
    reference: Trajectory, estimate: Trajectory, interval_s: float | None, image_times_s: FloatArray | None
) -> tuple[Poses, Poses]:
    """The estimate at every timestamp of the ground truth: between its poses interpolated, beyond its ends held.

    With an interval, at those timestamps of the ground truth whose next one is no further away. With times of images,
    at those that the ground truth encloses, no further apart than the interval, and the ground truth interpolated too.
    """
    if estimate.stamps_s[0] > reference.stamps_s[-1] or estimate.stamps_s[-1] < reference.stamps_s[0]:
        return reference.take(np.empty(0, np.intp)), estimate.take(np.empty(0, np.intp))
    if image_times_s is not None:
        after = np.searchsorted(reference.stamps_s, image_times_s, side="right")
        inside = np.flatnonzero((after > 0) & (after < len(reference)))
        apart_s = reference.stamps_s[after[inside]] - reference.stamps_s[after[inside] - 1]
        stamps_s = image_times_s[inside[apart_s <= (np.inf if interval_s is None else interval_s)]]
        return interpolate(reference, stamps_s), interpolate(estimate, stamps_s)
    if interval_s is None:
        return reference, interpolate(estimate, reference.stamps_s)
    kept = reference.take(np.flatnonzero(np.diff(reference.stamps_s) <= interval_s))
    return kept, interpolate(estimate, kept.stamps_s)


def _no_match(
    reference: Trajectory, estimate: Trajectory, protocol: Protocol, image_times_s: FloatArray | None
) -> InvalidInput:
    spans = (
        f"estimate {estimate.stamps_s[0]:.3f} to {estimate.stamps_s[-1]:.3f} s, "
        f"ground truth {reference.stamps_s[0]:.3f} to {reference.stamps_s[-1]:.3f} s"
    )
    misread = misread_unit(estimate.stamps_s, reference.stamps_s)
    if misread is not None:
        return InvalidInput(f"estimate and ground truth do not match in time: {misread.sentence}", misread.remedy)
    apart = estimate.stamps_s[0] > reference.stamps_s[-1] or estimate.stamps_s[-1] < reference.stamps_s[0]
    if apart:
        return InvalidInput(
            f"estimate and ground truth do not overlap in time: {spans}",
            "use the same clock for both; if they begin at the same moment, evaluate under a protocol with "
            f"time_offset_s: {reference.stamps_s[0] - estimate.stamps_s[0]:.3f} and offset_search_s: 5",
        )
    if protocol.association is Association.HOLD and image_times_s is not None:
        near = "" if protocol.hold_interval_s is None else f" at most {protocol.hold_interval_s:g} s apart"
        return InvalidInput(
            f"no image was taken between two poses of the ground truth{near}: {len(image_times_s)} images, {spans}",
            "raise hold_interval_s, or give the times of the images on the clock of the ground truth",
        )
    if protocol.association is Association.HOLD:
        return InvalidInput(
            f"no two poses of the ground truth are within {protocol.hold_interval_s:g} s, the hold interval",
            "raise hold_interval_s, or use a denser ground truth",
        )
    if protocol.association is Association.INTERPOLATE_ESTIMATE:
        interval_s = protocol.interpolation_interval_s
        return InvalidInput(
            f"no ground-truth pose lies between estimated poses at most {interval_s:g} s apart: {spans}",
            "raise interpolation_interval_s, or use an estimate with more poses",
        )
    if protocol.association is Association.INTERPOLATE:
        interval_s = protocol.interpolation_interval_s
        return InvalidInput(
            f"no estimated pose lies between ground-truth poses at most {interval_s:g} s apart: {spans}",
            "raise the interpolation interval, or use a denser ground truth",
        )
    return InvalidInput(
        f"no estimated pose is within {protocol.association_tolerance_s:g} s of a ground-truth pose: {spans}",
        sparse_truth(reference, estimate, protocol, 0)
        or "raise the association tolerance, or use a denser ground truth",
    )


# Measures how well the orientations of an estimate agree with the ground truth, in whatever frames.


MATCHED_WITHIN_S = 0.05
MINIMUM_MATCHED = 10
COMPARED_POSES = 500
"""Spread over the trajectory; more give no further information."""


def thinned_pair(reference: Trajectory, estimate: Trajectory) -> tuple[Poses, Poses] | None:
    """Some hundreds of matched poses of both, spread over the estimate; None where fewer than ten match."""
    of_reference, of_estimate = match_nearest(reference.stamps_s, estimate.stamps_s, MATCHED_WITHIN_S)
    if len(of_reference) < MINIMUM_MATCHED:
        return None
    chosen = np.unique(np.linspace(0, len(of_reference) - 1, COMPARED_POSES).astype(np.intp))
    return reference.take(of_reference[chosen]), estimate.take(of_estimate[chosen])


def reordered(poses: Poses, order: QuaternionOrder) -> Poses:
    """The poses with their quaternions, taken for x y z w, read in ``order`` instead."""
    if order is QuaternionOrder.XYZW:
        return poses
    return Poses(poses.stamps_s, poses.positions_m, np.roll(poses.quats_xyzw, -1, axis=1))


def orientation_spread_deg(reference: Poses, estimate: Poses) -> float | None:
    """Deviation of the rotation between the two moving frames from a constant one, in degrees.

    Both frames may be mounted anyhow, so only what changes between them counts: the median angle to their mean. The
    worlds are aligned by positions (Umeyama), with scale; None where those leave it open.

    Args:
        reference: Matched poses of the ground truth, n of them.
        estimate: Matched poses of the estimate, n of them.
    """
    try:
        rotation = align_umeyama(estimate.positions_m, reference.positions_m, scaled=True).rotation
    except InvalidInput:
        return None
    turned = multiply_quats(quats_from_rotations(rotation[None]), estimate.quats_xyzw)
    return spread_deg(multiply_quats(inverse_quats(reference.quats_xyzw), turned))


def spread_deg(quats_xyzw: FloatArray) -> float:
    """Median angle of orientations, shape (n, 4), to their mean, in degrees.

    The mean is the eigenvector of the largest eigenvalue of the sum of q q^T (Markley et al., "Averaging quaternions",
    JGCD 2007, equation 12).
    """
    _, vectors = np.linalg.eigh(quats_xyzw.T @ quats_xyzw)
    mean = vectors[None, :, -1]
    return float(np.rad2deg(np.median(rotation_angles_rad(np.repeat(mean, len(quats_xyzw), axis=0), quats_xyzw))))


# Finds the time offset between two clocks, at which the angular rates fit best, or else the positions.


PRECISION_S = 1e-5
"""The search ends when the offset is known to this: a fiftieth of the shortest frame time of a camera or less."""

_FLAT = 1e-6
"""Smaller differences of errors (rad/s or m) are not significant."""
_GOLDEN = (math.sqrt(5) - 1) / 2


STEP_S = 0.02
"""Step of the first search: angular rate and position change little in this time."""
TURNING_S = 0.1
"""The angular rate is taken over about this time: shorter drowns in noise, longer smears fast turns."""
LONGEST_TURNING_S = 0.5
MINIMUM_COMPARED = 10
"""With fewer rates or positions any offset fits."""

Misfit = Callable[[float], tuple[float, int]]
"""Of an offset in s: the error, and over how many poses; infinite and 0 where nothing can be compared."""


def turning_misfit(reference: Trajectory, estimate: Trajectory) -> Misfit:
    """Of the angular rates, in rad/s: whatever world, scale and lever arm the two have, and however they drift.

    The estimate's rates are taken between its own poses, the ground truth's between its poses interpolated at the same
    times.
    """
    stamps_s = estimate.stamps_s
    step_s = float(np.median(np.diff(stamps_s))) if len(estimate) > 1 else 0.0
    apart = max(1, round(TURNING_S / step_s)) if step_s > 0 else 1
    begins_s, ends_s = stamps_s[:-apart], stamps_s[apart:]
    kept = (ends_s > begins_s) & (ends_s - begins_s <= LONGEST_TURNING_S)
    rates = rotation_angles_rad(estimate.quats_xyzw[:-apart][kept], estimate.quats_xyzw[apart:][kept])
    begins_s, ends_s = begins_s[kept], ends_s[kept]
    rates /= ends_s - begins_s

    def misfit(offset_s: float) -> tuple[float, int]:
        inside = _inside(reference, begins_s + offset_s) & _inside(reference, ends_s + offset_s)
        count = int(np.count_nonzero(inside))
        if count < MINIMUM_COMPARED:
            return math.inf, 0
        first, second = (interpolate(reference, t[inside] + offset_s).quats_xyzw for t in (begins_s, ends_s))
        true = rotation_angles_rad(first, second) / (ends_s - begins_s)[inside]
        return float(np.sqrt(np.mean((rates[inside] - true) ** 2))), count

    return misfit


def position_misfit(reference: Trajectory, estimate: Trajectory, alignment: Alignment) -> Misfit:
    """Of the aligned positions, in m; for a ground truth without orientations."""

    def misfit(offset_s: float) -> tuple[float, int]:
        stamps_s = estimate.stamps_s + offset_s
        kept = np.flatnonzero(_inside(reference, stamps_s))
        if len(kept) < MINIMUM_COMPARED:
            return math.inf, 0
        matched, moved = interpolate(reference, stamps_s[kept]), estimate.take(kept)
        try:
            transform = align(alignment, moved, matched)
        except InvalidInput:
            return math.inf, 0
        errors_m = np.linalg.norm(transform.points(moved.positions_m) - matched.positions_m, axis=1)
        return float(np.sqrt(np.mean(errors_m**2))), len(kept)

    return misfit


def _inside(reference: Trajectory, stamps_s: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = (stamps_s >= reference.stamps_s[0]) & (
        stamps_s <= reference.stamps_s[-1]
    )
    return inside


def search_offset(misfit: Misfit, centre_s: float, within_s: float) -> float:
    """The offset in s with the least error, within ``within_s`` of ``centre_s``.

    The error is taken every :data:`STEP_S`, and between the neighbours of the best by golden-section search (Kiefer,
    "Sequential minimax search for a maximum", 1953). Offsets that leave less than half of the poses to compare do not
    count: a few poses always fit.

    Args:
        misfit: What to make small.
        centre_s: Middle of the search.
        within_s: Half its width.

    Raises:
        InvalidInput: They can be compared nowhere, or the best is at an end of the search, so that more lies beyond.
    """
    count = max(1, math.ceil(within_s / STEP_S))
    offsets_s = centre_s + np.linspace(-within_s, within_s, 2 * count + 1)
    found = [misfit(float(offset_s)) for offset_s in offsets_s]
    most = max(count for _, count in found)
    errors = [error if 2 * count >= most else math.inf for error, count in found]
    best = int(np.argmin(errors))
    if not math.isfinite(errors[best]):
        raise InvalidInput(
            f"no time offset within {within_s:g} s of {centre_s:g} s makes estimate and ground truth overlap",
            "give the offset, or search further",
        )
    if max(error for error in errors if math.isfinite(error)) - errors[best] <= _FLAT:
        raise InvalidInput(
            "no time offset can be found: estimate and ground truth fit equally well at all, they hardly move",
            "give the offset, or search on a run that turns",
        )
    if best in {0, len(errors) - 1}:
        raise InvalidInput(
            f"the time offset is not within {within_s:g} s of {centre_s:g} s: the error still falls at "
            f"{offsets_s[best]:+g} s",
            "search further, or give the offset",
        )
    low_s, high_s = float(offsets_s[best - 1]), float(offsets_s[best + 1])
    inner = [high_s - _GOLDEN * (high_s - low_s), low_s + _GOLDEN * (high_s - low_s)]
    errors = [misfit(offset_s)[0] for offset_s in inner]
    while high_s - low_s > PRECISION_S:
        if errors[0] <= errors[1]:
            high_s = inner[1]
            inner = [high_s - _GOLDEN * (high_s - low_s), inner[0]]
            errors = [misfit(inner[0])[0], errors[0]]
        else:
            low_s = inner[0]
            inner = [inner[1], low_s + _GOLDEN * (high_s - low_s)]
            errors = [errors[1], misfit(inner[1])[0]]
    return (low_s + high_s) / 2


COARSE_STEP_S = 0.05
"""Time between the correlated samples: a peak of the angular rate is wider."""
MOST_SAMPLES = 200_000
"""The first ten thousand seconds suffice to find an offset."""
_LEAST_CORRELATION = 0.25
"""A smaller correlation is chance. The result is a start that is checked later."""


def coarse_offset(reference: Trajectory, estimate: Trajectory, within_s: float, *, by_turning: bool) -> float | None:
    """The offset in s at which the rates of motion of both correlate best, to :data:`COARSE_STEP_S`.

    Fast (one Fourier transform for all offsets), and a start for :func:`search_offset`.

    Args:
        reference: The ground truth.
        estimate: The estimate.
        within_s: Largest offset.
        by_turning: Compare angular rates, else speeds, which scale and alignment do not change in shape.

    Returns:
        The offset to add to the estimate's timestamps; None where nothing correlates.
    """
    begin_s = max(reference.stamps_s[0], estimate.stamps_s[0] - within_s)
    end_s = min(reference.stamps_s[-1], estimate.stamps_s[-1] + within_s)
    count = int(min(MOST_SAMPLES, (end_s - begin_s) / COARSE_STEP_S))
    if count < 2 * MINIMUM_COMPARED:
        return None
    stamps_s = begin_s + COARSE_STEP_S * np.arange(count)
    rates = [_rates(trajectory, stamps_s, by_turning=by_turning) for trajectory in (reference, estimate)]
    norms = [float(np.linalg.norm(entry)) for entry in rates]
    if min(norms) == 0:
        return None
    spectra = [np.fft.rfft(entry, 2 * count) for entry in rates]
    correlation = np.fft.irfft(spectra[0] * np.conj(spectra[1]), 2 * count) / (norms[0] * norms[1])
    most = min(count - 1, round(within_s / COARSE_STEP_S))
    shifts = np.arange(-most, most + 1)
    best = int(correlation[shifts].argmax())
    return float(shifts[best] * COARSE_STEP_S) if correlation[shifts[best]] >= _LEAST_CORRELATION else None


def _rates(trajectory: Trajectory, stamps_s: FloatArray, *, by_turning: bool) -> FloatArray:
    """Angular rates or speeds between the timestamps, less their mean; 0 beyond the trajectory. Shape (n - 1,)."""
    poses = interpolate(trajectory, stamps_s)
    if by_turning:
        steps = rotation_angles_rad(poses.quats_xyzw[:-1], poses.quats_xyzw[1:])
    else:
        steps = np.linalg.norm(np.diff(poses.positions_m, axis=0), axis=1)
    inside = _inside(trajectory, stamps_s[:-1]) & _inside(trajectory, stamps_s[1:])
    if not inside.any():
        return np.zeros(len(steps))
    return np.where(inside, steps - steps[inside].mean(), 0.0)
