"""The typed view of a LiDAR's calibration: what it measures, and how its points lie in a message."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slamhive.domain.calibration import number_of
from slamhive.domain.sensors import CalibrationValue, Sensor
from slamhive.errors import InvalidInput
from slamhive.runtime.point_times import PointTimes, choice


class PointOrder(StrEnum):
    """How the points of a scan follow each other."""

    COLUMNS = "columns"
    """All rings at one azimuth, then the next azimuth: nearly in the order of time."""
    ROWS = "rows"
    """One ring after the other."""
    UNKNOWN = ""


class Rotation(StrEnum):
    """The direction in which a LiDAR turns, seen from above."""

    CLOCKWISE = "clockwise"
    COUNTER_CLOCKWISE = "counter-clockwise"
    UNKNOWN = ""


@dataclass(frozen=True, slots=True)
class LidarLayout:
    """What a LiDAR measures, and how its points lie in ``PointCloud2``.

    Attributes:
        times: Where the time of a point is, what it counts from, and what the message's timestamp means.
        ring_field: The field with the number of the ring (beam); empty if there is none.
        point_order: How points follow each other.
        organised: The scan is an image of ranges, one row for each ring; points without return are NaN or 0.
        beams: The number of rings.
        minimum_range_m: The nearest distance that is measured.
        maximum_range_m: The furthest distance that is measured.
        vertical_angles_deg: The elevation of each ring, in the order of their numbers; empty if it is not known.
        points_per_ring: How many points one turn gives, those without return included.
        rotation: The direction in which it turns.
    """

    times: PointTimes
    ring_field: str = ""
    point_order: PointOrder = PointOrder.UNKNOWN
    organised: bool = False
    beams: int | None = None
    minimum_range_m: float | None = None
    maximum_range_m: float | None = None
    vertical_angles_deg: tuple[float, ...] = ()
    points_per_ring: int | None = None
    rotation: Rotation = Rotation.UNKNOWN

    @classmethod
    def of(cls, sensor: Sensor) -> LidarLayout:
        """The layout of ``sensor``; raises InvalidInput naming what makes no sense."""
        values, owner = sensor.calibration, f"sensor {sensor.name}"
        return cls(
            PointTimes.of(values, sensor.rate_hz, owner),
            str(values.get("ring_field", "")),
            choice(PointOrder, values, "point_order", PointOrder.UNKNOWN, owner),
            bool(values.get("organised", False)),
            _whole(values, "beams", owner),
            number_of(values, "minimum_range_m", owner),
            number_of(values, "maximum_range_m", owner),
            _angles_deg(values, owner),
            _whole(values, "points_per_ring", owner),
            choice(Rotation, values, "rotation", Rotation.UNKNOWN, owner),
        )

    def calibration(self, **more: CalibrationValue) -> dict[str, CalibrationValue]:
        """The keys of ``dataset.yaml``, without those that are unknown; ``more`` follows them."""
        optional = ("beams", "vertical_angles_deg", "points_per_ring", "rotation", "minimum_range_m", "maximum_range_m")
        known = {key: getattr(self, key) for key in optional}
        return {
            **{key: value for key, value in known.items() if value not in (None, (), "")},
            "point_time_field": self.times.field,
            "point_time_unit": self.times.unit.value,
            "point_time_reference": self.times.reference.value,
            "stamp": self.times.stamp.value,
            "scan_duration_s": self.times.scan_duration_s,
            "ring_field": self.ring_field,
            "point_order": self.point_order.value,
            "organised": self.organised,
            **more,
        }


def _whole(values: dict[str, CalibrationValue], key: str, owner: str) -> int | None:
    number = number_of(values, key, owner)
    return None if number is None else int(number)


def _angles_deg(values: dict[str, CalibrationValue], owner: str) -> tuple[float, ...]:
    """The elevations of the rings; raises InvalidInput if there is not one for each of the beams."""
    found = values.get("vertical_angles_deg", ())
    if not isinstance(found, tuple | list):
        raise InvalidInput(f"{owner}: vertical_angles_deg {found!r} is no list", "give the angle of each ring")
    beams = _whole(values, "beams", owner)
    if found and beams is not None and len(found) != beams:
        raise InvalidInput(f"{owner}: {len(found)} vertical angles for {beams} beams", "give one for each ring")
    return tuple(float(angle) for angle in found)
