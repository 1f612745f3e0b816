"""The fault ``drop_out``: single messages that never arrive."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from slamhive.bags.variants.step import Operation, SeededStep, Stream
from slamhive.bags.variants.steps.options import option
from slamhive.domain.sensors import Sensor


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
