"""Time unit and quaternion order of imported files: as specified, or detected; in doubt the import asks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from slamhive.domain.protocol import Duplicates
from slamhive.services.imports.request import Reading
from slamhive.trajectory.agreement import orientation_spread_deg, reordered, thinned_pair
from slamhive.trajectory.evidence import Finding, Span, span_of
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.orientation import ZERO
from slamhive.trajectory.pose_file import PoseFile, TrajectoryFormat, decided

_Choice = TypeVar("_Choice", TimeUnit, QuaternionOrder)

_PARTNERS = 5
"""At most this many estimates are compared with a ground truth to detect its conventions."""


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """A ground truth for comparison with estimates; ``rotations_known``: its orientations are meaningful."""

    trajectory: Trajectory
    rotations_known: bool

    @property
    def span(self) -> Span:
        """First and last timestamp, in s."""
        return float(self.trajectory.stamps_s[0]), float(self.trajectory.stamps_s[-1])


@dataclass(frozen=True, slots=True)
class Partner:
    """An estimate that belongs to a ground truth, and the conventions that the user specified."""

    file: PoseFile
    told: Convention


def settle(file: PoseFile, name: str, told: Convention, truth: Truth | None, relations: Span | None = None) -> Reading:
    """Determine the conventions of an estimate; raises InvalidInput with the evidence if in doubt.

    ``relations`` is the time in s that relations span. It shows the unit where there is no ground truth.
    """
    unit = file.unit(told, relations, "the relations") if truth is None else file.unit(told, truth.span)
    time_unit = _decided(unit, "time unit", "--time-unit", TimeUnit)
    if not file.has_order:
        return _reading(file, name, time_unit, unit.because, None)
    order = file.order(told, time_unit, {} if truth is None else _spreads_deg(file, time_unit, truth))
    _decided(order, "quaternion order", "--quaternion-order", QuaternionOrder)
    return _reading(file, name, time_unit, unit.because, order)


def settle_truth(file: PoseFile, name: str, told: Convention, partners: Sequence[Partner]) -> Reading:
    """Determine the conventions of a ground truth, with the help of its estimates if necessary.

    Raises as :func:`settle`.
    """
    asked = partners[:_PARTNERS]
    unit = file.unit(told, None)
    spans = (_own_span(partner) for partner in asked if unit.value is None)
    found = (file.unit(told, span) for span in spans if span is not None)
    unit = next((entry for entry in found if entry.value is not None), unit)
    time_unit = _decided(unit, "time unit", "--groundtruth-time-unit", TimeUnit)
    if not file.has_order:
        return _reading(file, name, time_unit, unit.because, None)
    order = _truth_order(file, told, time_unit, asked)
    _decided(order, "quaternion order", "--groundtruth-quaternion-order", QuaternionOrder)
    return _reading(file, name, time_unit, unit.because, order)


def _truth_order(
    file: PoseFile, told: Convention, unit: TimeUnit, partners: Sequence[Partner]
) -> Finding[QuaternionOrder]:
    """The quaternion order of a ground truth; estimates may contradict its header or replace a missing one."""
    by_itself = file.order(told, unit, {})
    if told.quaternion_order is not None:
        return by_itself
    spreads_deg = (_partner_spreads_deg(file, unit, partner) for partner in partners)
    found = (file.order(told, unit, entry) for entry in spreads_deg if entry)
    if by_itself.value is not None:
        return next(found, by_itself)
    return next((entry for entry in found if entry.value is not None), by_itself)


def _own_span(partner: Partner) -> Span | None:
    """First and last timestamp of an estimate, if its time unit is clear without a ground truth."""
    unit = partner.file.unit(partner.told, None).value
    return None if unit is None else span_of(partner.file.raw.times, unit)


def _spreads_deg(file: PoseFile, unit: TimeUnit, truth: Truth) -> dict[QuaternionOrder, float]:
    """The rotation difference between estimate and ground truth for each quaternion order."""
    if not truth.rotations_known:
        return {}
    pair = thinned_pair(truth.trajectory, file.raw.trajectory(unit, QuaternionOrder.XYZW, Duplicates.KEEP))
    if pair is None:
        return {}
    reference, estimate = pair
    found = {order: orientation_spread_deg(reference, reordered(estimate, order)) for order in QuaternionOrder}
    return {order: spread for order, spread in found.items() if spread is not None}


def _partner_spreads_deg(file: PoseFile, unit: TimeUnit, partner: Partner) -> dict[QuaternionOrder, float]:
    """As :func:`_spreads_deg` for a ground truth, with the better of the two orders of its estimate.

    An order that the ground truth states is contradicted only by an estimate whose order is certain.
    """
    stated = file.stated_order(unit) is not None
    best: dict[QuaternionOrder, float] = {}
    for order in QuaternionOrder:
        truth = Truth(file.raw.trajectory(unit, order, Duplicates.KEEP), rotations_known=True)
        own_unit = partner.file.unit(partner.told, truth.span).value
        if own_unit is None or not partner.file.has_order:
            return {}
        spreads = _spreads_deg(partner.file, own_unit, truth)
        told = partner.told.quaternion_order if stated else partner.file.order(partner.told, own_unit, {}).value
        likely = [spread for own, spread in spreads.items() if told in (None, own)]
        if likely:
            best[order] = min(likely)
    return best


def _decided(finding: Finding[_Choice], what: str, option: str, choices: type[_Choice]) -> _Choice:
    return decided(finding, f"the {what}", f"say which it is with {option} ({', '.join(choices)})")


def _reading(
    file: PoseFile, name: str, unit: TimeUnit, because: str, order: Finding[QuaternionOrder] | None
) -> Reading:
    reasons = {"time_unit": because} | ({} if order is None else {"quaternion_order": order.because})
    if file.raw.without:
        reasons["orientation"] = f"{file.raw.without}, so there are positions only, and no rotation errors"
    plain = unit is TimeUnit.S and (order is None or order.value is QuaternionOrder.XYZW)
    return Reading(
        name=name,
        time_unit=unit,
        quaternion_order=None if order is None else order.value,
        because=reasons,
        as_it_stands=plain and file.format is TrajectoryFormat.TUM and file.plain and file.raw.without != ZERO,
    )
