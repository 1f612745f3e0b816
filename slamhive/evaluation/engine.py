"""One evaluation: evo's own code computes the errors, and this module feeds it.

What evo lacks is our own: yaw + position alignment, the rank check by ratio, and completeness. Runs in the
evaluation process or container only; nothing else imports evo.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import evo
import numpy as np
from evo.core import filters, sync
from evo.core.geometry import GeometryException
from evo.core.metrics import PoseRelation, Unit
from evo.core.result import Result
from evo.core.trajectory import PoseTrajectory3D
from evo.main_ape import ape
from evo.main_rpe import rpe

from slamhive.domain.protocol import ALIGNMENT_LABELS, Alignment, Protocol
from slamhive.errors import InvalidInput, NotFound
from slamhive.evaluation.job import EvaluationResult, EvaluationTask, failed_result
from slamhive.evaluation.references import References
from slamhive.trajectory.alignment import align_yaw_position, check_rank
from slamhive.trajectory.completeness import measure_completeness
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.tum import parse_tum

logger = logging.getLogger(__name__)

ENGINE = f"evo {evo.__version__.removeprefix('v')}"
MINIMUM_MATCHED_POSES = 3
"""With fewer an alignment is arbitrary, and so is every figure after it."""

REFERENCE_NAME = "groundtruth"
ESTIMATE_NAME = "estimate"


@dataclass(frozen=True, slots=True)
class Evaluated:
    """What an evaluation computed, before anything is written.

    Attributes:
        result: The figures.
        reference: The whole ground truth in the estimate's frame.
        aligned: The matched poses of the estimate, aligned.
        matched: The matched poses of the ground truth, one for each of ``aligned``.
        ape: evo's result, with the error of each matched pose.
        rpe: evo's result and the trajectories reduced to the pairs' ends; None if no pair is a delta apart.
    """

    result: EvaluationResult
    reference: Trajectory
    aligned: PoseTrajectory3D
    matched: PoseTrajectory3D
    ape: Result
    rpe: Result | None


def evaluate(task: EvaluationTask, references: References) -> Evaluated | EvaluationResult:
    """Compute the figures of ``task``; an EvaluationResult with a reason if they cannot be computed."""
    poses = matched_poses = 0
    try:
        reference = references.of(task)
        estimate = _read_estimate(task)
        poses = len(estimate)
        completeness = measure_completeness(estimate.stamps_s, reference.stamps_s, task.protocol.gap_threshold_s)
        matched, aligned = _associate(reference, estimate, task.protocol)
        matched_poses = matched.num_poses
        ape_result, scale = _absolute_error(matched, aligned, task.protocol)
        rpe_result = _relative_error(matched, aligned, task.protocol)
    except InvalidInput as error:
        return failed_result(task, str(error), ENGINE, poses=poses, matched_poses=matched_poses)
    figures = {f"ate.{name}": float(value) for name, value in ape_result.stats.items()}
    if rpe_result is not None:
        figures |= {f"rpe.{name}": float(value) for name, value in rpe_result.stats.items()}
    figures |= {
        "tracked_fraction": completeness.tracked_fraction,
        "gap.max": completeness.longest_gap_s,
        "gap.count": float(completeness.gap_count),
        "alignment.scale": scale,
    }
    not_finite = [key for key, value in figures.items() if not math.isfinite(value)]
    if not_finite:
        reason = f"{', '.join(not_finite)} cannot be computed: the estimate is too far off for the numbers to hold"
        return failed_result(task, reason, ENGINE, poses=poses, matched_poses=matched_poses)
    result = EvaluationResult(task.id, task.protocol.fingerprint, None, figures, poses, matched_poses, ENGINE)
    return Evaluated(result, reference, aligned, matched, ape_result, rpe_result)


def _read_estimate(task: EvaluationTask) -> Trajectory:
    if task.estimate.is_symlink():
        raise InvalidInput(f"the estimate {task.estimate.name} is a link, which is not followed")
    try:
        return parse_tum(read_bounded(task.estimate), f"estimate {task.estimate.name}")
    except NotFound:
        raise InvalidInput(f"there is no estimate: {task.estimate.name} does not exist") from None


def _associate(
    reference: Trajectory, estimate: Trajectory, protocol: Protocol
) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    """Matched poses of ground truth and estimate by evo's nearest-time association."""
    try:
        matched, aligned = sync.associate_trajectories(
            _to_evo(reference, REFERENCE_NAME),
            _to_evo(estimate, ESTIMATE_NAME),
            max_diff=protocol.association_tolerance_s,
        )
    except sync.SyncException:
        raise _no_match(reference, estimate, protocol.association_tolerance_s) from None
    if matched.num_poses < MINIMUM_MATCHED_POSES:
        raise InvalidInput(
            f"only {matched.num_poses} of {len(estimate)} estimated poses match the ground truth in time, "
            f"at least {MINIMUM_MATCHED_POSES} are needed",
            "the run tracked too little, or the association tolerance is too small",
        )
    return matched, aligned


def _to_evo(trajectory: Trajectory, name: str) -> PoseTrajectory3D:
    quats_wxyz = np.roll(trajectory.quats_xyzw, 1, axis=1)
    return PoseTrajectory3D(trajectory.positions_m, quats_wxyz, trajectory.stamps_s, name=name)


def _no_match(reference: Trajectory, estimate: Trajectory, tolerance_s: float) -> InvalidInput:
    spans = (
        f"estimate {estimate.stamps_s[0]:.3f} to {estimate.stamps_s[-1]:.3f} s, "
        f"ground truth {reference.stamps_s[0]:.3f} to {reference.stamps_s[-1]:.3f} s"
    )
    apart = estimate.stamps_s[0] > reference.stamps_s[-1] or estimate.stamps_s[-1] < reference.stamps_s[0]
    if apart:
        return InvalidInput(f"estimate and ground truth do not overlap in time: {spans}", "use the same clock for both")
    return InvalidInput(
        f"no estimated pose is within {tolerance_s:g} s of a ground-truth pose: {spans}",
        "raise the association tolerance, or use a denser ground truth",
    )


def _absolute_error(matched: PoseTrajectory3D, aligned: PoseTrajectory3D, protocol: Protocol) -> tuple[Result, float]:
    """Align the estimate in place and take evo's APE of it; also the scale that was applied."""
    alignment = protocol.alignment
    by_umeyama = alignment in {Alignment.SE3, Alignment.SIM3}
    own_transform = None
    if by_umeyama:
        check_rank(aligned.positions_xyz, matched.positions_xyz)
    elif alignment is Alignment.YAW_POSITION:
        own_transform = align_yaw_position(aligned.positions_xyz, matched.positions_xyz)
        aligned.transform(own_transform)
    try:
        result = ape(
            matched,
            aligned,
            PoseRelation.translation_part,
            align=by_umeyama,
            correct_scale=alignment is Alignment.SIM3,
        )
    except (GeometryException, np.linalg.LinAlgError) as error:
        raise InvalidInput(
            f"alignment is not possible over the {matched.num_poses} matched poses: {error}",
            "choose another alignment, or a run that moves",
        ) from None
    result.trajectories.clear()
    if own_transform is not None:
        result.add_np_array("alignment_transformation_sim3", own_transform)
        result.info["title"] = result.info["title"].replace("(not aligned)", _aligned_words(alignment))
    if alignment is not Alignment.SIM3:
        return result, 1.0
    scaled_rotation = result.np_arrays["alignment_transformation_sim3"][:3, :3]
    return result, float(np.cbrt(np.linalg.det(scaled_rotation)))


def _relative_error(matched: PoseTrajectory3D, aligned: PoseTrajectory3D, protocol: Protocol) -> Result | None:
    """RPE by evo, translation part, over all pairs ``rpe_delta_m`` of estimated path apart; None if there is no pair.

    evo reduces the trajectories it is given to the pairs' ends, so it gets its own, which share the pose matrices.
    """
    try:
        result = rpe(
            _sharing(matched),
            _sharing(aligned),
            PoseRelation.translation_part,
            delta=protocol.rpe_delta_m,
            delta_unit=Unit.meters,
            all_pairs=True,
        )
    except filters.FilterException:
        logger.info("no pair of poses is %g m of path apart: RPE is left out", protocol.rpe_delta_m)
        return None
    title = result.info["title"]
    result.info["title"] = title.replace("(not aligned)", _aligned_words(protocol.alignment))
    return result


def _sharing(trajectory: PoseTrajectory3D) -> PoseTrajectory3D:
    return PoseTrajectory3D(
        trajectory.positions_xyz,
        poses_se3=trajectory.poses_se3,
        timestamps=trajectory.timestamps,
        name=trajectory.name,
    )


def _aligned_words(alignment: Alignment) -> str:
    if alignment is Alignment.NONE:
        return "(not aligned)"
    if alignment is Alignment.YAW_POSITION:
        return f"(with {ALIGNMENT_LABELS[alignment]} alignment)"
    return f"(with {ALIGNMENT_LABELS[alignment]} Umeyama alignment)"
