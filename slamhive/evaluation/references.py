"""Ground truths, each of which is read once for all runs."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.protocol import Alignment, Duplicates, Protocol
from slamhive.domain.sensors import Matrix4
from slamhive.evaluation.job import EvaluationTask
from slamhive.trajectory.layout import parse_ground_truth
from slamhive.trajectory.model import FloatArray, Trajectory
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import move_sensor, rigid_transform

NO_TRUTH = "the dataset has relations and no ground-truth trajectory"
"""Why a metric that needs a ground-truth trajectory is missing."""

_SCALING = {Alignment.SIM3, Alignment.SCALE}


@dataclass(frozen=True, slots=True, eq=False)
class TruthReference:
    """A ground truth in the frame of an estimate.

    Attributes:
        trajectory: Its poses, in the frame of the estimate; in the body frame if only positions are known.
        rotations_known: False if only positions are known.
        T_sensor_body: Moves the estimate to the body, or to the point of it that is measured. Set if only positions are
            known and there is a lever arm.
        T_body_estimate: Pose, in the body frame, of the frame of the estimate after :meth:`placed`.
    """

    trajectory: Trajectory
    rotations_known: bool = True
    T_sensor_body: FloatArray | None = None
    T_body_estimate: FloatArray = field(default_factory=lambda: np.eye(4))

    def check(self, protocol: Protocol) -> None:
        """Raise InvalidInput if this alignment needs orientations that are not known."""
        if self.rotations_known:
            return
        if protocol.aligns_one_pose:
            raise InvalidInput(
                "alignment of the first pose needs orientations, and the ground truth holds positions only",
                "use se3, sim3 or none, over more poses",
            )
        if self.T_sensor_body is not None and protocol.alignment in _SCALING:
            raise InvalidInput(
                f"the alignment {protocol.alignment} leaves the scale open, but the ground truth holds positions only, "
                "so that the lever arm has to be added to the estimate in metres",
                "use se3, or give the protocol a T_body_sensor without translation",
            )

    def placed(self, estimate: Trajectory) -> Trajectory:
        """The estimate, moved to the body if the ground truth could not be moved to the estimate."""
        return estimate if self.T_sensor_body is None else move_sensor(estimate, self.T_sensor_body)


class References:
    """Ground truths by file and sensor frame, each read on first use."""

    def __init__(self) -> None:
        self._bodies: dict[_File, TruthReference | InvalidInput] = {}
        self._moved: dict[tuple[_File, Matrix4, tuple[float, ...] | None], TruthReference] = {}

    def preload(self, tasks: Iterable[EvaluationTask]) -> None:
        """Read all that ``tasks`` need. A malformed ground truth raises when its task asks for it."""
        for task in tasks:
            with contextlib.suppress(InvalidInput):
                self.of(task)

    def of(self, task: EvaluationTask) -> TruthReference:
        """The ground truth of ``task`` in its estimate's frame; raises InvalidInput that says why there is none."""
        if task.reference is None:
            raise InvalidInput(NO_TRUTH)
        T_body_sensor = task.protocol.T_body_sensor or task.T_body_sensor
        file = _File(task.reference, task.positions_only, task.protocol.duplicates, task.span_s)
        arm_m = task.protocol.lever_arm_m or task.lever_arm_m
        key = (file, T_body_sensor, arm_m)
        if key not in self._moved:
            body = self._body(file)
            if isinstance(body, InvalidInput):
                raise body
            self._moved[key] = _moved(body, rigid_transform(T_body_sensor, "T_body_sensor"), arm_m)
        return self._moved[key]

    def _body(self, file: _File) -> TruthReference | InvalidInput:
        if file not in self._bodies:
            try:
                self._bodies[file] = _read(file)
            except NotFound:
                self._bodies[file] = InvalidInput(f"there is no ground truth: {file.path.name} does not exist")
            except InvalidInput as error:
                self._bodies[file] = error
        return self._bodies[file]


@dataclass(frozen=True, slots=True)
class _File:
    """A file of a ground truth, how it is read, and the times between which it counts."""

    path: Path
    positions_only: bool
    duplicates: Duplicates
    span_s: tuple[float, ...] | None = None


def _read(file: _File) -> TruthReference:
    """The ground truth of a file with eight columns, or four, which are positions."""
    data, name = read_bounded(file.path), f"ground truth {file.path.name}"
    trajectory, without = parse_ground_truth(data, name, file.duplicates)
    if file.span_s is not None:
        trajectory = _within(trajectory, file.span_s, name)
    return TruthReference(trajectory, rotations_known=not (file.positions_only or without))


def _within(trajectory: Trajectory, span_s: tuple[float, ...], name: str) -> Trajectory:
    """The poses between two times; raises InvalidInput if there is none."""
    begin_s, end_s = span_s
    stamps_s = trajectory.stamps_s
    part = trajectory.take(np.flatnonzero((stamps_s >= begin_s) & (stamps_s <= end_s)))
    if not len(part):
        raise InvalidInput(
            f"{name} has no pose between {begin_s:.3f} s and {end_s:.3f} s, where the recording was clipped",
            "clip it where it has some; the clock of the recording has to be that of the ground truth",
        )
    return Trajectory(part.stamps_s, part.positions_m, part.quats_xyzw)


def _moved(body: TruthReference, T_body_sensor: FloatArray, arm_m: tuple[float, ...] | None) -> TruthReference:
    """The ground truth in the frame of the estimate; ``arm_m`` is the point of the body that positions are of."""
    if not body.rotations_known:
        T_body_point = np.eye(4)
        T_body_point[:3, 3] = (0.0, 0.0, 0.0) if arm_m is None else arm_m
        T_sensor_point: FloatArray = np.asarray(np.linalg.inv(T_body_sensor) @ T_body_point, dtype=np.float64)
        if not T_sensor_point[:3, 3].any():
            return TruthReference(body.trajectory, False, T_body_estimate=T_body_sensor)
        return TruthReference(body.trajectory, False, T_sensor_point, T_body_estimate=np.asarray(T_body_point))
    if arm_m is not None:
        raise InvalidInput(
            "a lever arm is for a ground truth of positions; this one has orientations",
            "use T_body_sensor, which says which frame the estimate describes",
        )
    if np.array_equal(T_body_sensor, np.eye(4)):
        return body
    return TruthReference(move_sensor(body.trajectory, T_body_sensor), T_body_estimate=T_body_sensor)
