"""The seam: an evaluator takes a pair of trajectories and yields metrics of the catalogue."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from typing import Protocol as Interface

import numpy as np

from slamhive.domain.protocol import Protocol
from slamhive.trajectory.alignment import Similarity
from slamhive.trajectory.model import FloatArray, Poses, Trajectory

if TYPE_CHECKING:
    from evo.core.result import Result


COVARIANCES = "covariances"
MAP = "map"
RELATIONS = "relations"
REFERENCE_MAP = "reference_map"
KITTI_ESTIMATE = "kitti_estimate"
KITTI_REFERENCE = "kitti_reference"


@dataclass(frozen=True, slots=True, eq=False)
class Paired:
    """An estimate and its ground truth, associated and aligned as the protocol has it.

    Attributes:
        protocol: What association, alignment and deltas are.
        reference: The whole ground truth, in the frame of the estimate.
        rotations_known: False where the ground truth holds positions only; its orientations then mean nothing.
        estimate: The whole estimate in its own world, its timestamps on the clock of the ground truth.
        matched_reference: The matched poses of the ground truth.
        matched_estimate: The matched poses of the estimate, not aligned, one for each of ``matched_reference``.
        aligned: The matched poses of the estimate, aligned.
        aligned_estimate: The whole estimate, aligned.
        transform: What aligned it.
        time_offset_s: What was added to the estimate's timestamps.
        T_body_estimate: Pose, in the body frame, of the frame whose poses the estimate holds, shape (4, 4).
        files: What else there is of run and dataset, by name: :data:`COVARIANCES`, :data:`MAP`, :data:`RELATIONS`,
            :data:`REFERENCE_MAP`, :data:`KITTI_ESTIMATE`, :data:`KITTI_REFERENCE`; what is not there is left out.
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


@dataclass(frozen=True, slots=True)
class Figures:
    """What one evaluator found.

    Attributes:
        values: {metric key: finite number}.
        missing: {metric key: why there is none}, in one line.
        archives: {file name without ending: evo's result}, for ``evo_res`` and the plots.
    """

    values: Mapping[str, float]
    missing: Mapping[str, str] = field(default_factory=dict)
    archives: Mapping[str, Result] = field(default_factory=dict)


class Evaluator(Interface):
    """One way of taking metrics from a pair."""

    @property
    def keys(self) -> tuple[str, ...]:
        """The metric keys it may yield, all of them in the catalogue; no two evaluators yield the same."""

    def evaluate(self, paired: Paired) -> Figures:
        """The metrics of the pair. Raises InvalidInput if none can be taken: all keys are then missing for that.

        What the protocol does not ask for, such as other lengths of segments, is neither found nor missing.
        """


def absent(keys: Iterable[str], reason: str) -> Figures:
    """No metrics, all for one reason."""
    return Figures({}, dict.fromkeys(keys, reason))


ROTATIONS_UNKNOWN = "the ground truth holds positions only"
"""Why a metric that needs the orientations of the ground truth is missing."""
