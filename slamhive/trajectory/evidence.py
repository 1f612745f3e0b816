"""The unit of times and the order of quaternions, from the numbers of a file.

Nothing is guessed. A finding holds a value and the evidence for it, or no value and the reason for the doubt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Generic, TypeVar

import numpy as np

from slamhive.trajectory.layout import QuaternionOrder, TimeUnit
from slamhive.trajectory.model import FloatArray

Span = tuple[float, float]
"""First and last time in s."""

_Choice = TypeVar("_Choice", TimeUnit, QuaternionOrder)


@dataclass(frozen=True, slots=True)
class Conclusion(Generic[_Choice]):
    """A value with its evidence, or None with the reason for the doubt."""

    value: _Choice | None
    because: str


SHORTEST_STEP_S, LONGEST_STEP_S = 5e-4, 10.0
"""Poses come at 2000 Hz at most, and are rarely further apart than keyframes of a vehicle that waits, ..."""
SPARSE_STEP_S = 600.0
"""... unless they are surveyed points, which people write in seconds."""
_FEW = 10
"""Surveyed points may be a second apart; so many in a row are counted."""
FIRST_DATE_S, LAST_DATE_S = 6.3e8, 4.1e9
"""1990 and 2100 as seconds since 1970: no recording is older or newer."""
MOST_OVERLAP, LITTLE_OVERLAP = 0.3, 0.03
"""Shares of the time that two spans have in common: above the first they fit, below the second they do not."""


def find_unit(
    times: FloatArray, stated: Conclusion[TimeUnit] | None, truth: Span | None, what: str = "the ground truth"
) -> Conclusion[TimeUnit]:
    """The unit of ``times``.

    Args:
        times: As in the file, at least two.
        stated: What the file or its format says, None if nothing.
        truth: When the ground truth begins and ends, None where that is not known.
        what: What ``truth`` is the time of, for messages.
    """
    by_numbers = (None if truth is None else _unit_by_overlap(times, truth, what)) or _unit_by_itself(times)
    return _with_stated(stated, by_numbers)


def _with_stated(stated: Conclusion[_Choice] | None, by_numbers: Conclusion[_Choice]) -> Conclusion[_Choice]:
    """The statement of the file; no value if the numbers contradict it."""
    if stated is None:
        return by_numbers
    if by_numbers.value in (None, stated.value):
        return stated
    return Conclusion(None, f"{stated.value} {stated.because}, but {by_numbers.because}")


def span_of(times: FloatArray, unit: TimeUnit) -> Span:
    """First and last time of the poses, in s."""
    return float(times.min()) / unit.per_second, float(times.max()) / unit.per_second


def overlap(first: Span, second: Span) -> float:
    """Intersection over union of two spans, 0 to 1."""
    together_s = max(first[1], second[1]) - min(first[0], second[0])
    common_s = min(first[1], second[1]) - max(first[0], second[0])
    return max(0.0, common_s / together_s) if together_s > 0 else 0.0


def _unit_by_overlap(times: FloatArray, truth: Span, what: str) -> Conclusion[TimeUnit] | None:
    """The only unit in which the file covers the time of the ground truth, or None."""
    shares = sorted(((overlap(span_of(times, unit), truth), unit) for unit in TimeUnit), reverse=True)
    (most, unit), (next_most, _) = shares[0], shares[1]
    if most > 0 and next_most == 0 and unit in _likely_units(times):
        return Conclusion(unit, f"only as {unit} do the timestamps fall into the time of {what}")
    if most >= MOST_OVERLAP and next_most <= LITTLE_OVERLAP:
        words = f"as {unit} the timestamps share {most:.0%} of their time with {what}, otherwise"
        return Conclusion(unit, f"{words} {next_most:.2g} of it at most")
    return None


def _unit_by_itself(times: FloatArray) -> Conclusion[TimeUnit]:
    """The unit by the time between poses, and by the date."""
    step, fitting = _step(times), _likely_units(times)
    dates = {unit: float(times[0]) / unit.per_second for unit in fitting}
    dated = [unit for unit, first_s in dates.items() if FIRST_DATE_S <= first_s <= LAST_DATE_S]
    if len(dated) == 1:
        year = datetime.fromtimestamp(dates[dated[0]], UTC).year
        apart = _duration(step / dated[0].per_second)
        return Conclusion(dated[0], f"as {dated[0]} the timestamps lie in {year} and the poses {apart} apart")
    if len(fitting) == 1:
        apart = _duration(step / fitting[0].per_second)
        return Conclusion(fitting[0], f"only as {fitting[0]} are the poses a likely time apart, {apart}")
    shown = ", ".join(f"{_duration(step / unit.per_second)} if they are {unit}" for unit in fitting or TimeUnit)
    found = f"the timestamps are {step:g} apart, which is {shown}"
    if len(times) > _FEW and times[0] in {0.0, 1.0} and (np.diff(times) == 1).all():
        found += "; they may be numbers of frames or keys of a pose graph, which are no times"
    return Conclusion(None, found)


def _likely_units(times: FloatArray) -> list[TimeUnit]:
    """The units in which the time between poses is likely."""
    step = _step(times)
    longest_s = {TimeUnit.S: SPARSE_STEP_S}
    return [
        unit for unit in TimeUnit if SHORTEST_STEP_S <= step / unit.per_second <= longest_s.get(unit, LONGEST_STEP_S)
    ]


def _step(times: FloatArray) -> float:
    """Median of the times from pose to pose, in the unit of the file; 0 if there is one time only."""
    steps = np.diff(times)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _duration(seconds: float) -> str:
    for unit in TimeUnit:
        if seconds * unit.per_second >= 1:
            return f"{seconds * unit.per_second:.3g} {unit}"
    return f"{seconds:.2g} s"


@dataclass(frozen=True, slots=True)
class MisreadUnit:
    """A unit in which two files would share their time, in words."""

    sentence: str
    remedy: str


def misread_unit(estimate_s: FloatArray, truth_s: FloatArray) -> MisreadUnit | None:
    """Tell if timestamps read as seconds are in another unit: they hardly overlap, and would in that unit."""
    spans = [span_of(stamps_s, TimeUnit.S) for stamps_s in (estimate_s, truth_s)]
    if overlap(spans[0], spans[1]) > LITTLE_OVERLAP:
        return None
    for name, option, stamps_s, other in (
        ("estimate", "--time-unit", estimate_s, spans[1]),
        ("ground truth", "--groundtruth-time-unit", truth_s, spans[0]),
    ):
        for unit in _likely_units(stamps_s):
            share = overlap(span_of(stamps_s, unit), other)
            if unit is not TimeUnit.S and share >= MOST_OVERLAP:
                return MisreadUnit(
                    f"The timestamps of the {name} look like {unit}, not seconds: as {unit} estimate and ground truth "
                    f"share {share:.0%} of their time",
                    f"write seconds, or import the file again with {option} {unit}",
                )
    return None


DECISIVE_RATIO, DECISIVE_DEG, AGREEING_DEG = 0.5, 2.0, 15.0
"""The spread of the right order: half that of the other at most, so much less at least, and no more than that."""


def find_order(
    quats: FloatArray, stated: Conclusion[QuaternionOrder] | None, spreads_deg: Mapping[QuaternionOrder, float]
) -> Conclusion[QuaternionOrder]:
    """The order of quaternions.

    Args:
        quats: As in the file, shape (n, 4).
        stated: What the file or its format says, None if nothing.
        spreads_deg: How far the orientations are from turning as those of the ground truth do, read in each order (see
            :func:`slamhive.trajectory.association.orientation_spread_deg`); empty where nothing can be compared.
    """
    by_truth = _order_by_truth(spreads_deg)
    if stated is None and by_truth.value is None:
        # Most estimates begin without rotation, which shows the place of w.
        first = np.abs(quats[0])
        for place, order in ((3, QuaternionOrder.XYZW), (0, QuaternionOrder.WXYZ)):
            if first[place] >= _IDENTITY:
                return Conclusion(order, f"the first pose is not rotated, read as {order}")
        return by_truth
    return _with_stated(stated, by_truth)


def _order_by_truth(spreads_deg: Mapping[QuaternionOrder, float]) -> Conclusion[QuaternionOrder]:
    if len(spreads_deg) < len(QuaternionOrder):
        return Conclusion(None, "nothing shows the order of the quaternions")
    (best_deg, best), (other_deg, other) = sorted((spread, order) for order, spread in spreads_deg.items())
    words = (
        f"the orientations agree with the ground truth to {best_deg:.1f} deg read as {best}, "
        f"and to {other_deg:.1f} deg read as {other}"
    )
    clearly_better = best_deg <= DECISIVE_RATIO * other_deg and other_deg - best_deg >= DECISIVE_DEG
    if clearly_better and best_deg <= AGREEING_DEG:
        return Conclusion(best, words)
    return Conclusion(None, words)


_IDENTITY = 1 - 1e-6
