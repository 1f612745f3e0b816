"""What is asked of a configuration, and what comes of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slamhive.domain.variant import Variant
from slamhive.services.configurations.words import check_label, check_note
from slamhive.store import ConfigurationRecord


@dataclass(frozen=True, slots=True)
class Changes:
    """What a copy has instead of the original's; None leaves it. ``parameters`` are set beside the original's."""

    algorithm: str | None = None
    dataset: str | None = None
    parameters: Mapping[str, object] | None = None
    variant: Variant | None = None
    playback_mode: str | None = None
    playback_rate: float | None = None


@dataclass(frozen=True, slots=True)
class Label:
    """What users say about a configuration; None leaves what is there, an empty text removes it."""

    name: str | None = None
    note: str | None = None
    group: str | None = None

    def checked(self) -> Label:
        """The same without white space around; raises InvalidInput for a text that is none of its kind."""
        return Label(
            name=None if self.name is None else check_label("configuration", self.name, empty=True),
            note=None if self.note is None else check_note(self.note),
            group=check_label("group", self.group) if self.group else None,
        )


NO_LABEL = Label()


@dataclass(frozen=True, slots=True)
class Stored:
    """A configuration after an attempt to store it. ``notes`` tell, one line each, what did not come over and why.

    ``created`` is false where it was there already: identical configurations are one. ``seed`` is an import's.
    """

    record: ConfigurationRecord
    created: bool
    notes: tuple[str, ...] = ()
    seed: int = 0

    @property
    def words(self) -> str:
        """``configuration 12 is new``, or ``the same as configuration 12 (half rate)``."""
        return f"{self.record.label} is new" if self.created else f"the same as {self.record.label}"
