"""Times of the points of a LiDAR sweep: how a recording says them, and the conversion to seconds.

Drivers disagree: on the name of the field, its unit, what it counts from, and which instant of the sweep the message's
timestamp is. A dataset states all of it, and an algorithm asks for the times relative to the instant that it needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Self, TypeVar

from slamhive.base.errors import InvalidInput

if TYPE_CHECKING:
    from slamhive.runtime.messages import Array, PointCloud

Choice = TypeVar("Choice", bound=StrEnum)


class TimeUnit(StrEnum):
    """The unit of the times of points."""

    S = "s"
    MS = "ms"
    US = "us"
    NS = "ns"

    @property
    def seconds(self) -> float:
        """One unit in seconds."""
        return {TimeUnit.S: 1.0, TimeUnit.MS: 1e-3, TimeUnit.US: 1e-6, TimeUnit.NS: 1e-9}[self]


class TimeReference(StrEnum):
    """The instant that the times of points count from."""

    SWEEP_START = "sweep_start"
    """The start of the sweep, whatever the message's timestamp is."""
    TIMESTAMP = "timestamp"
    """The timestamp in the message's header."""
    ABSOLUTE = "absolute"
    """The zero of the header's clock."""


class SweepInstant(StrEnum):
    """The instant of the sweep that the message's timestamp states."""

    START = "start"
    MIDDLE = "middle"
    END = "end"

    @property
    def fraction(self) -> float:
        """The part of the sweep that is over: 0, 0.5 or 1."""
        return {SweepInstant.START: 0.0, SweepInstant.MIDDLE: 0.5, SweepInstant.END: 1.0}[self]


@dataclass(frozen=True, slots=True)
class PointTimes:
    """Rules by which the scans of one LiDAR state the time of each point.

    Attributes:
        scan_duration_s: The time of one sweep.
        field: The field of ``PointCloud2`` with the time of a point; empty if there is none.
        unit: Its unit.
        reference: What it counts from.
        stamp: What the message's timestamp means.
    """

    scan_duration_s: float
    field: str = ""
    unit: TimeUnit = TimeUnit.S
    reference: TimeReference = TimeReference.SWEEP_START
    stamp: SweepInstant = SweepInstant.START

    @classmethod
    def of(cls, values: Mapping[str, Any], rate_hz: float, owner: str, prefix: str = "") -> Self:
        """From the calibration keys of ``dataset.yaml``; absent ones have the defaults above, the duration 1 / rate.

        Args:
            values: The keys with their values, each key after ``prefix``.
            rate_hz: The rate of the sweeps.
            owner: Who has them, for messages.
            prefix: For instance ``points_`` in the configuration of a run.

        Raises:
            InvalidInput: A value is unknown; names the key and the allowed values.
        """
        found = {key[len(prefix) :]: value for key, value in values.items() if key.startswith(prefix)}
        return cls(
            _duration_s(found.get("scan_duration_s", 1.0 / rate_hz), owner),
            str(found.get("point_time_field", "")),
            choice(TimeUnit, found, "point_time_unit", TimeUnit.S, owner),
            choice(TimeReference, found, "point_time_reference", TimeReference.SWEEP_START, owner),
            choice(SweepInstant, found, "stamp", SweepInstant.START, owner),
        )

    def start_s(self, stamp_s: float) -> float:
        """The start of the sweep whose message is stamped ``stamp_s``."""
        return stamp_s - self.stamp.fraction * self.scan_duration_s

    def end_s(self, stamp_s: float) -> float:
        """The end of the sweep whose message is stamped ``stamp_s``."""
        return self.start_s(stamp_s) + self.scan_duration_s

    def since_start_s(self, cloud: PointCloud, stamp_s: float) -> Array:
        """Each point's time as (n,) float64 seconds after the start of the sweep.

        Args:
            cloud: The scan.
            stamp_s: The timestamp of its message.

        Raises:
            InvalidInput: The scan has no such field, or its times are further from the sweep than it is long.
        """
        values = cloud.field(self.field).astype("f8") * self.unit.seconds
        if self.reference is not TimeReference.SWEEP_START:
            zero_s = stamp_s if self.reference is TimeReference.TIMESTAMP else 0.0
            values += zero_s - self.start_s(stamp_s)
        self._check(values)
        return values

    def since_timestamp_s(self, cloud: PointCloud, stamp_s: float) -> Array:
        """The same as :meth:`since_start_s`, but relative to the timestamp of the message."""
        return self.since_start_s(cloud, stamp_s) - self.stamp.fraction * self.scan_duration_s

    def _check(self, since_start_s: Array) -> None:
        """Sweeps vary in length; what lies a whole sweep outside has another unit or reference."""
        if not since_start_s.size:
            return
        first_s, last_s = float(since_start_s.min()), float(since_start_s.max())
        if first_s >= -self.scan_duration_s and last_s <= 2 * self.scan_duration_s:
            return
        raise InvalidInput(
            f"point times of field {self.field!r} in {self.unit} relative to {self.reference} lie {first_s:.6g} to "
            f"{last_s:.6g} s after the start of a sweep of {self.scan_duration_s:g} s",
            "correct point_time_unit, point_time_reference or scan_duration_s in dataset.yaml",
        )


def choice(kind: type[Choice], values: Mapping[str, Any], key: str, default: Choice, owner: str) -> Choice:
    """The value of ``key``; raises InvalidInput that lists the choices."""
    try:
        return kind(str(values.get(key, default)))
    except ValueError:
        raise InvalidInput(f"{owner}: {key} {values[key]!r} is unknown", f"use one of {', '.join(kind)}") from None


def _duration_s(value: Any, owner: str) -> float:
    if isinstance(value, int | float) and value > 0:
        return float(value)
    raise InvalidInput(f"{owner}: scan_duration_s {value!r} is not allowed", "expected seconds, more than 0")
