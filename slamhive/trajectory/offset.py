"""Finds the time offset between two clocks, at which the angular rates fit best, or else the positions."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment
from slamhive.trajectory.alignment import align
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.transforms import interpolate, rotation_angles_rad

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
    return _golden_section(lambda offset_s: misfit(offset_s)[0], float(offsets_s[best - 1]), float(offsets_s[best + 1]))


def _golden_section(error: Callable[[float], float], low_s: float, high_s: float) -> float:
    inner = [high_s - _GOLDEN * (high_s - low_s), low_s + _GOLDEN * (high_s - low_s)]
    errors = [error(inner[0]), error(inner[1])]
    while high_s - low_s > PRECISION_S:
        if errors[0] <= errors[1]:
            high_s = inner[1]
            inner = [high_s - _GOLDEN * (high_s - low_s), inner[0]]
            errors = [error(inner[0]), errors[0]]
        else:
            low_s = inner[0]
            inner = [inner[1], low_s + _GOLDEN * (high_s - low_s)]
            errors = [errors[1], error(inner[1])]
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
