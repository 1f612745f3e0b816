"""Yaw + position alignment, which evo lacks: the four degrees of freedom that visual-inertial odometry cannot observe.

SE(3) and Sim(3) are evo's own (Umeyama 1991) and are done where evo is called.
"""

from __future__ import annotations

import math

import numpy as np

from slamhive.errors import InvalidInput
from slamhive.trajectory.model import FloatArray

RANK_TOLERANCE = 1e-12
"""Ratio of singular values of the positions' cross-covariance below which a direction counts as missing; it is the
square of a length ratio: one micrometre across per metre along."""


def align_yaw_position(estimate_m: FloatArray, reference_m: FloatArray) -> FloatArray:
    """The transform T_reference_estimate, shape (4, 4), of rotation about z and translation, least squares.

    With C = sum (p - mean p)(q - mean q)^T over the pairs, yaw = atan2(C01 - C10, C00 + C11) maximises tr(Rz C), and
    t = mean q - Rz mean p (Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation", IROS 2018).

    Args:
        estimate_m: Matched estimated positions p, shape (n, 3).
        reference_m: Matched ground-truth positions q, shape (n, 3); z points up in both frames.

    Raises:
        InvalidInput: One of them hardly moves in the horizontal plane, so that no yaw is better than another.
    """
    mean_estimate, mean_reference = estimate_m.mean(axis=0), reference_m.mean(axis=0)
    p, q = estimate_m - mean_estimate, reference_m - mean_reference
    C = p[:, :2].T @ q[:, :2]
    sine, cosine = C[0, 1] - C[1, 0], C[0, 0] + C[1, 1]
    extent = float(np.linalg.norm(p) * np.linalg.norm(q))
    if math.hypot(sine, cosine) <= RANK_TOLERANCE * extent or extent == 0:
        raise InvalidInput(
            "yaw cannot be determined: the matched poses do not move in the horizontal plane",
            "choose another alignment, or a run that moves",
        )
    yaw = math.atan2(sine, cosine)
    T = np.eye(4)
    T[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    T[:3, 3] = mean_reference - T[:3, :3] @ mean_estimate
    return T


def check_rank(estimate_m: FloatArray, reference_m: FloatArray) -> None:
    """Raise InvalidInput if a rotation between the matched positions, shape (n, 3) each, cannot be determined.

    Umeyama's alignment needs a cross-covariance of rank 2 (Umeyama 1991, section III): positions on one line leave
    the rotation about the line open.
    """
    p, q = estimate_m - estimate_m.mean(axis=0), reference_m - reference_m.mean(axis=0)
    values = np.linalg.svd(q.T @ p / len(p), compute_uv=False)
    for name, centred in (("estimate", p), ("ground truth", q)):
        if not centred.any():
            raise InvalidInput(
                f"alignment is not possible: the {name} stands still over the {len(p)} matched poses",
                "choose the alignment 'none', or a run that moves",
            )
    if values[1] <= RANK_TOLERANCE * values[0]:
        raise InvalidInput(
            f"alignment is not possible: the {len(p)} matched poses lie on a straight line (rank below 2), "
            "so the rotation about it is open",
            "choose the alignment 'yaw_position' or 'none', or a run with a turn",
        )
