"""Requested changes of configurations, and their results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.parameters import Value
from slamhive.domain.sensor_choice import Chosen
from slamhive.domain.variant import Variant
from slamhive.services.configurations.words import check_label, check_note
from slamhive.store import ConfigurationRecord


@dataclass(frozen=True, slots=True)
class Changes:
    """The differences of a copy; None keeps the original. ``parameters`` are added to those of the original."""

    algorithm: str | None = None
    dataset: str | None = None
    parameters: Mapping[str, Value] | None = None
    variant: Variant | None = None
    sensors: Chosen | None = None
    playback_mode: PlaybackMode | None = None
    playback_rate: float | None = None
    map: str | None = None


@dataclass(frozen=True, slots=True)
class Label:
    """Name, note and group of a configuration; None keeps the current text, an empty text removes it."""

    name: str | None = None
    note: str | None = None
    group: str | None = None

    def checked(self) -> Label:
        """The stripped label; raises InvalidInput for a text that is not allowed."""
        return Label(
            name=None if self.name is None else check_label("configuration", self.name, empty=True),
            note=None if self.note is None else check_note(self.note),
            group=check_label("group", self.group) if self.group else None,
        )


NO_LABEL = Label()


@dataclass(frozen=True, slots=True)
class Stored:
    """A stored configuration. ``notes`` explain, one line each, what was not taken over.

    ``created`` is false if an identical configuration existed already. ``seed`` is that of an imported file.
    """

    record: ConfigurationRecord
    created: bool
    notes: tuple[str, ...] = ()
    seed: int = 0

    @property
    def words(self) -> str:
        """``configuration 12 is new``, or ``the same as configuration 12 (half rate)``."""
        return f"{self.record.label} is new" if self.created else f"the same as {self.record.label}"
