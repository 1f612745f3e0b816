"""The fault ``time_offset``: a clock that is wrong by a constant and by a drift, unknown to the algorithm."""

from __future__ import annotations

from typing import ClassVar

from slamhive.bags.variants.step import Operation, Step, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor
from slamhive.errors import InvalidInput


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
