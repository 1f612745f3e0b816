"""The fault ``drop_bursts``: the connection goes away for a while, again and again."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor


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
    """Whether a message falls between bursts; asked in order of time.

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
        """When the bursts of one window begin, ns; those of the last two windows are remembered."""
        if window not in self._windows:
            random = np.random.default_rng((self._entropy, window + 1))
            count = random.poisson(self._mean_per_window)
            begins = window * self._WINDOW_NS + random.random(count) * self._WINDOW_NS
            self._windows = {known: self._windows[known] for known in self._windows if known == window - 1}
            self._windows[window] = [int(begin) for begin in begins]
        return self._windows[window]
