"""The KITTI odometry protocol: mean error over segments of 100 to 800 m.

Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite", CVPR 2012, and the
odometry devkit (``evaluate_odometry.cpp``). Its single precision is kept. In path lengths it decides where a segment
ends; in the arc cosine and in sums over all segments it changes the sixth digit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.domain.metrics.segments import KITTI_LENGTHS_M, KITTI_STEP
from slamhive.domain.protocol import Alignment, Association
from slamhive.errors import InvalidInput
from slamhive.evaluation.evaluators.base import (
    KITTI_ESTIMATE,
    KITTI_REFERENCE,
    MetricValues,
    Paired,
    absent,
)
from slamhive.evaluation.evaluators.pairs import IndexArray
from slamhive.trajectory.kitti import read_kitti_matrices
from slamhive.trajectory.model import FloatArray, Poses
from slamhive.trajectory.transforms import rotations_from_quats

_PARTS = ("translation", "rotation", "segments")
_SAME_POSITION_M = 1e-6
"""Positions of one pose in two files, written with different digits."""


@dataclass(frozen=True, slots=True, eq=False)
class KittiSegments:
    """Every segment: its nominal length in m, its errors as shares of that and in rad/m; shape (m,) each."""

    lengths_m: FloatArray
    translations: FloatArray
    rotations_radpm: FloatArray


class KittiProtocol:
    """Percent and degrees per metre, pooled and for each length."""

    keys = (
        "kitti.translation",
        "kitti.rotation",
        "kitti.segments",
        *(f"kitti.{part}.{length_m}m" for length_m in KITTI_LENGTHS_M for part in _PARTS),
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """Every pose of the ground truth needs one of the estimate, by time or, as in the devkit, by index."""
        if not paired.rotations_known:
            return absent(self.keys, paired.rotations_unknown)
        _check_complete(paired)
        found = kitti_segments(*(_published(paired) or map(_matrices, (paired.matched_reference, paired.aligned))))
        if len(found.lengths_m) == 0:
            path_m = paired.matched_reference.path_length_m
            shortest = f"the path is {path_m:.4g} m, the shortest segment {KITTI_LENGTHS_M[0]} m"
            return absent(self.keys, shortest)
        values = _means("", found, np.ones(len(found.lengths_m), dtype=bool))
        missing: dict[str, str] = {}
        for length_m in KITTI_LENGTHS_M:
            of_length = found.lengths_m == length_m
            if of_length.any():
                values |= _means(f".{length_m}m", found, of_length)
            else:
                reason = f"no segment is {length_m} m long"
                missing |= {f"kitti.{part}.{length_m}m": reason for part in _PARTS}
        return MetricValues(values, missing)


def kitti_segments(T_reference: FloatArray, T_estimate: FloatArray) -> KittiSegments:
    """The segments from every tenth pose, each to the first pose further along the path than its length.

    ``calcSequenceErrors`` of the devkit: E = (P_f^-1 P_l)^-1 (Q_f^-1 Q_l), |t| / L and acos((tr R - 1) / 2) / L.
    Matrices that are not quite orthonormal, as those of KITTI's files with their seven digits, are taken as they are.

    Args:
        T_reference: Poses Q, shape (n, 4, 4).
        T_estimate: Poses P, one for each of them.
    """
    firsts, lasts, lengths_m = _segment_ends(T_reference[:, :3, 3])
    true = np.linalg.inv(T_reference[firsts]) @ T_reference[lasts]
    estimated = np.linalg.inv(T_estimate[firsts]) @ T_estimate[lasts]
    errors = (np.linalg.inv(estimated) @ true).astype(np.float32)
    translations_m = np.linalg.norm(errors[:, :3, 3], axis=1)
    traces = errors[:, 0, 0] + errors[:, 1, 1] + errors[:, 2, 2]
    cosines = np.clip((0.5 * (traces.astype(np.float64) - 1.0)).astype(np.float32), -1.0, 1.0)
    angles_rad = np.arccos(cosines).astype(np.float64)
    return KittiSegments(lengths_m, translations_m.astype(np.float64) / lengths_m, angles_rad / lengths_m)


def _segment_ends(positions_m: FloatArray) -> tuple[IndexArray, IndexArray, FloatArray]:
    path_m = _path_m(positions_m)
    firsts = np.arange(0, len(positions_m), KITTI_STEP)
    lengths_m = np.array(KITTI_LENGTHS_M, dtype=np.float32)
    ends_m = path_m[firsts, None] + lengths_m
    lasts = np.searchsorted(path_m, ends_m, side="right")
    kept = lasts < len(positions_m)
    all_firsts = np.broadcast_to(firsts[:, None], kept.shape)
    all_lengths_m = np.broadcast_to(np.array(KITTI_LENGTHS_M, dtype=np.float64), kept.shape)
    return all_firsts[kept], lasts[kept], all_lengths_m[kept]


def _path_m(positions_m: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
    """Path length to each pose, accumulated in single precision as by ``trajectoryDistances`` of the devkit."""
    steps_m = np.linalg.norm(np.diff(positions_m, axis=0).astype(np.float32), axis=1)
    return np.concatenate((np.zeros(1, dtype=np.float32), np.cumsum(steps_m, dtype=np.float32)))


def _matrices(poses: Poses) -> FloatArray:
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :3, :3] = rotations_from_quats(poses.quats_xyzw)
    matrices[:, :3, 3] = poses.positions_m
    return matrices


def _published(paired: Paired) -> tuple[FloatArray, FloatArray] | None:
    """The poses of both as their KITTI files have them, if both come from one and nothing has moved them since.

    Their matrices have seven digits, and the devkit takes what is left of them to orthonormality for rotation.
    """
    protocol, files = paired.protocol, paired.files
    moved = protocol.alignment is not Alignment.NONE or not np.array_equal(paired.T_body_estimate, np.eye(4))
    if moved or protocol.association is not Association.INDEX or protocol.reference is not None:
        return None
    if KITTI_REFERENCE not in files or KITTI_ESTIMATE not in files:
        return None
    return _as_in(files[KITTI_REFERENCE], paired.matched_reference), _as_in(files[KITTI_ESTIMATE], paired.aligned)


def _as_in(path: Path, poses: Poses) -> FloatArray:
    """The matrices in the file at ``path``; raises InvalidInput if they are not those of the poses."""
    matrices = read_kitti_matrices(path)
    if len(matrices) != len(poses) or np.abs(matrices[:, :3, 3] - poses.positions_m).max() > _SAME_POSITION_M:
        raise InvalidInput(f"{path.name} does not hold the poses of the trajectory", "import it again")
    return matrices


def _means(suffix: str, found: KittiSegments, chosen: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> dict[str, float]:
    return {
        f"kitti.translation{suffix}": 100.0 * mean_as_devkit(found.translations[chosen]),
        f"kitti.rotation{suffix}": float(np.rad2deg(mean_as_devkit(found.rotations_radpm[chosen]))),
        f"kitti.segments{suffix}": float(np.count_nonzero(chosen)),
    }


def mean_as_devkit(errors: FloatArray) -> float:
    """Summed one after the other in single precision, as ``saveStats`` of the devkit does."""
    return float(np.cumsum(errors, dtype=np.float32)[-1]) / len(errors)


def _check_complete(paired: Paired) -> None:
    frames = len(paired.reference)
    matched = len(np.unique(paired.matched_reference.stamps_s))
    if matched == frames:
        return
    how = "by index" if paired.protocol.association is Association.INDEX else "by time"
    raise InvalidInput(
        f"the KITTI protocol takes a pose for every one of the ground truth: {matched} of {frames} are matched {how}",
        "compare at the frames' rate, or see the segment errors, which do not need every pose",
    )
