"""The instant that the poses of an algorithm describe."""

from __future__ import annotations

from enum import StrEnum


class PoseTime(StrEnum):
    """The time convention of a trajectory: the instant at which its poses hold, which is their timestamp."""

    MESSAGE = "message"
    SWEEP_START = "sweep_start"
    SWEEP_MIDDLE = "sweep_middle"
    SWEEP_END = "sweep_end"

    @property
    def words(self) -> str:
        """What follows "a pose holds"."""
        if self is PoseTime.MESSAGE:
            return "at the timestamp of its image or scan"
        return f"at the {self.removeprefix('sweep_')} of its sweep"
