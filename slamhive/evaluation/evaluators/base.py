"""The seam of evaluators: each computes metrics of the catalogue from a pair of trajectories."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, runtime_checkable
from typing import Protocol as Interface

import numpy as np

from slamhive.domain.protocol import Protocol
from slamhive.trajectory.alignment import FrameOffset, Similarity
from slamhive.trajectory.model import FloatArray, Poses, Trajectory

if TYPE_CHECKING:
    from evo.core.result import Result


COVARIANCES = "covariances"
MAP = "map"
RELATIONS = "relations"
REFERENCE_MAP = "reference_map"
UNCERTAINTIES = "uncertainties"
IMAGE_TIMES = "image_times"
KITTI_ESTIMATE = "kitti_estimate"
KITTI_REFERENCE = "kitti_reference"

ROTATIONS_UNKNOWN = "the ground truth holds positions only"
"""Why a metric that needs the orientations of the ground truth is missing."""


@dataclass(frozen=True, slots=True, eq=False)
class Paired:
    """An estimate and its ground truth, associated and aligned by the protocol.

    Attributes:
        protocol: How they were associated and aligned, and which pairs relative errors use.
        reference: The whole ground truth, in the frame of the estimate.
        rotations_known: False if the ground truth or the estimate holds positions only; orientations then mean nothing.
        rotations_unknown: Why, for metrics that are missing for that reason.
        estimate: The whole estimate in its own world, with timestamps on the clock of the ground truth.
        matched_reference: The matched poses of the ground truth.
        matched_estimate: The matched poses of the estimate, not aligned, one for each of ``matched_reference``.
        aligned: The matched poses of the estimate, aligned.
        aligned_estimate: The whole estimate, aligned.
        transform: The alignment.
        time_offset_s: The offset that was added to the timestamps of the estimate.
        T_body_estimate: Pose, in the body frame, of the frame whose poses the estimate holds, shape (4, 4).
        files: Other files of run and dataset that exist, by name: :data:`COVARIANCES`, :data:`MAP`,
            :data:`RELATIONS`, :data:`REFERENCE_MAP`, :data:`KITTI_ESTIMATE`, :data:`KITTI_REFERENCE`,
            :data:`UNCERTAINTIES`, :data:`IMAGE_TIMES`.
        uncertainty_m: Standard deviation of a true position along each axis; None if it is not known.
        fitted: The constant transform between the frames that the protocol has fitted; None without.
    """

    protocol: Protocol
    reference: Trajectory
    rotations_known: bool
    estimate: Trajectory
    matched_reference: Poses
    matched_estimate: Poses
    aligned: Poses
    aligned_estimate: Trajectory
    transform: Similarity
    time_offset_s: float = 0.0
    T_body_estimate: FloatArray = field(default_factory=lambda: np.eye(4))
    files: Mapping[str, Path] = field(default_factory=dict)
    rotations_unknown: str = ROTATIONS_UNKNOWN
    uncertainty_m: float | None = None
    fitted: FrameOffset | None = None


@dataclass(frozen=True, slots=True)
class MetricValues:
    """The metrics that one evaluator found.

    Attributes:
        values: {metric key: finite number}.
        missing: {metric key: why it has no value}, in one line.
        archives: {file name without ending: evo's result}, for ``evo_res`` and the plots.
    """

    values: Mapping[str, float]
    missing: Mapping[str, str] = field(default_factory=dict)
    archives: Mapping[str, Result] = field(default_factory=dict)


@runtime_checkable
class Evaluator(Interface):
    """Computes some metrics of a pair."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The metrics that it may find. All are in the catalogue, and no other evaluator finds them."""

    def evaluate(self, paired: Paired) -> MetricValues:
        """Compute the metrics. Raises InvalidInput if there are none: all keys are then missing for that reason.

        A metric that the protocol does not ask for, such as another segment length, is neither found nor missing.
        """


def absent(keys: Iterable[str], reason: str) -> MetricValues:
    """No values, all for one reason."""
    return MetricValues({}, dict.fromkeys(keys, reason))
