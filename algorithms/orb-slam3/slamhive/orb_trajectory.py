"""Trajectories that ORB-SLAM3 writes: taken without hanging, and put right."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slamhive.base.errors import InvalidInput
from slamhive.runtime.program import done_by_child
from slamhive.runtime.trajectory import transform_from

SAVING_LIMIT_S = 30.0
KEYFRAMES = "keyframes.txt"
"""The file with the keyframes of the current map, which :func:`save_trajectory` leaves in its folder."""
_KEYFRAMES = re.compile(r"Map \d+ has (\d+) KFs")


class Savable(Protocol):
    """A :class:`pyorbslam3.Slam` that was shut down."""

    def save_keyframe_trajectory_tum(self, path: str) -> None:
        """Write the keyframes of the current map."""

    def save_trajectory_euroc(self, path: str) -> None:
        """Write the frames of the map with most keyframes."""


def save_trajectory(slam: Savable, folder: Path, limit_s: float = SAVING_LIMIT_S) -> Path | None:
    """The file with the final trajectory, in ``folder``; None if no map holds a keyframe.

    If there is no keyframe, ``SaveTrajectoryEuRoC`` continues with an uninitialised map: it crashes, or waits for ever
    for a lock. ``SaveKeyFrameTrajectoryTUM`` is safe, but saves the current map only. The current map may be empty
    because tracking was lost and the map restarted. An older map may still hold keyframes, so a child process tries
    to save it. The child inherits no held lock, because no thread works on an empty map.

    Raises InvalidInput if there are keyframes, but saving crashes or takes more than ``limit_s``.
    """
    path, keyframes, log = (folder / name for name in ("trajectory.txt", KEYFRAMES, "saving.log"))
    slam.save_keyframe_trajectory_tum(str(keyframes))
    if keyframes.stat().st_size:
        slam.save_trajectory_euroc(str(path))
        return path
    if _saved_by_child(slam, path, log, limit_s):
        return path
    if any(int(count) for count in _KEYFRAMES.findall(log.read_text(errors="replace"))):
        raise InvalidInput(f"ORB-SLAM3 has keyframes, but did not save its trajectory within {limit_s:g} s")
    return None


def read_tum(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Timestamps (n,) in the unit of the file, and poses (n, 4, 4), once for each timestamp; none without a file."""
    text = path.read_text(encoding="ascii") if path.is_file() else ""
    if not text.strip():
        return np.empty(0), np.empty((0, 4, 4))
    table = without_repeats(np.loadtxt(text.splitlines(), ndmin=2, comments="#").reshape(-1, 8))
    poses = np.array([transform_from(row[1:4], row[4:8]) for row in table]).reshape(-1, 4, 4)
    return table[:, 0], poses


def without_repeats(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rows of ``table`` (n, 8: timestamp, position, quaternion), only the first of each timestamp."""
    _, first = np.unique(table[:, 0], return_index=True)
    return table[np.sort(first)]


def _saved_by_child(slam: Savable, path: Path, log: Path, limit_s: float) -> bool:
    """True if a child process wrote the file; ``log`` takes its output."""

    def save() -> None:
        os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), 1)
        slam.save_trajectory_euroc(str(path))

    return done_by_child(save, limit_s)
