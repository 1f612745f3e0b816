"""Interpolates poses: positions linearly, orientations along the shortest rotation (slerp)."""

from __future__ import annotations

import numpy as np

from slamhive.trajectory.model import FloatArray, Poses, Trajectory

_NEARLY_PARALLEL = 1 - 1e-9
"""Above this cosine slerp divides by almost 0, and linear interpolation is as good."""


def interpolate(trajectory: Trajectory, stamps_s: FloatArray) -> Poses:
    """The poses of ``trajectory`` at ``stamps_s``, shape (n,); before its start the first, after its end the last.

    Orientations by slerp (Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985). scipy's takes
    no equal timestamps, which a trajectory may hold.
    """
    if len(trajectory) == 1:
        alone = trajectory.take(np.zeros(len(stamps_s), dtype=np.intp))
        return Poses(stamps_s, alone.positions_m, alone.quats_xyzw)
    before = np.clip(np.searchsorted(trajectory.stamps_s, stamps_s, side="right") - 1, 0, len(trajectory) - 2)
    begin_s, end_s = trajectory.stamps_s[before], trajectory.stamps_s[before + 1]
    interval_s = np.where(end_s > begin_s, end_s - begin_s, 1.0)  # two poses at one time: the later one counts
    part = np.where(end_s > begin_s, np.clip((stamps_s - begin_s) / interval_s, 0.0, 1.0), 1.0)[:, None]
    positions_m = (1 - part) * trajectory.positions_m[before] + part * trajectory.positions_m[before + 1]
    quats_xyzw = _slerp(trajectory.quats_xyzw[before], trajectory.quats_xyzw[before + 1], part)
    return Poses(stamps_s, positions_m, quats_xyzw)


def _slerp(begin_xyzw: FloatArray, end_xyzw: FloatArray, part: FloatArray) -> FloatArray:
    cosine = (begin_xyzw * end_xyzw).sum(axis=1, keepdims=True)
    end_xyzw = np.where(cosine < 0, -end_xyzw, end_xyzw)
    cosine = np.minimum(np.abs(cosine), 1.0)
    straight = cosine > _NEARLY_PARALLEL
    angle = np.arccos(np.where(straight, 0.0, cosine))
    sine = np.sin(angle)
    of_begin = np.where(straight, 1 - part, np.sin((1 - part) * angle) / sine)
    of_end = np.where(straight, part, np.sin(part * angle) / sine)
    quats_xyzw = of_begin * begin_xyzw + of_end * end_xyzw
    quats_xyzw /= np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    return np.asarray(quats_xyzw)
