"""Errors against measured relations between poses, with or without a ground-truth trajectory.

Kuemmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27, 2009; the relations are
those that the Freiburg benchmark publishes beside recordings of 2D lasers.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.verdict import RELATION_ERROR_PER_MOTION
from slamhive.evaluation.evaluators.base import RELATIONS, MetricValues, Paired, absent
from slamhive.evaluation.evaluators.relative import statistics
from slamhive.trajectory.completeness import covers
from slamhive.trajectory.model import FloatArray, Trajectory, lacking
from slamhive.trajectory.table import parse_table, read_bounded
from slamhive.trajectory.transforms import (
    interpolate,
    inverse_quats,
    move_sensor,
    multiply_quats,
    rotation_angles_rad,
    rotations_from_quats,
)

LAYOUT = "timestamp1 timestamp2 x y z roll pitch yaw"
_WHOLE_TURN_RAD = 6.2832
_NAMES = ("rmse", "mean", "std", "max")


@dataclass(frozen=True, slots=True, eq=False)
class Relations:
    """Poses of the body at one time, relative to its pose at another.

    Attributes:
        from_s: Times of the poses that are the origin, shape (n,).
        to_s: Times of the poses that are described, shape (n,).
        positions_m: Shape (n, 3).
        quats_xyzw: Shape (n, 4).
    """

    from_s: FloatArray
    to_s: FloatArray
    positions_m: FloatArray
    quats_xyzw: FloatArray


class RelationErrors:
    """Translational and rotational error of the relations."""

    keys = (
        *(f"relations.{part}.{name}" for part in ("translation", "rotation") for name in _NAMES),
        RELATION_ERROR_PER_MOTION,
        "relations.matched_fraction",
    )

    def evaluate(self, paired: Paired) -> MetricValues:
        """Missing if the dataset has no relations."""
        path = paired.files.get(RELATIONS)
        if path is None:
            return absent(self.keys, "the dataset has no relations")
        body = of_body(paired.estimate, paired.transform.scale, paired.T_body_estimate)
        return MetricValues(relation_errors(read_relations(path), body, paired.protocol.gap_threshold_s))


def of_body(estimate: Trajectory, scale: float, T_body_estimate: FloatArray) -> Trajectory:
    """The body's trajectory from that of the sensor that the estimate describes.

    Args:
        estimate: In its own world, whose unit is the metre once it is scaled.
        scale: What to scale it by.
        T_body_estimate: Pose of the sensor in the body frame, shape (4, 4).
    """
    if scale != 1:
        estimate = Trajectory(estimate.stamps_s, scale * estimate.positions_m, estimate.quats_xyzw)
    if np.array_equal(T_body_estimate, np.eye(4)):
        return estimate
    return move_sensor(estimate, np.asarray(np.linalg.inv(T_body_estimate)))


def read_relations(path: Path) -> Relations:
    """Read a file of relations, angles in rad; raises InvalidInput naming the line."""
    try:
        data = read_bounded(path)
    except NotFound:
        raise InvalidInput(f"the relations {path.name} do not exist", "put the dataset's file back") from None
    return parse_relations(data, f"relations {path.name}")


def parse_relations(data: bytes, name: str) -> Relations:
    """The relations in the bytes of a file that messages call ``name``; raises InvalidInput naming the line."""
    table = parse_table(data, name, 8, LAYOUT)
    finite = np.isfinite(table.values).all(axis=1)
    if not finite.all():
        raise table.error(int((~finite).argmax()), "a number is not finite", "leave the relation out")
    largest_rad = np.abs(table.values[:, 5:8]).max(axis=1)
    if largest_rad.max() > _WHOLE_TURN_RAD:
        row = int(largest_rad.argmax())
        raise table.error(row, f"an angle of {largest_rad[row]:g} is more than a turn", "write radians, not degrees")
    # Angles are roll, pitch and yaw: R = Rz(yaw) Ry(pitch) Rx(roll).
    half = table.values[:, 5:8] / 2.0
    axes = []
    for axis in range(3):
        quats = np.zeros((len(half), 4))
        quats[:, axis], quats[:, 3] = np.sin(half[:, axis]), np.cos(half[:, axis])
        axes.append(quats)
    roll, pitch, yaw = axes
    return Relations(
        table.values[:, 0], table.values[:, 1], table.values[:, 2:5], multiply_quats(yaw, multiply_quats(pitch, roll))
    )


def relation_errors(relations: Relations, estimate: Trajectory, gap_s: float) -> dict[str, float]:
    """Mean, spread and maximum of the errors over the relations whose times the estimate covers.

    Args:
        relations: What was measured.
        estimate: What was estimated of the body, in m, on the same clock.
        gap_s: Between poses further apart the estimate is not interpolated.

    Raises:
        InvalidInput: The estimate covers no relation, or has no orientations.
    """
    without = lacking(estimate.quats_xyzw, estimate.positions_m)
    if without:
        raise InvalidInput(f"relations need orientations, but of the estimate {without}", "give an estimate with them")
    covered = covers(estimate.stamps_s, relations.from_s, gap_s) & covers(estimate.stamps_s, relations.to_s, gap_s)
    if not covered.any():
        raise InvalidInput(
            f"the estimate has no poses at the times of any of the {len(covered)} relations",
            "relations and recording must have one clock",
        )
    begin, end = (interpolate(estimate, stamps_s[covered]) for stamps_s in (relations.from_s, relations.to_s))
    seen_m = np.einsum("nij,ni->nj", rotations_from_quats(begin.quats_xyzw), end.positions_m - begin.positions_m)
    seen_xyzw = multiply_quats(inverse_quats(begin.quats_xyzw), end.quats_xyzw)
    errors_m = np.linalg.norm(seen_m - relations.positions_m[covered], axis=1)
    errors_deg = np.rad2deg(rotation_angles_rad(seen_xyzw, relations.quats_xyzw[covered]))
    moved_m = float(np.sqrt(np.mean(np.sum(np.square(relations.positions_m[covered]), axis=1))))
    error_m = float(np.sqrt(np.mean(np.square(errors_m))))
    return {
        **statistics("relations.translation", errors_m, _NAMES),
        # Relations of a robot that stood still have no motion to compare with.
        **({RELATION_ERROR_PER_MOTION: 100 * error_m / moved_m} if moved_m > 0 else {}),
        **statistics("relations.rotation", errors_deg, _NAMES),
        "relations.matched_fraction": float(np.mean(covered)),
    }
