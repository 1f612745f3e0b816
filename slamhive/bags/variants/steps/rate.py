"""The step ``rate``: fewer messages."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar, Self

from pydantic import Field, model_validator

from slamhive.bags.variants.step import Operation, Step, Stream
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput

_RATE_TOLERANCE = 1e-3
"""Rates this close (relative) are one: ``dataset.yaml`` states measured rates."""


class Rate(Step):
    """Keep every N-th message (0, N, 2N, ...) or as many as ``hz`` asks for.

    With ``hz``, the clock of the header timestamps is cut into periods of 1/hz, and the first message of each period is
    kept. The cut depends on nothing else, so sensors with equal timestamps (a stereo pair) keep equal frames wherever
    their topics begin. Periods begin half a source period early, so that round timestamps lie away from the cuts.
    """

    kind: ClassVar[str] = "rate"

    every: int | None = Field(default=None, ge=1, description="Keep one message of so many.")
    hz: float | None = Field(default=None, gt=0, description="Messages a second.", json_schema_extra={"unit": "Hz"})

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if (self.every is None) == (self.hz is None):
            raise ValueError("give either every (keep each N-th message) or hz (messages a second)")
        return self

    def applies_to(self, sensor: Sensor) -> bool:  # noqa: ARG002 - any stream can be thinned
        """Every sensor has a rate."""
        return True

    def check(self, sensor: Sensor) -> None:
        """Refuse a rate above the sensor's."""
        if self.hz is not None and self.hz > sensor.rate_hz * (1 + _RATE_TOLERANCE):
            raise InvalidInput(
                f"step rate: {self.hz:g} Hz is above the {sensor.rate_hz:g} Hz of {sensor.name} ({sensor.topic})",
                "messages can be left out, not invented",
            )

    def is_identity(self, sensor: Sensor) -> bool:
        """Every message, or the sensor's own rate."""
        if self.hz is None:
            return self.every == 1
        return self.hz >= sensor.rate_hz * (1 - _RATE_TOLERANCE)

    def calibrate(self, sensor: Sensor) -> Sensor:
        """The rate divided by N, or the one asked for."""
        if self.is_identity(sensor):
            return sensor
        return replace(sensor, rate_hz=self.hz if self.hz is not None else sensor.rate_hz / (self.every or 1))

    def operation(self, stream: Stream) -> Operation:
        """A filter, by index or by header timestamp."""
        if self.is_identity(stream.sensor):
            return Operation()
        if self.every is not None:
            every = self.every
            return Operation(keep=lambda index, _stamp_ns: index % every == 0)
        assert self.hz is not None
        return Operation(keep=_Periods(self.hz, stream.sensor.rate_hz), uses_stamps=True)


class _Periods:
    """Keeps the first message of every period; holds which period is taken."""

    def __init__(self, hz: float, source_hz: float) -> None:
        self._hz = hz
        self._lead = 0.5 * hz / source_hz
        self._taken: int | None = None

    def __call__(self, _index: int, stamp_ns: int) -> bool:
        period = math.floor(stamp_ns * 1e-9 * self._hz + self._lead)
        if self._taken is not None and period <= self._taken:
            return False
        self._taken = period
        return True
