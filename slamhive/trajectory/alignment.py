"""Alignment: the transform that moves an estimate onto its ground truth, least squares over matched positions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment
from slamhive.trajectory.model import FloatArray, Poses, Trajectory
from slamhive.trajectory.transforms import multiply_quats, quats_from_rotations, rotations_from_quats

RANK_TOLERANCE = 1e-12
"""Ratio of singular values of the positions' cross-covariance below which a direction counts as missing; it is the
square of a length ratio: one micrometre across per metre along."""

MINIMUM_POSES = {
    Alignment.NONE: 1,
    Alignment.FIRST_POSE: 1,
    Alignment.SCALE: 3,
    Alignment.YAW_POSITION: 3,
    Alignment.SE3: 3,
    Alignment.SIM3: 4,
}
"""With fewer an alignment is arbitrary: three positions are nine numbers, of which Sim(3) would fit seven."""

_AnyPoses = TypeVar("_AnyPoses", Poses, Trajectory)


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """Moves points of the estimate's world into the ground truth's: ``q = scale R p + t``.

    Attributes:
        scale: Factor, without unit.
        rotation: R, shape (3, 3).
        translation_m: t, shape (3,).
    """

    scale: float
    rotation: FloatArray
    translation_m: FloatArray

    @property
    def matrix(self) -> FloatArray:
        """Return one matrix, shape (4, 4), with the upper left part scaled."""
        T = np.eye(4)
        T[:3, :3] = self.scale * self.rotation
        T[:3, 3] = self.translation_m
        return T

    def points(self, points_m: FloatArray) -> FloatArray:
        """The points, shape (n, 3), moved."""
        moved: FloatArray = self.scale * points_m @ self.rotation.T + self.translation_m
        return moved

    def poses(self, poses: _AnyPoses) -> _AnyPoses:
        """The poses moved: positions scaled, rotated and translated, orientations rotated."""
        quat_xyzw = quats_from_rotations(self.rotation[None])
        return type(poses)(poses.stamps_s, self.points(poses.positions_m), multiply_quats(quat_xyzw, poses.quats_xyzw))


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def align(alignment: Alignment, estimate: Poses, reference: Poses, first: int | None = None) -> Similarity:
    """The transform of ``alignment`` from the matched poses of the estimate to those of the ground truth.

    Args:
        alignment: What may be moved.
        estimate: Matched poses of the estimate.
        reference: Matched poses of the ground truth, as many.
        first: How many of them to use, from the start; None for all. Of one, SE(3) and yaw + position take the
            orientation too.

    Raises:
        InvalidInput: They do not determine the transform.
    """
    if first == 1 and alignment is Alignment.SE3:
        alignment = Alignment.FIRST_POSE
    if first == 1 and alignment is Alignment.YAW_POSITION:
        return _first_yaw_position(estimate, reference)
    count = len(estimate) if first is None else min(first, len(estimate))
    if count < MINIMUM_POSES[alignment]:
        raise InvalidInput(
            f"the alignment {alignment} needs at least {MINIMUM_POSES[alignment]} matched poses, there are {count}",
            "choose another alignment, or a run that tracked more",
        )
    if alignment is Alignment.NONE:
        return IDENTITY
    if alignment is Alignment.FIRST_POSE:
        return _first_pose(estimate, reference)
    estimate_m, reference_m = estimate.positions_m[:count], reference.positions_m[:count]
    if alignment is Alignment.YAW_POSITION:
        return align_yaw_position(estimate_m, reference_m)
    if alignment is Alignment.SCALE:
        return Similarity(align_umeyama(estimate_m, reference_m, scaled=True).scale, np.eye(3), np.zeros(3))
    return align_umeyama(estimate_m, reference_m, scaled=alignment is Alignment.SIM3)


def align_umeyama(estimate_m: FloatArray, reference_m: FloatArray, *, scaled: bool) -> Similarity:
    """Rotation, translation and, if ``scaled``, scale that minimise the squared distances.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. The
    covariance (equation 38) is U D V^T, and S = diag(1, 1, sign(det U det V)). Then R = U S V^T (40),
    c = tr(D S) / variance (42), and t = mean q - c R mean p (41).

    Args:
        estimate_m: Matched estimated positions p, shape (n, 3).
        reference_m: Matched ground-truth positions q, shape (n, 3).
        scaled: Whether the scale is free; it is 1 otherwise.

    Raises:
        InvalidInput: One of them stands still or lies on a straight line, which leaves a rotation open.
    """
    mean_estimate, mean_reference = estimate_m.mean(axis=0), reference_m.mean(axis=0)
    p, q = estimate_m - mean_estimate, reference_m - mean_reference
    U, d, Vt = np.linalg.svd(q.T @ p / len(p))
    # A cross-covariance of rank below 2 leaves the rotation open (Umeyama 1991, section III).
    for name, centred in (("estimate", p), ("ground truth", q)):
        if not centred.any():
            raise InvalidInput(
                f"alignment is not possible: the {name} stands still over the {len(p)} matched poses",
                "choose the alignment 'none', or a run that moves",
            )
    if d[1] <= RANK_TOLERANCE * d[0]:
        raise InvalidInput(
            f"alignment is not possible: the {len(p)} matched poses lie on a straight line (rank below 2), "
            "so the rotation about it is open",
            "choose the alignment 'first_pose' or 'none' ('yaw_position' where z points up), or a run with a turn",
        )
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    rotation = (U * S) @ Vt
    scale = float((d * S).sum() / (np.linalg.norm(p) ** 2 / len(p))) if scaled else 1.0
    return Similarity(scale, rotation, mean_reference - scale * rotation @ mean_estimate)


def align_yaw_position(estimate_m: FloatArray, reference_m: FloatArray) -> Similarity:
    """Rotation about z and translation, the four degrees of freedom that visual-inertial odometry cannot observe.

    Zhang and Scaramuzza, "A Tutorial on Quantitative Trajectory Evaluation", IROS 2018. With C = sum (p - mean p)(q -
    mean q)^T over the pairs, yaw = atan2(C01 - C10, C00 + C11) maximises tr(Rz C). Then t = mean q - Rz mean p.

    Args:
        estimate_m: Matched estimated positions p, shape (n, 3).
        reference_m: Matched ground-truth positions q, shape (n, 3); z points up in both frames.

    Raises:
        InvalidInput: One of them hardly moves in the horizontal plane, so that no yaw is better than another.
    """
    mean_estimate, mean_reference = estimate_m.mean(axis=0), reference_m.mean(axis=0)
    p, q = estimate_m - mean_estimate, reference_m - mean_reference
    rotation = _best_yaw(p.T @ q)
    if rotation is None:
        raise InvalidInput(
            "yaw cannot be determined: the matched poses do not move in the horizontal plane",
            "choose another alignment, or a run that moves",
        )
    return Similarity(1.0, rotation, mean_reference - rotation @ mean_estimate)


def _best_yaw(C: FloatArray) -> FloatArray | None:
    """The rotation Rz about z that maximises tr(Rz C), C of shape (3, 3); None if each is as good as another."""
    sine, cosine = C[0, 1] - C[1, 0], C[0, 0] + C[1, 1]
    length = math.hypot(sine, cosine)
    if length <= RANK_TOLERANCE * float(np.linalg.norm(C)) or length == 0:
        return None
    rotation = np.eye(3)
    rotation[:2, :2] = np.array([[cosine, -sine], [sine, cosine]]) / length
    return rotation


def _first_yaw_position(estimate: Poses, reference: Poses) -> Similarity:
    """Yaw and position of the first pose: C = R_estimate R_reference^T, as OpenVINS and rpg_trajectory_evaluation."""
    R_estimate, R_reference = (rotations_from_quats(poses.quats_xyzw[:1])[0] for poses in (estimate, reference))
    rotation = _best_yaw(R_estimate @ R_reference.T)
    if rotation is None:
        raise InvalidInput(
            "yaw cannot be determined: the first pose of the estimate is upside down against the ground truth",
            "check that z points up in both, or align over more poses",
        )
    return Similarity(1.0, rotation, reference.positions_m[0] - rotation @ estimate.positions_m[0])


def _first_pose(estimate: Poses, reference: Poses) -> Similarity:
    """The rigid transform that brings the first estimated pose onto its ground truth."""
    R_estimate, R_reference = (rotations_from_quats(poses.quats_xyzw[:1])[0] for poses in (estimate, reference))
    rotation = R_reference @ R_estimate.T
    return Similarity(1.0, rotation, reference.positions_m[0] - rotation @ estimate.positions_m[0])
