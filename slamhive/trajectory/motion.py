"""How fast a body moves and turns along a trajectory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import rotation_angles_rad

WINDOW_S = 0.2
"""Mean motion over this time is shown: single steps of a 200 Hz ground truth are mostly noise."""

_LONGEST_WINDOWS = 5
"""Poses further apart than this many windows have a gap between them, where the motion is unknown."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Speed and angular rate over time.

    Attributes:
        times_s: The middle of each interval, shape (n,), on the clock of the trajectory.
        speeds_mps: Mean speed in each interval, shape (n,).
        angular_rates_radps: Mean angular rate in each interval, shape (n,).
    """

    times_s: FloatArray
    speeds_mps: FloatArray
    angular_rates_radps: FloatArray


def motion_of(poses: Poses, window_s: float = WINDOW_S) -> Motion:
    """The motion between each pose and the first one at least ``window_s`` later; nothing across gaps."""
    times_s = poses.stamps_s
    later = np.searchsorted(times_s, times_s + window_s)
    first = np.flatnonzero(later < len(times_s))
    last = later[first]
    close = times_s[last] - times_s[first] <= _LONGEST_WINDOWS * max(window_s, 1e-9)
    first, last = first[close], last[close]
    spans_s = times_s[last] - times_s[first]
    distances_m = np.linalg.norm(poses.positions_m[last] - poses.positions_m[first], axis=1)
    angles_rad = rotation_angles_rad(poses.quats_xyzw[first], poses.quats_xyzw[last])
    return Motion((times_s[first] + times_s[last]) / 2, distances_m / spans_s, angles_rad / spans_s)
