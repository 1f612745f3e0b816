"""Makes a pair of two trajectories by a protocol: time offset, association, alignment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Protocol
from slamhive.evaluation.evaluators.base import ROTATIONS_UNKNOWN, Paired
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.alignment import align
from slamhive.trajectory.association import associate
from slamhive.trajectory.evidence import misread_unit
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.offset import position_misfit, search_offset, turning_misfit
from slamhive.trajectory.orientation import lacking

MINIMUM_MATCHED_POSES = 3
"""With fewer poses the alignment is arbitrary, and so is every metric."""

SEARCHED_POSES = 1000
"""The search for an offset by position uses at most this many poses of the estimate, evenly spread."""


def pair(
    reference: TruthReference, estimate: Trajectory, protocol: Protocol, files: Mapping[str, Path] | None = None
) -> Paired:
    """Bring ``estimate`` to the clock of the ground truth, match the poses, align them.

    Raises InvalidInput that says which step is not possible, and why.
    """
    reference.check(protocol)
    truth = reference.trajectory
    estimate = reference.placed(estimate)
    if len(truth) < 2:
        raise InvalidInput("the ground truth has one pose, which spans no time", "use a ground truth of several poses")
    offset_s = protocol.time_offset_s
    if protocol.offset_search_s > 0:
        offset_s = find_offset(reference, estimate, protocol)
    estimate = shifted(estimate, offset_s)
    matched_reference, matched_estimate = associate(truth, estimate, protocol)
    if len(matched_reference) < MINIMUM_MATCHED_POSES:
        misread = misread_unit(estimate.stamps_s, truth.stamps_s)
        raise InvalidInput(
            f"only {len(matched_reference)} of {len(estimate)} estimated poses match the ground truth in time, "
            f"at least {MINIMUM_MATCHED_POSES} are needed" + ("" if misread is None else f": {misread.sentence}"),
            "the run tracked too little, or the association tolerance is too small"
            if misread is None
            else misread.remedy,
        )
    without = lacking(estimate.quats_xyzw, estimate.positions_m)
    transform = align(protocol.alignment, matched_estimate, matched_reference, protocol.align_poses)
    return Paired(
        protocol=protocol,
        reference=truth,
        rotations_known=reference.rotations_known and not without,
        estimate=estimate,
        matched_reference=matched_reference,
        matched_estimate=matched_estimate,
        aligned=transform.poses(matched_estimate),
        aligned_estimate=transform.poses(estimate),
        transform=transform,
        time_offset_s=offset_s,
        T_body_estimate=reference.T_body_estimate,
        files=dict(files or {}),
        rotations_unknown=f"of the estimate, {without}" if without and reference.rotations_known else ROTATIONS_UNKNOWN,
    )


def find_offset(reference: TruthReference, estimate: Trajectory, protocol: Protocol) -> float:
    """The offset in s to add to the timestamps of the estimate, so that its angular rate matches the ground truth.

    If the ground truth holds positions only, the offset with the least RMSE of the aligned positions. That is less
    certain, since drift of the estimate moves it. Raises InvalidInput if there is no minimum within
    ``offset_search_s`` of ``time_offset_s``.
    """
    if reference.rotations_known:
        misfit = turning_misfit(reference.trajectory, estimate)
    else:
        misfit = position_misfit(reference.trajectory, _thinned(estimate), protocol.alignment)
    return search_offset(misfit, protocol.time_offset_s, protocol.offset_search_s)


def _thinned(trajectory: Trajectory) -> Trajectory:
    step = math.ceil(len(trajectory) / SEARCHED_POSES)
    return Trajectory(trajectory.stamps_s[::step], trajectory.positions_m[::step], trajectory.quats_xyzw[::step])


def shifted(trajectory: Trajectory, offset_s: float) -> Trajectory:
    """The trajectory with ``offset_s`` added to its timestamps; raises InvalidInput if two of them become equal."""
    if offset_s == 0:
        return trajectory
    stamps_s = trajectory.stamps_s + offset_s
    if np.any((np.diff(stamps_s) <= 0) & (np.diff(trajectory.stamps_s) > 0)):
        raise InvalidInput(f"a time offset of {offset_s:g} s makes timestamps equal", "give a smaller offset")
    return Trajectory(stamps_s, trajectory.positions_m, trajectory.quats_xyzw)
