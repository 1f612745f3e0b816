"""Which of its trajectories an algorithm gives."""

from __future__ import annotations

from enum import StrEnum


class TrajectoryKind(StrEnum):
    """When the poses of a trajectory were known."""

    LIVE = "live"
    """Each pose as it was given while the recording played."""
    FINAL = "final"
    """Each frame's pose after the end, with all that was learnt later."""
    KEYFRAMES = "keyframes"
    """The poses of keyframes after the end."""

    @property
    def adjective(self) -> str:
        """What sentences put before "trajectory"."""
        return self.value.removesuffix("s")
