"""Trajectories whose orientations mean nothing.

Receivers and total stations measure positions. Files of eight columns then hold 0 0 0 0 or 0 0 0 1 in all rows. That is
no orientation: compared with a real one, it gives errors of up to 180 degrees.
"""

from __future__ import annotations

import numpy as np

from slamhive.trajectory.model import FloatArray

TURNED_RAD = np.deg2rad(45)
"""A path whose direction changes by this turns; a body that follows it turns too."""
SHORTEST_STEP_M = 0.02
"""Shorter steps are noise, and have no direction."""
CONSTANT = 1e-6
"""How far the numbers of a quaternion may be from those of the first: no real orientation stays that equal."""
FEWEST_POSES = 10
"""Of fewer poses nothing is concluded."""
_STEPS = 50

ZERO = "all quaternions are 0 0 0 0"
NEVER_TURNS = "the orientation never changes, although the path turns"


def lacking(quats: FloatArray, positions_m: FloatArray) -> str:
    """Why the orientations mean nothing, empty if they do.

    Args:
        quats: Shape (n, 4), in any order.
        positions_m: Shape (n, 3).
    """
    if len(quats) and not quats.any():
        return ZERO
    return NEVER_TURNS if is_constant(quats, positions_m) else ""


def no_rotations(count: int) -> FloatArray:
    """Quaternions (count, 4) that stand where no orientations are known."""
    return np.tile((0.0, 0.0, 0.0, 1.0), (count, 1))


def is_constant(quats: FloatArray, positions_m: FloatArray) -> bool:
    """Return whether the orientation never changes although the path turns.

    Args:
        quats: Shape (n, 4), in any order.
        positions_m: Shape (n, 3).
    """
    if len(quats) < FEWEST_POSES or not np.isfinite(quats).all() or not np.isfinite(positions_m).all():
        return False
    # q and -q are one orientation. A file may hold any number here; what is no quaternion is refused later.
    with np.errstate(over="ignore"):
        away = np.minimum(np.abs(quats - quats[0]).max(axis=1), np.abs(quats + quats[0]).max(axis=1))
    return float(away.max()) < CONSTANT and heading_change_rad(positions_m) > TURNED_RAD


def heading_change_rad(positions_m: FloatArray) -> float:
    """Largest angle between the first long step and any later one; positions (n, 3)."""
    chosen = positions_m[:: max(1, len(positions_m) // _STEPS)]
    with np.errstate(over="ignore"):  # a file may hold any number; steps too long for one have no direction
        steps = np.diff(chosen, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
    counts = (lengths > SHORTEST_STEP_M) & np.isfinite(lengths)
    steps, lengths = steps[counts], lengths[counts]
    if len(steps) < 2:
        return 0.0
    cosines = (steps / lengths[:, None]) @ (steps[0] / lengths[0])
    return float(np.arccos(np.clip(cosines.min(), -1.0, 1.0)))
