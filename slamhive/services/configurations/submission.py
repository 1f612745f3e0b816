"""What a user asks for: one request makes one or more runs. The same in CLI, form and web API."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

from slamhive.domain.algorithm import Algorithm
from slamhive.domain.configuration import Configuration, Playback, PlaybackMode
from slamhive.domain.parameters import parse_settings
from slamhive.domain.protocol import Alignment
from slamhive.domain.stop_when import NEVER, StopWhen
from slamhive.domain.variant import Variant
from slamhive.errors import InvalidInput


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a number of a request may be, both ends included."""

    what: str
    minimum: float
    maximum: float

    @property
    def remedy(self) -> str:
        """``use 1 to 1000``."""
        return f"use {self.minimum:.10g} to {self.maximum:.10g}"

    def check(self, value: float) -> None:
        """Raise InvalidInput for a number outside, and for NaN."""
        if not self.minimum <= value <= self.maximum:
            raise InvalidInput(f"{self.what} {value!r} is not allowed", self.remedy)


BOUNDS = {
    "repeat": Bounds("repeat", 1, 1000),
    "playback_rate": Bounds("playback rate", 0.01, 100),
    "seed": Bounds("seed", 0, 2**31 - 1),
    "priority": Bounds("priority", -1000, 1000),
    "cpu_cores": Bounds("CPU limit in cores", 0.1, 1024),
    "memory_mb": Bounds("memory limit in MB", 16, 10_000_000),
    "timeout_s": Bounds("time limit in s", 1, 30 * 86_400),
}
"""Of the numbers of a :class:`Submission`, by field."""


@dataclass(frozen=True, slots=True)
class Submission:
    """A request as it comes in, values still unchecked text where a user typed them.

    ``alignment`` None means the default for the sensors. ``cpu_cores`` and ``memory_mb`` None mean the
    defaults of settings and package. ``timeout_s`` None derives the limit from the dataset's duration. ``variant``
    are steps that the dataset goes through beforehand. ``stop_when`` are the rules that end a run early.
    """

    algorithm: str
    dataset: str
    parameters: Mapping[str, object] = field(default_factory=dict)
    repeat: int = 1
    executor: str | None = None
    seed: int = 0
    playback_mode: str = PlaybackMode.REALTIME.value
    playback_rate: float = 1.0
    evaluate: bool = True
    alignment: str | None = None
    cpu_cores: float | None = None
    memory_mb: int | None = None
    timeout_s: float | None = None
    priority: int = 0
    variant: Variant = ()
    stop_when: StopWhen = NEVER

    def configuration(self, algorithm: Algorithm) -> Configuration:
        """The checked configuration, its variant as it was given; raises NotFound or InvalidInput naming the value."""
        return Configuration(
            algorithm=algorithm.name,
            dataset=self.dataset,
            parameters=parse_settings(algorithm.name, algorithm.parameters, self.parameters),
            playback=Playback(self._playback_mode(), self.playback_rate),
            variant=self.variant,
        )

    def check(self) -> None:
        """Raise InvalidInput for a number that cannot be meant."""
        for name, bounds in BOUNDS.items():
            value = getattr(self, name)
            if value is not None:
                bounds.check(value)
        BOUNDS["seed"].check(self.seed + self.repeat - 1)
        self.stop_when.check()
        if self.alignment is not None and self.alignment not in set(Alignment):
            raise InvalidInput(f"alignment {self.alignment!r} is not known", f"use one of {', '.join(Alignment)}")

    def _playback_mode(self) -> PlaybackMode:
        try:
            return PlaybackMode(self.playback_mode)
        except ValueError:
            raise InvalidInput(
                f"playback mode {self.playback_mode!r} is not known", f"use one of {', '.join(PlaybackMode)}"
            ) from None


def unwatchable(rules: StopWhen, algorithms: Iterable[Algorithm]) -> str | None:
    """Which of the rules cannot be watched for which algorithms, in words; None if all can."""
    silent = sorted({entry.name for entry in algorithms if not entry.package.reports_tracking})
    if rules.lost_tracking_s is None or not silent:
        return None
    does = "does" if len(silent) == 1 else "do"
    return f"lost_tracking_s has no effect on {', '.join(silent)}, which {does} not say which frames are tracked"
