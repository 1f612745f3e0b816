"""Trajectories: timestamped poses that are known to be valid, and orientations that mean nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Duplicates

FloatArray = npt.NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-2
"""How far a quaternion's norm may be from 1: text files round their digits, anything further is a mistake."""

MAX_POSITION_M = 1e12
"""Beyond this a position is a diverged estimate, and squares of it lose all precision."""


@dataclass(frozen=True, slots=True)
class PoseProblem:
    """Error in the pose at ``index``: the finding, and what to do about it."""

    index: int
    found: str
    remedy: str


@dataclass(frozen=True, slots=True, eq=False)
class Poses:
    """Timestamped poses of a moving frame in a fixed one.

    Those of a :class:`Trajectory`, or those of it that were matched: the same pose may then stand twice.

    Attributes:
        stamps_s: Time of each pose in s, shape (n,).
        positions_m: Positions in the fixed frame in m, shape (n, 3).
        quats_xyzw: Orientations as unit quaternions, w last, shape (n, 4).
    """

    stamps_s: FloatArray
    positions_m: FloatArray
    quats_xyzw: FloatArray

    def __len__(self) -> int:
        return int(self.stamps_s.shape[0])

    @property
    def span_s(self) -> float:
        """Time from the first to the last pose in s."""
        return float(self.stamps_s[-1] - self.stamps_s[0])

    @property
    def path_length_m(self) -> float:
        """Sum of the distances between neighbouring poses in m."""
        return float(np.linalg.norm(np.diff(self.positions_m, axis=0), axis=1).sum())

    def take(self, indices: npt.NDArray[np.intp]) -> Poses:
        """The poses at ``indices``, in that order."""
        return Poses(self.stamps_s[indices], self.positions_m[indices], self.quats_xyzw[indices])


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory(Poses):
    """Poses of a moving frame in a fixed one, in the order of time.

    Creating one validates it: at least one pose, timestamps never decreasing, every number finite, quaternions unit
    within :data:`QUATERNION_TOLERANCE`. Quaternions are normalised, and the arrays become read-only. Equal timestamps
    remain only where the user chose to keep them.

    Raises:
        InvalidInput: Naming the first bad pose, counted from 0, and the value.
    """

    def __post_init__(self) -> None:
        stamps_s = np.array(self.stamps_s, dtype=np.float64)
        positions_m = np.array(self.positions_m, dtype=np.float64)
        quats_xyzw = np.array(self.quats_xyzw, dtype=np.float64)
        count = stamps_s.shape[0] if stamps_s.ndim == 1 else -1
        if positions_m.shape != (count, 3) or quats_xyzw.shape != (count, 4):
            shapes = f"{stamps_s.shape}, {positions_m.shape}, {quats_xyzw.shape}"
            raise InvalidInput(f"a trajectory takes arrays of shape (n,), (n, 3) and (n, 4), got {shapes}")
        if count == 0:
            raise InvalidInput("a trajectory needs at least one pose")
        problem = find_problem(stamps_s, positions_m, quats_xyzw, duplicates=True)
        if problem is not None:
            raise InvalidInput(f"pose {problem.index}: {problem.found}", problem.remedy)
        quats_xyzw /= np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
        for name, array in (("stamps_s", stamps_s), ("positions_m", positions_m), ("quats_xyzw", quats_xyzw)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)


def find_problem(
    stamps_s: FloatArray, positions_m: FloatArray, quats_xyzw: FloatArray, *, duplicates: bool = False
) -> PoseProblem | None:
    """The first pose that cannot be part of a trajectory, None if all can. Shapes (n,), (n, 3), (n, 4).

    ``duplicates``: several poses may have the same timestamp.
    """
    found: list[PoseProblem] = []
    rows = np.column_stack((stamps_s, positions_m, quats_xyzw))
    index = _first(~np.isfinite(rows).all(axis=1))
    if index is not None:
        names = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
        column = int((~np.isfinite(rows[index])).argmax())
        problem = f"{names[column]} is {rows[index, column]}"
        found.append(PoseProblem(index, problem, "leave out poses that are not known"))

    steps_s = np.diff(stamps_s)
    before = _first(steps_s < 0 if duplicates else steps_s <= 0)
    if before is not None:
        earlier, later = stamps_s[before], stamps_s[before + 1]
        if earlier == later:
            remedy = "write one pose for each timestamp, or choose with --duplicates first, mean or keep"
            found.append(PoseProblem(before + 1, f"timestamp {later:.9f} occurs twice", remedy))
        else:
            problem = f"timestamp {later:.9f} comes after {earlier:.9f}"
            found.append(PoseProblem(before + 1, problem, "sort the poses by timestamp"))

    # Values that are not finite, or overflow when squared, are no reason to warn: the first check names them.
    with np.errstate(over="ignore", invalid="ignore"):
        index = _first((np.abs(positions_m) > MAX_POSITION_M).any(axis=1))
        norms = np.linalg.norm(quats_xyzw, axis=1)
    if index is not None:
        problem = f"position {float(np.abs(positions_m[index]).max()):g} m is beyond {MAX_POSITION_M:g} m"
        found.append(PoseProblem(index, problem, "the estimate diverged; leave such poses out"))

    index = _first(np.abs(norms - 1.0) > QUATERNION_TOLERANCE)
    if index is not None and norms[index] == 0:
        remedy = "leave out poses without orientation; if none has one, write timestamp x y z alone"
        found.append(PoseProblem(index, "quaternion is all zero", remedy))
    elif index is not None:
        problem = f"quaternion has norm {norms[index]:.6g}, not 1"
        found.append(PoseProblem(index, problem, "write unit quaternions in the order qx qy qz qw"))
    # Of several problems of one pose, the first in this order is reported.
    return min(found, key=lambda problem: problem.index, default=None)


def _first(bad: npt.ArrayLike) -> int | None:
    indices = np.flatnonzero(bad)
    return int(indices[0]) if indices.size else None


# Poses of one file that have the same timestamp: refused, merged, or kept.


def repair(poses: Poses, how: Duplicates) -> Trajectory:
    """The trajectory of ``poses``, whose timestamps never decrease, with what ``how`` leaves of equal timestamps.

    The mean of orientations has the least squared chordal distance to first order: quaternions of equal sign are added
    and normalised. Markley et al., "Averaging quaternions", JGCD 2007, give the exact solution.
    """
    begins = np.flatnonzero(np.diff(poses.stamps_s, prepend=-np.inf) > 0)
    if how in (Duplicates.REFUSE, Duplicates.KEEP) or len(begins) == len(poses):
        return Trajectory(poses.stamps_s, poses.positions_m, poses.quats_xyzw)
    if how is Duplicates.FIRST:
        first = poses.take(begins)
        return Trajectory(first.stamps_s, first.positions_m, first.quats_xyzw)
    counts = np.diff(np.append(begins, len(poses)))
    # A quaternion and its negative are one orientation: all get the sign of the first.
    firsts = np.repeat(poses.quats_xyzw[begins], counts, axis=0)
    signs = np.where((firsts * poses.quats_xyzw).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    sums = np.add.reduceat(signs * poses.quats_xyzw, begins, axis=0)
    return Trajectory(
        poses.stamps_s[begins],
        np.add.reduceat(poses.positions_m, begins, axis=0) / counts[:, None],
        np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True)),
    )


# Trajectories whose orientations mean nothing.
#
# Receivers and total stations measure positions. Files of eight columns then hold 0 0 0 0 or 0 0 0 1 in all rows. That
# is no orientation: compared with a real one, it gives errors of up to 180 degrees.


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
