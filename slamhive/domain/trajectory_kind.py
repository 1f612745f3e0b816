"""Kinds of trajectory that an algorithm gives."""

from __future__ import annotations

from enum import StrEnum


class TrajectoryKind(StrEnum):
    """Moment at which the poses of a trajectory were known."""

    LIVE = "live"
    """Each pose as it was given while the recording played."""
    FINAL = "final"
    """Each frame's pose after the end, with all that was learnt later."""
    KEYFRAMES = "keyframes"
    """The poses of keyframes after the end."""

    @property
    def adjective(self) -> str:
        """Adjective that sentences put before "trajectory"."""
        return self.value.removesuffix("s")


def with_trajectory(label: str, kind: TrajectoryKind | None) -> str:
    """The label of a protocol, with the kind of the trajectory that was judged.

    It stays as it is if it names a kind itself, or if the kind is not stated (None).
    """
    named = {f"{each.adjective} trajectory" for each in TrajectoryKind}
    return label if kind is None or named.intersection(label.split(", ")) else f"{label}, {kind.adjective} trajectory"


# The instant that the poses of an algorithm describe.


class PoseTime(StrEnum):
    """The time convention of a trajectory: the instant at which its poses hold, which is their timestamp."""

    MESSAGE = "message"
    SWEEP_START = "sweep_start"
    SWEEP_MIDDLE = "sweep_middle"
    SWEEP_END = "sweep_end"

    @property
    def words(self) -> str:
        """Phrase that follows "a pose holds"."""
        if self is PoseTime.MESSAGE:
            return "at the timestamp of its image or scan"
        return f"at the {self.removeprefix('sweep_')} of its sweep"
