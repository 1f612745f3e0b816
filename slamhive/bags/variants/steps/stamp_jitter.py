"""The fault ``stamp_jitter``: timestamps taken by a clock that is read late, or early, by chance."""

from __future__ import annotations

from typing import ClassVar

from slamhive.bags.variants.step import Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor


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
