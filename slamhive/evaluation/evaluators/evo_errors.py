"""ATE and RPE: evo's own code, fed with a pair that is aligned already."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from evo.core import filters
from evo.core.metrics import RPE, PoseRelation, StatisticsType, Unit
from evo.core.result import Result
from evo.core.trajectory import PoseTrajectory3D
from evo.main_ape import ape
from evo.main_rpe import rpe

from slamhive.domain.protocol import ALIGNMENT_LABELS, Alignment, Protocol, RpePairs
from slamhive.evaluation.evaluators.base import MetricValues, Paired, absent
from slamhive.evaluation.evaluators.relative import compare, relative_errors, statistics
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import rotation_angles_rad, rotations_from_quats

REFERENCE_NAME = "groundtruth"
ESTIMATE_NAME = "estimate"

_BY_UMEYAMA = {Alignment.SE3, Alignment.SIM3}


def error_keys(prefix: str) -> tuple[str, ...]:
    """The metric keys of evo's statistics of one error."""
    return tuple(f"{prefix}.{statistic.value}" for statistic in StatisticsType)


class AbsoluteError:
    """ATE: the distance between matched positions."""

    keys = error_keys("ate")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Needs no orientations."""
        reference, aligned = evo_pair(paired)
        result = ape(reference, aligned, PoseRelation.translation_part)
        result.trajectories.clear()
        if paired.protocol.alignment is not Alignment.NONE:
            result.add_np_array("alignment_transformation_sim3", paired.transform.matrix)
        return error_statistics("ate", result, paired.protocol, archive="ape")


class RelativeError:
    """RPE over pairs of poses a given length of estimated path apart: the translation part."""

    keys = (*error_keys("rpe"), "rpe.pairs")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing where no pair is the delta apart."""
        if not paired.rotations_known:
            return absent(self.keys, paired.rotations_unknown)
        protocol = paired.protocol
        result = _as_tum(paired) if protocol.rpe_pairs is RpePairs.TUM else _as_evo(paired)
        if result is None:
            return absent(self.keys, f"no pair of poses is {protocol.rpe_delta_m:g} m of path apart")
        found = error_statistics("rpe", result, protocol, archive="rpe")
        number = float(len(result.np_arrays["error_array"]))
        return MetricValues({**found.values, "rpe.pairs": number}, archives=found.archives)


def _as_evo(paired: Paired) -> Result | None:
    """The result of evo over its own pairs of the matched poses; None where there is no pair."""
    protocol = paired.protocol
    reference, aligned = evo_pair(paired)
    try:
        # evo reduces these trajectories to the pairs' ends.
        return rpe(
            reference,
            aligned,
            PoseRelation.translation_part,
            delta=protocol.rpe_delta_m,
            delta_unit=Unit.meters,
            all_pairs=protocol.rpe_pairs is RpePairs.ALL,
        )
    except filters.FilterException:
        return None


def _as_tum(paired: Paired) -> Result | None:
    """The same over the pairs of TUM's script, which evo does not know."""
    compared = compare(paired)
    (last, first), _ = compared.pairs("")
    if len(last) == 0:
        return None
    metric = RPE(PoseRelation.translation_part, paired.protocol.rpe_delta_m, Unit.meters, all_pairs=True)
    metric.error, _ = relative_errors(compared.reference, compared.estimate, (last, first))
    result = metric.get_result(REFERENCE_NAME, ESTIMATE_NAME)
    ends = np.concatenate(([0], last))  # the first pose is there for drawing, as evo has it
    for name, poses in ((REFERENCE_NAME, compared.reference), (ESTIMATE_NAME, compared.estimate)):
        taken = poses.take(ends)
        result.add_trajectory(name, _to_evo(taken, _pose_matrices(taken), name))
    stamps_s = compared.estimate.stamps_s
    result.add_np_array("seconds_from_start", stamps_s[last] - stamps_s[0])
    result.add_np_array("timestamps", stamps_s[last])
    return result


def error_statistics(prefix: str, result: Result, protocol: Protocol, archive: str) -> MetricValues:
    """The statistics of evo's ``result`` as metrics ``<prefix>.<statistic>``, and the result as an archive."""
    # The poses are aligned before evo gets them, so its title says that they are not.
    if protocol.alignment is not Alignment.NONE:
        method = " Umeyama" if protocol.alignment in _BY_UMEYAMA else ""
        words = f"(with {ALIGNMENT_LABELS[protocol.alignment]}{method} alignment)"
        result.info["title"] = result.info["title"].replace("(not aligned)", words)
    values = {f"{prefix}.{name}": float(value) for name, value in result.stats.items()}
    return MetricValues(values, archives={archive: result})


def evo_pair(paired: Paired) -> tuple[PoseTrajectory3D, PoseTrajectory3D]:
    """The matched ground truth and the aligned estimate as evo has them.

    Each call makes new trajectories, which evo may reduce; the pose matrices, which it may not change, are shared.
    """
    reference, aligned = _matrices(paired)
    return (
        _to_evo(paired.matched_reference, reference, REFERENCE_NAME),
        _to_evo(paired.aligned, aligned, ESTIMATE_NAME),
    )


@lru_cache(maxsize=1)
def _matrices(paired: Paired) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """For the pair that is being evaluated, by its identity."""
    return _pose_matrices(paired.matched_reference), _pose_matrices(paired.aligned)


def _pose_matrices(poses: Poses) -> list[np.ndarray]:
    matrices = np.zeros((len(poses), 4, 4))
    matrices[:, :3, :3] = rotations_from_quats(poses.quats_xyzw)
    matrices[:, :3, 3] = poses.positions_m
    matrices[:, 3, 3] = 1.0
    return list(matrices)


def _to_evo(poses: Poses, matrices: list[np.ndarray], name: str) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses.positions_m, poses_se3=matrices, timestamps=poses.stamps_s, name=name)


# Absolute errors besides those that evo computes: of orientations, and in relation to the path.


_NAMES = ("rmse", "mean", "median", "max")


class RotationError:
    """ATE, rotation part: evo's APE with ``angle_deg``."""

    keys = tuple(f"ate_rot.{name}" for name in _NAMES)

    def evaluate(self, paired: Paired) -> MetricValues:
        """Needs the orientations of the ground truth."""
        if not paired.rotations_known:
            return absent(self.keys, paired.rotations_unknown)
        errors_rad = rotation_angles_rad(paired.matched_reference.quats_xyzw, paired.aligned.quats_xyzw)
        return MetricValues(statistics("ate_rot", np.rad2deg(errors_rad), _NAMES))


class RelativeSize:
    """ATE RMSE in percent of the true path, and of the error of an estimate that never moves."""

    keys = ("ate.per_path", "ate.per_extent")

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the ground truth does not move.

        Both are needed. In a room the error under Sim(3) never exceeds the extent, which is a few percent of a long
        path within four walls. On a road the extent is as large as the path.
        """
        truth = paired.matched_reference.positions_m
        error_m = _rms(paired.aligned.positions_m - truth)
        stamps_s = paired.matched_reference.stamps_s
        covered = (paired.reference.stamps_s >= stamps_s[0]) & (paired.reference.stamps_s <= stamps_s[-1])
        path_m = paired.reference.take(np.flatnonzero(covered)).path_length_m
        sizes_m = {"ate.per_path": path_m, "ate.per_extent": _rms(truth - truth.mean(axis=0))}
        values = {key: 100.0 * error_m / size_m for key, size_m in sizes_m.items() if size_m > 0}
        missing = {key: "the ground truth does not move" for key in self.keys if key not in values}
        return MetricValues(values, missing)


def _rms(vectors_m: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors_m**2, axis=1))))
