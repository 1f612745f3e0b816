"""The seam of pre-processing: one step, and what it does to one topic.

A step is a frozen pydantic model: its fields are its options. It says which sensors it can be used on, how their
calibration changes, and what happens to the messages of one topic (:class:`Operation`). Steps are applied in order;
each sees what the ones before it have left. To add one, subclass :class:`Step` (or :class:`SeededStep`) in a file of
its own. Register the class in ``steps/__init__.py``, or announce it from a package of yours in the entry-point group
``slamhive.variant_steps``.
"""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from slamhive.domain.sensors import Sensor

Array = NDArray[Any]
Seed = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Message:
    """One message on its way through a transform.

    ``index`` counts the messages of the topic in the source, from 0 and in order of time, whatever earlier steps have
    dropped; ``stamp_ns`` is the receive time.
    """

    index: int
    stamp_ns: int
    seed: Seed

    def random(self) -> np.random.Generator:
        """Randomness of this message alone: the same whichever thread works on it, and when."""
        return np.random.default_rng((*self.seed, self.index))


@dataclass(frozen=True, slots=True)
class Stream:
    """The messages of one topic, as a step finds them.

    ``sensor`` is calibrated as the steps before have left it; ``count`` messages are in the source.
    """

    sensor: Sensor
    count: int
    seed: Seed

    def random(self) -> np.random.Generator:
        """Randomness of the stream as a whole, for what goes on over many messages (bursts, drifts)."""
        return np.random.default_rng(self.seed)


Keep = Callable[[int, int], bool]
"""``keep(index, stamp_ns)``: called for each message that reaches the step, in order of time, ``index`` from 0."""

Restamp = Callable[[int, int], int]
"""``restamp(index, stamp_ns)``: the new header timestamp; called as :data:`Keep` is. Receive times never change."""

Transform = Callable[[Array, Message], Array]
"""A pure function of its arguments, called from several threads at once and in any order; it returns a new array.

Images come as (h, w) or (h, w, channels) in the type and channel order of the encoding; OpenCV decodes compressed
images, blue first. Point clouds come as structured arrays (n,) with the cloud's fields. IMU samples come as float64
(6,): angular rate (rad/s), then specific force (m/s²).
"""


@dataclass(frozen=True, slots=True)
class Operation:
    """Effect of a step on the messages of one topic; a part that is None leaves them as they are.

    ``keep`` and ``restamp`` are decided before anything is decoded. Messages with neither a new timestamp nor a
    transform are copied byte by byte. ``uses_stamps`` asks for header timestamps, and ``restamp`` implies it. Otherwise
    the time is that of reception, which the bag's index holds at no cost.
    """

    keep: Keep | None = None
    restamp: Restamp | None = None
    transform: Transform | None = None
    uses_stamps: bool = False


class Step(BaseModel, ABC):
    """One pre-processing step with its options; immutable and comparable."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    kind: ClassVar[str]
    """The name it is registered and declared under."""

    version: ClassVar[int] = 1
    """Part of a variant's identity: raise it when the same options make different bytes."""

    @property
    def entropy(self) -> int:
        """Seed of the randomness; see :class:`SeededStep`."""
        return 0

    @abstractmethod
    def applies_to(self, sensor: Sensor) -> bool:
        """Tell if this kind of sensor can be treated at all."""

    @abstractmethod
    def operation(self, stream: Stream) -> Operation:
        """Return the operation on one topic's messages."""

    def check(self, sensor: Sensor) -> None:
        """Raise InvalidInput if the options make no sense on this sensor (a rate above its own)."""

    def is_identity(self, sensor: Sensor) -> bool:  # noqa: ARG002 - for those that know better
        """Tell if nothing changes on this sensor (every factor is 1): such a step needs no copy of the data."""
        return False

    def calibrate(self, sensor: Sensor) -> Sensor:
        """The sensor as ``dataset.yaml`` describes it afterwards; a fault is not announced, so most return it as is."""
        return sensor

    def stream_seed(self, position: int, sensor: Sensor) -> Seed:
        """Entropy for one use of the step: its seed, kind and place among those of its kind, and the sensor's topic.

        They depend neither on the data nor on other steps. A fault hits the same messages at every rate and resolution,
        so two settings can be compared under the same draws.
        """
        text = f"{self.kind}\0{position}\0{sensor.topic}".encode()
        digest = hashlib.sha256(text).digest()
        return (self.entropy, *(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4)))


class SeededStep(Step):
    """A step that draws random numbers: ``seed`` decides them all."""

    seed: int = Field(default=0, ge=0, lt=2**32, description="Decides every random number.")

    @property
    def entropy(self) -> int:
        """The option ``seed``."""
        return self.seed


# Options of steps: pydantic fields with their meaning, unit and range.


def option(help_text: str, *, unit: str = "", default: Any = ..., **bounds: Any) -> Any:
    """A field of a step.

    Args:
        help_text: What it does, for forms and documentation.
        unit: The unit of the value, empty if it has none.
        default: Without one the option must be given.
        **bounds: pydantic's ``ge``, ``gt``, ``le``, ``lt``.
    """
    return Field(default, description=help_text, json_schema_extra={"unit": unit}, **bounds)


# A quantity that swings around its value over time, as an automatic exposure does that hunts.


@dataclass(frozen=True, slots=True)
class Swing:
    """``middle + amplitude * sin(2 pi t / period_s + phase)``; the phase comes from ``seed`` alone.

    Sensors with the same seed therefore swing together.
    """

    middle: float
    amplitude: float
    period_s: float
    seed: int

    def at(self, stamp_ns: int) -> float:
        """The value at one time."""
        if self.amplitude == 0:
            return self.middle
        phase = np.random.default_rng(self.seed).uniform(0.0, 2 * math.pi)
        turns = (stamp_ns % round(self.period_s * 1e9)) / (self.period_s * 1e9)
        return self.middle + self.amplitude * math.sin(2 * math.pi * turns + float(phase))
