"""Makes a pair of two trajectories by a protocol: time offset, association, alignment."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Association, FrameFit, Protocol
from slamhive.evaluation.evaluators.base import IMAGE_TIMES, ROTATIONS_UNKNOWN, Paired
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.alignment import align, fit_offset
from slamhive.trajectory.association import associate, position_misfit, search_offset, sparse_truth, turning_misfit
from slamhive.trajectory.evidence import misread_unit
from slamhive.trajectory.model import FloatArray, Trajectory, lacking
from slamhive.trajectory.pose_file import read_times
from slamhive.trajectory.transforms import move_sensor

MINIMUM_MATCHED_POSES = 3
"""With fewer poses the alignment is arbitrary, and so is every metric."""

FITTED_POSES = 2000
"""The transform between frames is fitted to at most this many matched poses, evenly spread."""
SEARCHED_POSES = 1000
"""The search for an offset by position uses at most this many poses of the estimate, evenly spread."""


def pair(
    reference: TruthReference,
    estimate: Trajectory,
    protocol: Protocol,
    files: Mapping[str, Path] | None = None,
    *,
    uncertainty_m: float | None = None,
) -> Paired:
    """Bring ``estimate`` to the clock of the ground truth, match the poses, align them.

    Args:
        reference: The ground truth in the frame of the estimate.
        estimate: The trajectory of the algorithm.
        protocol: How.
        files: Other files of run and dataset.
        uncertainty_m: Standard deviation of a true position along each axis.

    Raises:
        InvalidInput: Says which step is not possible, and why.
    """
    reference.check(protocol)
    truth = without_stretches(reference.trajectory, protocol)
    estimate = reference.placed(estimate)
    if len(truth) < 2:
        raise InvalidInput("the ground truth has one pose, which spans no time", "use a ground truth of several poses")
    offset_s = protocol.time_offset_s
    if protocol.offset_search_s > 0:
        offset_s = find_offset(reference, estimate, protocol)
    estimate = shifted(estimate, offset_s)
    images_s = image_times(files or {}, protocol)
    matched_reference, matched_estimate = associate(truth, estimate, protocol, images_s)
    if len(matched_reference) < MINIMUM_MATCHED_POSES:
        misread = misread_unit(estimate.stamps_s, truth.stamps_s)
        raise InvalidInput(
            f"only {len(matched_reference)} of {len(estimate)} estimated poses match the ground truth in time, "
            f"at least {MINIMUM_MATCHED_POSES} are needed" + ("" if misread is None else f": {misread.sentence}"),
            (
                sparse_truth(truth, estimate, protocol, len(matched_reference))
                or "the run tracked too little, or the association tolerance is too small"
            )
            if misread is None
            else misread.remedy,
        )
    without = lacking(estimate.quats_xyzw, estimate.positions_m)
    T_body_estimate, fitted = reference.T_body_estimate, None
    if protocol.frame_fit is not None:
        if without:
            raise InvalidInput(f"a frame is fitted by orientations of the estimate: {without}", "leave out frame_fit")
        fit = protocol.frame_fit
        if not reference.rotations_known and fit is not FrameFit.LEVER_ARM:
            raise InvalidInput(
                f"frame_fit {fit} needs orientations, and the ground truth holds positions only", "use lever_arm"
            )
        chosen = np.unique(np.linspace(0, len(matched_reference) - 1, FITTED_POSES).astype(np.intp))
        fitted = fit_offset(
            matched_reference.take(chosen),
            matched_estimate.take(chosen),
            oriented=reference.rotations_known,
            scaled=protocol.alignment in (Alignment.SIM3, Alignment.SCALE),
            arm=fit is not FrameFit.ROTATION,
        )
        # Only the part that the protocol fits counts.
        T_fitted = np.eye(4)
        if fit is not FrameFit.LEVER_ARM:
            T_fitted[:3, :3] = fitted.rotation
        if fit is not FrameFit.ROTATION:
            T_fitted[:3, 3] = fitted.arm_m
        T_body_estimate = T_body_estimate @ T_fitted
        if reference.rotations_known:
            truth = move_sensor(truth, T_fitted)
        else:
            estimate = move_sensor(estimate, T_fitted)
        matched_reference, matched_estimate = associate(truth, estimate, protocol, images_s)
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
        T_body_estimate=T_body_estimate,
        files=dict(files or {}),
        rotations_unknown=f"of the estimate, {without}" if without and reference.rotations_known else ROTATIONS_UNKNOWN,
        uncertainty_m=uncertainty_m,
        fitted=fitted,
    )


def without_stretches(truth: Trajectory, protocol: Protocol) -> Trajectory:
    """The ground truth without the stretches that the protocol leaves out; raises InvalidInput if nothing is left."""
    if not protocol.leave_out_s:
        return truth
    if protocol.association is Association.INDEX:
        raise InvalidInput(
            "poses are matched by index, so no stretch of the ground truth can be left out",
            "choose an association by time",
        )
    kept = truth.take(np.flatnonzero(~_left_out(truth.stamps_s, protocol)))
    if len(kept) == 0:
        raise InvalidInput("leave_out_s leaves out the whole ground truth", "name shorter stretches")
    return Trajectory(kept.stamps_s, kept.positions_m, kept.quats_xyzw)


def image_times(files: Mapping[str, Path], protocol: Protocol) -> FloatArray | None:
    """Times of the images of the dataset, in s, shape (k,), without the stretches that are left out.

    None where the protocol compares at other times, or the dataset does not state them. Raises InvalidInput for a
    damaged file.
    """
    path = files.get(IMAGE_TIMES)
    if path is None or protocol.association is not Association.HOLD:
        return None
    times_s = read_times(path)
    return times_s[~_left_out(times_s, protocol)]


def _left_out(stamps_s: FloatArray, protocol: Protocol) -> npt.NDArray[np.bool_]:
    """Tell which timestamps lie in a stretch that the protocol leaves out, its ends included."""
    limits_s = np.array(protocol.leave_out_s)
    inside: npt.NDArray[np.bool_] = np.searchsorted(limits_s, stamps_s, side="right") % 2 == 1
    return inside | np.isin(stamps_s, limits_s)


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
