"""Poses of one file that have the same timestamp: refused, merged, or kept."""

from __future__ import annotations

import numpy as np

from slamhive.domain.protocol import Duplicates
from slamhive.trajectory.model import FloatArray, Poses, Trajectory


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
    return Trajectory(
        poses.stamps_s[begins],
        np.add.reduceat(poses.positions_m, begins, axis=0) / counts[:, None],
        _mean_quats(poses.quats_xyzw, begins, counts),
    )


def _mean_quats(quats_xyzw: FloatArray, begins: np.ndarray, counts: np.ndarray) -> FloatArray:
    first = np.repeat(quats_xyzw[begins], counts, axis=0)
    signs = np.where((first * quats_xyzw).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    sums = np.add.reduceat(signs * quats_xyzw, begins, axis=0)
    return np.asarray(sums / np.linalg.norm(sums, axis=1, keepdims=True))
