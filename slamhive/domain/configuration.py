"""A configuration: what exactly is run. Two configurations with equal content are one."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field
from enum import StrEnum

from slamhive.domain.parameters import Value
from slamhive.domain.sensor_choice import Chosen
from slamhive.domain.variant import Variant
from slamhive.domain.versions import version_label

_as_json = json.JSONEncoder(sort_keys=True, separators=(",", ":"), allow_nan=False).encode


class PlaybackMode(StrEnum):
    """How the recording is fed: in real time (a slow algorithm loses frames) or one message after the other."""

    REALTIME = "realtime"
    SEQUENTIAL = "sequential"


@dataclass(frozen=True, slots=True)
class Playback:
    """How the recording is fed; ``rate`` scales real time (2.0 is twice as fast)."""

    mode: PlaybackMode = PlaybackMode.REALTIME
    rate: float = 1.0


@dataclass(frozen=True, slots=True)
class InputMap:
    """The map that a run starts with: the uid of the run that saved it, and the hash of the map, ``sha256:<hex>``."""

    run: str
    content: str


@dataclass(frozen=True, slots=True)
class Configuration:
    """An algorithm, a dataset and what is done to it beforehand, the values of parameters, and how the data is fed.

    ``parameters`` lacks those that are taken from sensors. ``sensors`` is what the user chose in place of the rule, in
    the form of :meth:`~slamhive.domain.algorithm.Algorithm.stated_choice`. ``version`` is the version of the package
    that was asked for, None for the newest at the time of the run. ``map`` is the map that the algorithm starts with.
    """

    algorithm: str
    dataset: str
    parameters: dict[str, Value]
    playback: Playback = Playback()
    variant: Variant = ()
    sensors: Chosen = field(default_factory=dict)
    version: int | None = None
    map: InputMap | None = None

    @property
    def algorithm_label(self) -> str:
        """The algorithm as it is asked for: ``aloam``, or ``aloam@2`` for a version."""
        return self.algorithm if self.version is None else version_label(self.algorithm, self.version)

    @property
    def content_hash(self) -> str:
        """SHA-256 over the content, independent of the order in which parameters were given."""
        content: dict[str, object] = {
            "algorithm": self.algorithm,
            "dataset": self.dataset,
            "parameters": {key: _tagged(value) for key, value in self.parameters.items()},
            "playback": [self.playback.mode.value, float(self.playback.rate)],
        }
        if self.variant:
            content["variant"] = [step.content for step in self.variant]
        if self.sensors:
            content["sensors"] = dict(self.sensors)
        if self.version is not None:
            content["version"] = self.version
        if self.map is not None:
            content["map"] = self.map.content
        return hashlib.sha256(_as_json(content).encode()).hexdigest()


def _tagged(value: Value) -> list[object]:
    """The value with its type, so that 1, 1.0, True and "1" stay four different values."""
    return [type(value).__name__, list(value) if isinstance(value, tuple) else value]
