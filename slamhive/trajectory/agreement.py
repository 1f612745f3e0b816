"""Measures how well the orientations of an estimate agree with the ground truth, in whatever frames."""

from __future__ import annotations

import numpy as np

from slamhive.errors import InvalidInput
from slamhive.trajectory.alignment import align_umeyama
from slamhive.trajectory.association import match_nearest
from slamhive.trajectory.layout import QuaternionOrder
from slamhive.trajectory.model import FloatArray, Poses, Trajectory
from slamhive.trajectory.transforms import inverse_quats, multiply_quats, quats_from_rotations, rotation_angles_rad

MATCHED_WITHIN_S = 0.05
MINIMUM_MATCHED = 10
COMPARED_POSES = 500
"""Spread over the trajectory; more give no further information."""


def thinned_pair(reference: Trajectory, estimate: Trajectory) -> tuple[Poses, Poses] | None:
    """Some hundreds of matched poses of both, spread over the estimate; None where fewer than ten match."""
    of_reference, of_estimate = match_nearest(reference.stamps_s, estimate.stamps_s, MATCHED_WITHIN_S)
    if len(of_reference) < MINIMUM_MATCHED:
        return None
    chosen = np.unique(np.linspace(0, len(of_reference) - 1, COMPARED_POSES).astype(np.intp))
    return reference.take(of_reference[chosen]), estimate.take(of_estimate[chosen])


def reordered(poses: Poses, order: QuaternionOrder) -> Poses:
    """The poses with their quaternions, taken for x y z w, read in ``order`` instead."""
    if order is QuaternionOrder.XYZW:
        return poses
    return Poses(poses.stamps_s, poses.positions_m, np.roll(poses.quats_xyzw, -1, axis=1))


def orientation_spread_deg(reference: Poses, estimate: Poses) -> float | None:
    """How far the rotation between the two moving frames is from being one and the same all the time, in degrees.

    Both frames may be mounted anyhow, so only what changes between them counts: the median angle to their mean. The
    worlds are aligned by positions (Umeyama), with scale; None where those leave it open.

    Args:
        reference: Matched poses of the ground truth, n of them.
        estimate: Matched poses of the estimate, n of them.
    """
    try:
        rotation = align_umeyama(estimate.positions_m, reference.positions_m, scaled=True).rotation
    except InvalidInput:
        return None
    turned = multiply_quats(quats_from_rotations(rotation[None]), estimate.quats_xyzw)
    return spread_deg(multiply_quats(inverse_quats(reference.quats_xyzw), turned))


def spread_deg(quats_xyzw: FloatArray) -> float:
    """Median angle of orientations, shape (n, 4), to their mean, in degrees.

    The mean is the eigenvector of the largest eigenvalue of the sum of q q^T (Markley et al., "Averaging quaternions",
    JGCD 2007, equation 12).
    """
    _, vectors = np.linalg.eigh(quats_xyzw.T @ quats_xyzw)
    mean = vectors[None, :, -1]
    return float(np.rad2deg(np.median(rotation_angles_rad(np.repeat(mean, len(quats_xyzw), axis=0), quats_xyzw))))
