"""The step ``voxel``: one point to each cube of space."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Array, Message, Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.bags.variants.steps.points import positions_m, unorganised
from slamhive.domain.sensors import Sensor, SensorKind


class Voxel(Step):
    """Keep the first point in each cube of a grid, with all its fields; the order stays.

    No means are taken: a point keeps the instant it was measured at.
    """

    kind: ClassVar[str] = "voxel"

    size_m: float = option("Edge of a cube.", unit="m", ge=0.001, le=100)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def calibrate(self, sensor: Sensor) -> Sensor:
        """A list of points in place of an image of ranges."""
        return unorganised(sensor)

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """A filter on the points of every scan."""
        return Operation(transform=self._thin)

    def _thin(self, points: Array, _message: Message) -> Array:
        return one_per_voxel(points, self.size_m)


def one_per_voxel(points: Array, size_m: float) -> Array:
    """The first point of each cube of edge ``size_m`` (m), in their order; points that are not finite are left out."""
    positions = positions_m(points)
    finite = np.flatnonzero(np.isfinite(positions).all(axis=1))
    cells = np.floor(positions[finite] / size_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    spans = cells.max(axis=0, initial=0) + 1
    flat = (cells[:, 0] * spans[1] + cells[:, 1]) * spans[2] + cells[:, 2]
    _, first = np.unique(flat, return_index=True)
    kept: Array = points[finite[np.sort(first)]]
    return kept
