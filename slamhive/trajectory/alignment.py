"""Alignment: the transform onto the ground truth, and the one between the frames of two trajectories of one body."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment
from slamhive.trajectory.model import FloatArray, Poses, Trajectory
from slamhive.trajectory.transforms import (
    inverse_quats,
    multiply_quats,
    quats_from_rotations,
    rotation_angles_rad,
    rotations_from_quats,
)

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
        # C = R_estimate R_reference^T, as OpenVINS and rpg_trajectory_evaluation.
        R_estimate, R_reference = (rotations_from_quats(poses.quats_xyzw[:1])[0] for poses in (estimate, reference))
        turn = _best_yaw(R_estimate @ R_reference.T)
        if turn is None:
            raise InvalidInput(
                "yaw cannot be determined: the first pose of the estimate is upside down against the ground truth",
                "check that z points up in both, or align over more poses",
            )
        return Similarity(1.0, turn, reference.positions_m[0] - turn @ estimate.positions_m[0])
    count = len(estimate) if first is None else min(first, len(estimate))
    if count < MINIMUM_POSES[alignment]:
        raise InvalidInput(
            f"the alignment {alignment} needs at least {MINIMUM_POSES[alignment]} matched poses, there are {count}",
            "choose another alignment, or a run that tracked more",
        )
    if alignment is Alignment.NONE:
        return IDENTITY
    if alignment is Alignment.FIRST_POSE:
        R_estimate, R_reference = (rotations_from_quats(poses.quats_xyzw[:1])[0] for poses in (estimate, reference))
        rotation = R_reference @ R_estimate.T
        return Similarity(1.0, rotation, reference.positions_m[0] - rotation @ estimate.positions_m[0])
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


# The constant transform between the frames of two trajectories of one body: rotation, lever arm, how sure they are.
#
# An antenna, a prism, a camera and an IMU on one body follow different paths. Which of them a file describes is often
# not stated, so the transform is fitted to the matched poses together with the alignment of the worlds.


_ITERATIONS = 20
_HALVINGS = 12
"""So often a step is halved that makes the error larger; the fit ends where none makes it smaller."""
_CONVERGED = 1e-10
_SINGULAR = 1e-9
"""Directions of the lever arm stay 0 and open below this share of the information that a known world would give.

The share is about the mean square of the turning: the body has turned by less than 0.002 deg.
"""


@dataclass(frozen=True, slots=True, eq=False)
class FrameOffset:
    """The constant pose of the frame of the estimate in the frame that the ground truth describes.

    Attributes:
        rotation: R_truth_estimate, shape (3, 3); the identity where orientations are not known.
        rotation_sigma_deg: Standard error of that rotation; None where orientations are not known.
        spread_deg: Median deviation of single orientations from it; None where orientations are not known.
        arm_m: Position of the frame of the estimate in that of the ground truth, shape (3,). Where the ground truth has
            no orientations, the position of the measured point in the frame of the estimate.
        arm_sigma_m: Standard errors of its three numbers, shape (3,). Infinite where a part of the arm is open and 0:
            along the only axis that the body turns about, and along each axis if it does not turn.
        world: Aligns the estimate, with the arm taken into account.
        before_m: RMSE of the positions without an arm, under the same freedom of the alignment.
        after_m: The same with the arm.
    """

    rotation: FloatArray
    rotation_sigma_deg: float | None
    spread_deg: float | None
    arm_m: FloatArray
    arm_sigma_m: FloatArray
    world: Similarity
    before_m: float
    after_m: float

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation."""
        return math.degrees(math.acos(max(-1.0, min(1.0, (float(np.trace(self.rotation)) - 1.0) / 2.0))))

    @property
    def arm_length_m(self) -> float:
        """Length of the arm."""
        return float(np.linalg.norm(self.arm_m))

    @property
    def arm_length_sigma_m(self) -> float:
        """Standard error of that length, over the axes that are determined."""
        known = np.where(np.isfinite(self.arm_sigma_m), self.arm_sigma_m, 0.0)
        length_m = self.arm_length_m
        return float(np.linalg.norm(known) if length_m == 0 else np.linalg.norm(known * self.arm_m) / length_m)


def fit_offset(reference: Poses, estimate: Poses, *, oriented: bool, scaled: bool, arm: bool = True) -> FrameOffset:
    """The transform between the frames of matched poses, by least squares together with the alignment of the worlds.

    With orientations of the ground truth Q = (R, q), the arm l minimises the sum of |q_i + R_i l - (s W p_i + t)|^2.
    The world's alignment (s, W, t) is free as well; the method is Gauss-Newton, with a shorter step where a whole one
    would make the sum larger. Without orientations, the arm is added to the estimate instead:
    |q_i - W (p_i + R_i l) - t|^2, with the orientations R_i of the estimate. The rotation is the mean (Markley et al.,
    JGCD 2007) of R_i^T W times the estimated orientation. Standard errors are those of the residuals, times the square
    root of their correlation time: neighbouring errors of odometry are alike, and count as one.

    Args:
        reference: Matched poses of the ground truth, n of them.
        estimate: Matched poses of the estimate, n of them; their orientations mean something.
        oriented: The orientations of the ground truth mean something too.
        scaled: The scale of the world is free; not possible without ``oriented``, where an arm is in metres.
        arm: Fit an arm, or the rotation alone.

    Raises:
        InvalidInput: The positions do not determine the alignment.
    """
    world = align_umeyama(estimate.positions_m, reference.positions_m, scaled=scaled)
    before_m = _rms(_residuals(reference, estimate, world, np.zeros(3), oriented=oriented))
    arm_m, arm_sigma_m, after_m = np.zeros(3), np.zeros(3), before_m
    if arm:
        if scaled and not oriented:
            raise InvalidInput(
                "a lever arm cannot be fitted where the scale is open and the ground truth holds positions only",
                "use se3, if the estimate is in metres",
            )
        world, arm_m, arm_sigma_m = _fit_arm(reference, estimate, world, oriented=oriented, scaled=scaled)
        after_m = _rms(_residuals(reference, estimate, world, arm_m, oriented=oriented))
    if not oriented:
        return FrameOffset(np.eye(3), None, None, arm_m, arm_sigma_m, world, before_m, after_m)
    turned = multiply_quats(quats_from_rotations(world.rotation[None]), estimate.quats_xyzw)
    between = multiply_quats(inverse_quats(reference.quats_xyzw), turned)
    _, vectors = np.linalg.eigh(between.T @ between)
    mean = vectors[None, :, -1]
    apart_deg = np.rad2deg(rotation_angles_rad(np.repeat(mean, len(between), axis=0), between))
    sigma_deg = float(np.sqrt(np.mean(apart_deg**2) * _correlation(apart_deg[:, None]) / len(apart_deg)))
    rotation = rotations_from_quats(mean)[0]
    return FrameOffset(rotation, sigma_deg, float(np.median(apart_deg)), arm_m, arm_sigma_m, world, before_m, after_m)


def _fit_arm(
    reference: Poses, estimate: Poses, world: Similarity, *, oriented: bool, scaled: bool
) -> tuple[Similarity, FloatArray, FloatArray]:
    """World, arm and the arm's standard errors by Gauss-Newton from ``world`` and no arm."""
    arm_m = np.zeros(3)
    information = np.eye(3)
    # Each derivative by the arm is a rotation, so this is what every direction gave, were the world known.
    least = _SINGULAR * len(reference)
    for _ in range(_ITERATIONS):
        residuals = _residuals(reference, estimate, world, arm_m, oriented=oriented)
        # The derivative of the residuals by the arm, (n, 3, 3), and the moved positions of the estimate, (n, 3).
        if oriented:
            by_arm, moved = rotations_from_quats(reference.quats_xyzw), world.points(estimate.positions_m)
        else:
            rotations = rotations_from_quats(estimate.quats_xyzw)
            by_arm = -world.rotation @ rotations
            moved = world.points(estimate.positions_m + rotations @ arm_m)
        by_world = np.zeros((len(reference), 3, 7 if scaled else 6))
        by_world[:, :, :3] = _cross(moved - world.translation_m)
        by_world[:, :, 3:6] = -np.eye(3)
        if scaled:
            by_world[:, :, 6] = world.translation_m - moved
        A, B = by_world.reshape(len(reference) * 3, -1), by_arm.reshape(-1, 3)
        # The world is eliminated: what is left is the information about the arm alone.
        basis, _ = np.linalg.qr(A)
        left = B - basis @ (basis.T @ B)
        information = left.T @ left
        inverse, _ = _inverse(information, least)
        step = -inverse @ (left.T @ residuals.ravel())
        others = -np.linalg.lstsq(A, residuals.ravel() + B @ step, rcond=None)[0]
        before_m = _rms(residuals)
        # Far from the minimum a whole step may lead away from it, and the next one further.
        for share in 0.5 ** np.arange(_HALVINGS):
            tried = _updated(world, share * np.asarray(others, dtype=np.float64)), arm_m + share * step
            if _rms(_residuals(reference, estimate, *tried, oriented=oriented)) <= before_m:
                break
        else:
            break
        world, arm_m = tried
        if np.linalg.norm(step) <= _CONVERGED * (1.0 + np.linalg.norm(arm_m)):
            break
    residuals = _residuals(reference, estimate, world, arm_m, oriented=oriented)
    variance = float(np.mean(residuals**2)) * _correlation(residuals)
    inverse, open_ = _inverse(information, least)
    sigma_m = np.sqrt(variance * np.diag(inverse))
    sigma_m[(open_**2).sum(axis=1) > _SINGULAR] = np.inf
    return world, arm_m, sigma_m


def _updated(world: Similarity, update: FloatArray) -> Similarity:
    """The world after an update: a rotation vector on the left of its rotation, a translation, and a scale if open."""
    angle = float(np.linalg.norm(update[:3]))
    axis = update[:3] / angle if angle > 0 else np.zeros(3)
    change = np.append(axis * math.sin(angle / 2), math.cos(angle / 2))[None]
    rotation = rotations_from_quats(multiply_quats(change, quats_from_rotations(world.rotation[None])))[0]
    scale = world.scale * (1.0 + float(update[6])) if len(update) > 6 else world.scale
    return Similarity(scale, rotation, world.translation_m + update[3:6])


def _inverse(information: FloatArray, least: float) -> tuple[FloatArray, FloatArray]:
    """Inverse of the information in the directions that have more than ``least``; the others, shape (3, k)."""
    values, vectors = np.linalg.eigh(information)
    known = values > least
    return (vectors[:, known] / values[known]) @ vectors[:, known].T, vectors[:, ~known]


def _residuals(
    reference: Poses, estimate: Poses, world: Similarity, arm_m: FloatArray, *, oriented: bool
) -> FloatArray:
    if oriented:
        truth_m = reference.positions_m + rotations_from_quats(reference.quats_xyzw) @ arm_m
        return np.asarray(truth_m - world.points(estimate.positions_m))
    moved_m = estimate.positions_m + rotations_from_quats(estimate.quats_xyzw) @ arm_m
    return np.asarray(reference.positions_m - world.points(moved_m))


def _cross(vectors: FloatArray) -> FloatArray:
    """Matrices [v]x, shape (n, 3, 3), of vectors (n, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _correlation(errors: FloatArray) -> float:
    """Number of neighbouring errors, shape (n, k), that count as one: 1 + 2 sum of autocorrelations, up to a 0."""
    centred = errors - errors.mean(axis=0)
    power = float((centred**2).sum())
    if power == 0:
        return 1.0
    total = 1.0
    for lag in range(1, len(centred) // 2):
        rho = float((centred[lag:] * centred[:-lag]).sum()) / power
        if rho <= 0:
            break
        total += 2.0 * rho
    return total


def _rms(vectors_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors_m**2, axis=1))))
