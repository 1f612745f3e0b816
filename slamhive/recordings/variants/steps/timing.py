"""Steps on the times of messages: fewer, a part of them, lost ones, and wrong timestamps. First ``rate``."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from slamhive.base.errors import InvalidInput
from slamhive.domain.configuration import CLIP
from slamhive.domain.sensors import Sensor
from slamhive.recordings.variants.step import Operation, SeededStep, Step, Stream, option

_RATE_TOLERANCE = 1e-3
"""Rates this close (relative) are one: ``dataset.yaml`` states measured rates."""
_LATEST_S = 2.0**32
"""Seconds of ROS 1 are numbers of 32 bits."""


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


# The reduction ``clip``: a part of the recording.


class Clip(Step):
    """Keep the messages that were received between two times. Errors are those over this part of the ground truth.

    Both times are those of the recording's clock, which has to be that of the ground truth. What belongs to no sensor
    of the dataset stays.
    """

    kind: ClassVar[str] = CLIP

    begin_s: float = option("The first time that stays.", unit="s", default=0.0, ge=0, le=_LATEST_S)
    end_s: float = option("The last time that stays.", unit="s", default=_LATEST_S, ge=0, le=_LATEST_S)

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.end_s <= self.begin_s:
            raise ValueError(f"end_s ({self.end_s:.9g}) has to be after begin_s ({self.begin_s:.9g})")
        return self

    def applies_to(self, sensor: Sensor) -> bool:  # noqa: ARG002 - every message has a time
        """Every sensor."""
        return True

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """All of it."""
        return self.begin_s == 0 and self.end_s == _LATEST_S

    def operation(self, stream: Stream) -> Operation:  # noqa: ARG002 - the time decides alone
        """A filter by time."""
        begin_ns, end_ns = round(self.begin_s * 1e9), round(self.end_s * 1e9)
        return Operation(keep=lambda _index, stamp_ns: begin_ns <= stamp_ns <= end_ns)


# The fault ``drop_out``: single messages that never arrive.


class DropOut(SeededStep):
    """Each message is lost with the same probability, whatever happens to its neighbours."""

    kind: ClassVar[str] = "drop_out"

    fraction: float = option("Probability that a message is lost.", ge=0, lt=1)
    together: bool = option("All sensors lose the messages of the same number (a stereo pair both).", default=False)

    def applies_to(self, sensor: Sensor) -> bool:  # noqa: ARG002 - any message can be lost
        """Every sensor."""
        return True

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """Nothing is lost."""
        return self.fraction == 0

    def operation(self, stream: Stream) -> Operation:
        """A draw for each message."""
        random = np.random.default_rng(self.seed) if self.together else stream.random()
        kept = random.random(stream.count) >= self.fraction
        return Operation(keep=lambda index, _stamp_ns: bool(kept[index]))


# The fault ``drop_bursts``: the connection goes away for a while, again and again.


class DropBursts(SeededStep):
    """Everything is lost for ``duration_s``, at times that come as a Poisson process."""

    kind: ClassVar[str] = "drop_bursts"

    per_minute: float = option("Bursts a minute, on average.", unit="1/min", ge=0, le=600)
    duration_s: float = option("How long each lasts.", unit="s", gt=0, le=60)
    together: bool = option("All sensors lose the same stretches of time.", default=True)

    def applies_to(self, sensor: Sensor) -> bool:  # noqa: ARG002 - any message can be lost
        """Every sensor."""
        return True

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No bursts."""
        return self.per_minute == 0

    def operation(self, stream: Stream) -> Operation:
        """A filter by time."""
        random = np.random.default_rng(self.seed) if self.together else stream.random()
        return Operation(keep=_Bursts(random, 60.0 / self.per_minute, self.duration_s))


class _Bursts:
    """Tell if a message falls between bursts; asked in order of time.

    Time is cut into windows that begin at multiples of their length, and the draws of a window depend on its number
    alone. So all sensors see the same bursts although their first messages differ.
    """

    _WINDOW_NS = 60_000_000_000

    def __init__(self, random: np.random.Generator, mean_gap_s: float, duration_s: float) -> None:
        self._entropy = int(random.integers(2**63))
        self._mean_per_window = self._WINDOW_NS * 1e-9 / mean_gap_s
        self._duration_ns = round(duration_s * 1e9)
        self._windows: dict[int, list[int]] = {}

    def __call__(self, _index: int, stamp_ns: int) -> bool:
        window = stamp_ns // self._WINDOW_NS
        begins = [*self._begins(window - 1), *self._begins(window)]
        return not any(begin <= stamp_ns < begin + self._duration_ns for begin in begins)

    def _begins(self, window: int) -> list[int]:
        """Starts of the bursts of one window, ns; those of the last two windows are remembered."""
        if window not in self._windows:
            random = np.random.default_rng((self._entropy, window + 1))
            count = random.poisson(self._mean_per_window)
            begins = window * self._WINDOW_NS + random.random(count) * self._WINDOW_NS
            self._windows = {known: self._windows[known] for known in self._windows if known == window - 1}
            self._windows[window] = [int(begin) for begin in begins]
        return self._windows[window]


# The fault ``stamp_jitter``: timestamps taken by a clock that is read late, or early, by chance.


class StampJitter(SeededStep):
    """Gaussian noise on the header timestamps; they still increase, as those of a driver do that checks its clock."""

    kind: ClassVar[str] = "stamp_jitter"

    sigma_s: float = option("Standard deviation.", unit="s", ge=0, le=1)

    def applies_to(self, sensor: Sensor) -> bool:  # noqa: ARG002 - every message has a timestamp
        """Every sensor."""
        return True

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the option decides alone
        """No jitter."""
        return self.sigma_s == 0

    def operation(self, stream: Stream) -> Operation:
        """A new timestamp for every message."""
        errors_ns = stream.random().standard_normal(stream.count) * self.sigma_s * 1e9
        last_ns = 0

        def restamp(index: int, stamp_ns: int) -> int:
            nonlocal last_ns
            last_ns = max(stamp_ns + round(float(errors_ns[index])), last_ns + 1)
            return last_ns

        return Operation(restamp=restamp)


# The fault ``time_offset``: a clock that is wrong by a constant and by a drift, unknown to the algorithm.


class TimeOffset(Step):
    """Header timestamps moved by ``offset_s``, and by ``drift_ppm`` more for each second since the first message."""

    kind: ClassVar[str] = "time_offset"

    offset_s: float = option("Added to every timestamp.", unit="s", default=0.0, ge=-10, le=10)
    drift_ppm: float = option("How much too fast the clock runs.", unit="ppm", default=0.0, ge=-10_000, le=10_000)

    def applies_to(self, sensor: Sensor) -> bool:  # noqa: ARG002 - every message has a timestamp
        """Every sensor."""
        return True

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - the options decide alone
        """A clock that is right."""
        return self.offset_s == 0 and self.drift_ppm == 0

    def operation(self, stream: Stream) -> Operation:
        """A new timestamp for every message."""
        offset_ns = round(self.offset_s * 1e9)
        first_ns: int | None = None

        def restamp(_index: int, stamp_ns: int) -> int:
            nonlocal first_ns
            first_ns = stamp_ns if first_ns is None else first_ns
            moved_ns = stamp_ns + offset_ns + round((stamp_ns - first_ns) * self.drift_ppm * 1e-6)
            if moved_ns < 0:
                raise InvalidInput(
                    f"step time_offset: {self.offset_s:g} s moves {stream.sensor.name} ({stream.sensor.topic}) to "
                    f"{moved_ns * 1e-9:g} s, and ROS has no time before 0",
                    "move the other sensors forwards instead",
                )
            return moved_ns

        return Operation(restamp=restamp)
