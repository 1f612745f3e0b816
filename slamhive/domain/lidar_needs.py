"""What an algorithm needs of the points of a LiDAR, and whether a dataset has it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from slamhive.domain.lidar_layout import LidarLayout, PointOrder
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput
from slamhive.runtime.point_times import TimeReference, TimeUnit


class Need(StrEnum):
    """Whether an algorithm can do without something."""

    REQUIRED = "required"
    OPTIONAL = "optional"
    IGNORED = "ignored"


@dataclass(frozen=True, slots=True)
class LidarNeeds:
    """What a package asks of point clouds, the entry ``lidar`` of ``algorithm.yaml``.

    Attributes:
        point_time: A time for each point.
        ring: The number of the ring of each point.
        organised: Scans that are images of ranges.
        point_time_units: The units that it takes; empty if its adapter converts all.
        point_time_references: What the times may count from; empty if its adapter converts all.
        point_orders: The orders of points that it takes; empty for any.
    """

    point_time: Need = Need.OPTIONAL
    ring: Need = Need.IGNORED
    organised: Need = Need.IGNORED
    point_time_units: tuple[TimeUnit, ...] = ()
    point_time_references: tuple[TimeReference, ...] = ()
    point_orders: tuple[PointOrder, ...] = ()

    def check(self, sensor: Sensor, algorithm: str, dataset: str) -> None:
        """Raise InvalidInput if ``sensor`` of ``dataset`` does not give ``algorithm`` what it needs."""
        layout = LidarLayout.of(sensor)
        problem = self._lacks(layout) or self._unfit(layout)
        if problem is not None:
            needed, found = problem
            raise InvalidInput(
                f"{algorithm} needs {needed}; {sensor.name} of dataset {dataset} {found}",
                "choose another dataset or algorithm, or correct the calibration of the sensor in dataset.yaml",
            )

    def _lacks(self, layout: LidarLayout) -> tuple[str, str] | None:
        if self.point_time is Need.REQUIRED and not layout.times.field:
            return "a time for each point", "has none"
        if self.ring is Need.REQUIRED and not layout.ring_field:
            return "the ring of each point", "has none"
        if self.organised is Need.REQUIRED and not layout.organised:
            return "organised scans", "has a list of points"
        return None

    def _unfit(self, layout: LidarLayout) -> tuple[str, str] | None:
        unit, reference, order = layout.times.unit, layout.times.reference, layout.point_order
        timed = bool(layout.times.field) and self.point_time is not Need.IGNORED
        if timed and self.point_time_units and unit not in self.point_time_units:
            return f"point times in {_or(self.point_time_units)}", f"has them in {unit}"
        if timed and self.point_time_references and reference not in self.point_time_references:
            return f"point times relative to {_or(self.point_time_references)}", f"has them relative to {reference}"
        if self.point_orders and order not in self.point_orders:
            return f"points in the order {_or(self.point_orders)}", f"has {order or 'an unknown order'}"
        return None


def _or(choices: tuple[StrEnum, ...]) -> str:
    return " or ".join(choices)
