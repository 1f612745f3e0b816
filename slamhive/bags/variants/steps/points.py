"""What the steps on point clouds share. Clouds are structured arrays (n,) with the fields x, y, z and others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from slamhive.bags.variants.step import Array
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput

RING_FIELD = "ring"


def positions_m(points: Array) -> Array:
    """The points' positions (n, 3), float64, in the sensor's frame."""
    return np.stack([points[axis].astype(np.float64) for axis in "xyz"], axis=1)


def ranges_m(points: Array) -> Array:
    """Distances from the sensor (n,), float64; NaN where a point has none."""
    distances: Array = np.linalg.norm(positions_m(points), axis=1)
    return distances


def moved(points: Array, factors: Array) -> Array:
    """A copy with every point moved along its ray: ``factors`` (n,) times its distance."""
    result = points.copy()
    for axis in "xyz":
        result[axis] = points[axis] * factors
    return result


def ring_field(sensor: Sensor) -> str:
    """The field with the number of the ring, ``ring`` if ``dataset.yaml`` names none."""
    return str(sensor.calibration.get("ring_field") or RING_FIELD)


def unorganised(sensor: Sensor) -> Sensor:
    """``sensor`` after points were left out: its scans are no images of ranges any more."""
    if not sensor.calibration.get("organised"):
        return sensor
    return replace(sensor, calibration={**sensor.calibration, "organised": False})


def beam_numbers(points: Array, beams: int, ring: str = RING_FIELD) -> Array:
    """Which beam each point comes from (n,), int: the field ``ring``, or the order in which the scan is stored.

    Without that field a scan must be stored beam after beam, each turn once around, as KITTI's are: a beam ends where
    the azimuth jumps back.

    Raises InvalidInput if the order shows no beams: fewer than half of ``beams``, or more than there are.
    """
    if points.dtype.names is not None and ring in points.dtype.names:
        return points[ring].astype(np.int64)
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    azimuth_rad = np.arctan2(points["y"].astype(np.float64), points["x"].astype(np.float64)) % (2 * np.pi)
    numbers: Array = np.concatenate([[0], np.cumsum(np.abs(np.diff(azimuth_rad)) > np.pi)]).astype(np.int64)
    turns = int(numbers[-1]) + 1
    if not beams / 2 <= turns <= beams + 1:
        raise InvalidInput(
            f"the beams of a scan are unknown: it has no field {ring!r}, and its order shows {turns} turns "
            f"where {beams} beams are expected",
            "record the field, or thin out with point_stride or voxel",
        )
    return np.minimum(numbers, beams - 1)
