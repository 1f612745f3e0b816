"""Steps on point clouds. Clouds are structured arrays (n,) with the fields x, y, z and others."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.variants.step import Array, Message, Operation, SeededStep, Step, Stream, option

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
    """Beam of each point (n,), int: the field ``ring``, or the order in which the scan is stored.

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


# The step ``point_beams``: a LiDAR with fewer beams.


class PointBeams(Step):
    """Keep every N-th beam (0, N, 2N, ...) and number those left from 0, as a sensor with so many would."""

    kind: ClassVar[str] = "point_beams"

    every: int = option("Keep one beam of so many.", unit="beams", ge=1, le=256)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def check(self, sensor: Sensor) -> None:
        """Refuse a sensor whose number of beams is not known, and more than it has."""
        beams = _beams(sensor)
        if self.every > beams:
            raise InvalidInput(
                f"step point_beams: every {self.every} is more than the {beams} beams of {sensor.name}",
                f"use 1 to {beams}",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """Every beam."""
        return self.every == 1

    def calibrate(self, sensor: Sensor) -> Sensor:
        """Number of beams that are left."""
        left = {**sensor.calibration, "beams": -(-_beams(sensor) // self.every)}
        return unorganised(replace(sensor, calibration=left))

    def operation(self, stream: Stream) -> Operation:
        """A filter on the points of every scan."""
        beams, ring = _beams(stream.sensor), ring_field(stream.sensor)

        def thin(points: Array, _message: Message) -> Array:
            numbers = beam_numbers(points, beams, ring)
            kept: Array = points[numbers % self.every == 0]
            if ring in (points.dtype.names or ()):
                kept[ring] //= self.every
            return kept

        return Operation(transform=thin)


def _beams(sensor: Sensor) -> int:
    beams = sensor.calibration.get("beams")
    if not isinstance(beams, int) or beams < 1:
        raise InvalidInput(
            f"step point_beams: dataset.yaml does not say how many beams {sensor.name} has", "add beams: N to it"
        )
    return beams


# The step ``point_range``: a LiDAR that sees less far, or not as near.


class PointRange(Step):
    """Keep the points between two distances; the calibration states the new limits."""

    kind: ClassVar[str] = "point_range"

    minimum_m: float = option("Nearer points are left out.", unit="m", default=0.0, ge=0, le=10_000)
    maximum_m: float | None = option("Farther points are left out.", unit="m", default=None, gt=0, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def check(self, sensor: Sensor) -> None:
        """Refuse limits between which nothing lies."""
        if self.maximum_m is not None and self.maximum_m <= self.minimum_m:
            raise InvalidInput(
                f"step point_range: nothing of {sensor.name} lies between {self.minimum_m:g} and {self.maximum_m:g} m",
                "maximum_m must be above minimum_m",
            )

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """No limits."""
        return self.minimum_m == 0 and self.maximum_m is None

    def calibrate(self, sensor: Sensor) -> Sensor:
        """The narrower of the sensor's own limits and these."""
        calibration = dict(sensor.calibration)
        if self.minimum_m > 0:
            calibration["minimum_range_m"] = max(self.minimum_m, _number(calibration.get("minimum_range_m"), 0.0))
        if self.maximum_m is not None:
            own_m = _number(calibration.get("maximum_range_m"), self.maximum_m)
            calibration["maximum_range_m"] = min(self.maximum_m, own_m)
        return unorganised(replace(sensor, calibration=calibration))

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """A filter on the points of every scan."""
        maximum_m = float("inf") if self.maximum_m is None else self.maximum_m

        def cut(points: Array, _message: Message) -> Array:
            distances = ranges_m(points)
            kept: Array = points[(distances >= self.minimum_m) & (distances <= maximum_m)]
            return kept

        return Operation(transform=cut)


def _number(value: object, otherwise: float) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


# The step ``point_stride``: fewer points, evenly.


class PointStride(Step):
    """Keep every N-th point in the order in which the scan is stored.

    Scans stored column by column lose whole beams if N and their number have a common factor: there, ``point_beams``
    says what is meant.
    """

    kind: ClassVar[str] = "point_stride"

    every: int = option("Keep one point of so many.", ge=1, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """Every point."""
        return self.every == 1

    def calibrate(self, sensor: Sensor) -> Sensor:
        """A list of points in place of an image of ranges."""
        return unorganised(sensor)

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """A slice of every scan."""

        def thin(points: Array, _message: Message) -> Array:
            return points[:: self.every].copy()

        return Operation(transform=thin)


# The step ``voxel``: one point to each cube of space.


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


# The fault ``range_noise``: a LiDAR that measures distances less well.


class RangeNoise(SeededStep):
    """Gaussian noise along the ray of each point."""

    kind: ClassVar[str] = "range_noise"

    sigma_m: float = option("Standard deviation of a distance.", unit="m", ge=0, le=10)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No noise."""
        return self.sigma_m == 0

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """Noise on every scan."""
        return Operation(transform=self._degrade)

    def _degrade(self, points: Array, message: Message) -> Array:
        return add_range_noise(points, self.sigma_m, message.random())


def add_range_noise(points: Array, sigma_m: float, random: np.random.Generator) -> Array:
    """``points`` moved along their rays; none gets behind the sensor, and what has no distance stays."""
    distances = ranges_m(points)
    noisy = np.maximum(distances + sigma_m * random.standard_normal(len(points)), 0.0)
    measured = np.isfinite(distances) & (distances > 0)
    return moved(points, np.divide(noisy, distances, out=np.ones(len(points)), where=measured))


# The fault ``fog``: far points are lost, and some of them come back from the fog itself.


_CONTRAST_AT_VISIBILITY = 0.05
"""The meteorological optical range is where 5 % of the light is left (WMO guide no. 8, chapter 9)."""


class Fog(SeededStep):
    """A point at distance r survives with the probability exp(-2 a r): its light goes there and back.

    a = -ln(0.05) / visibility (Koschmieder's law). Of the points lost, the share ``backscatter`` is seen where the fog
    threw the light back: at a distance drawn from the same law, before the surface.
    """

    kind: ClassVar[str] = "fog"

    visibility_m: float = option("Meteorological optical range; 50 m is dense fog.", unit="m", ge=1, le=100_000)
    backscatter: float = option("Share of the lost points that show up in the fog.", default=0.0, ge=0, le=1)

    def applies_to(self, sensor: Sensor) -> bool:
        """LiDARs."""
        return sensor.kind is SensorKind.LIDAR

    def calibrate(self, sensor: Sensor) -> Sensor:
        """A list of points in place of an image of ranges: what fog swallows is left out."""
        return unorganised(sensor)

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - all LiDARs alike
        """Fog in every scan."""
        return Operation(transform=self._degrade)

    def _degrade(self, points: Array, message: Message) -> Array:
        return see_through_fog(points, self.visibility_m, self.backscatter, message.random())


def see_through_fog(points: Array, visibility_m: float, backscatter: float, random: np.random.Generator) -> Array:
    """Simulate the measurement of ``points`` in fog; those that are not finite are left out."""
    attenuation = -2.0 * math.log(_CONTRAST_AT_VISIBILITY) / visibility_m
    distances = ranges_m(points)
    lost_at = random.exponential(1.0 / attenuation, len(points))
    thrown_back = random.random(len(points)) < backscatter
    survives = lost_at >= distances
    seen = np.isfinite(distances) & (survives | thrown_back)
    factors = np.divide(lost_at, distances, out=np.ones(len(points)), where=~survives & (distances > 0))
    kept: Array = moved(points, factors)[seen]
    return kept
