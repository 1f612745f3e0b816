"""Ground truth of an import: reads pose files, and checks that its clock meets that of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.domain.protocol import Duplicates
from slamhive.recordings.geometry import Array, quaternions_from_rotations
from slamhive.recordings.importing import PlannedStream, PlannedTruth
from slamhive.recordings.ros1_writer import NS_PER_S
from slamhive.recordings.text_lists import TimedList
from slamhive.trajectory.layout import parse_ground_truth
from slamhive.trajectory.model import find_problem
from slamhive.trajectory.orientation import no_rotations
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import rotations_from_quats


def tum_truth(path: Path, source: str, *, gravity_aligned: bool) -> PlannedTruth:
    """The poses of the body in a TUM file, or its positions; of equal timestamps, the first. Raises InvalidInput."""
    try:
        poses, without = parse_ground_truth(read_bounded(path), str(path), Duplicates.FIRST)
    except NotFound as error:
        raise InvalidInput(error.message, "give the ground truth as a TUM file") from None
    quats_xyzw = None if without else poses.quats_xyzw
    return PlannedTruth(poses.stamps_s, poses.positions_m, quats_xyzw, gravity_aligned=gravity_aligned, source=source)


def listed_truth(rows: TimedList, quats_xyzw: Array | None, source: str, *, gravity_aligned: bool) -> PlannedTruth:
    """The poses of a list whose first three columns are x, y, z in m; raises InvalidInput naming the line.

    Args:
        rows: The list.
        quats_xyzw: Unit quaternions (n, 4), None for positions only.
        source: What measured them.
        gravity_aligned: The z axis of the world points up.
    """
    times_s, positions_m = rows.times_ns / NS_PER_S, rows.numbers(0, 3)
    if quats_xyzw is not None and not quats_xyzw.any():
        quats_xyzw = None
    quats = no_rotations(len(rows)) if quats_xyzw is None else quats_xyzw
    problem = find_problem(times_s, positions_m, quats)
    if problem is not None:
        raise rows.error(problem.index, problem.found, problem.remedy)
    unit = None if quats_xyzw is None else quats / np.linalg.norm(quats, axis=1, keepdims=True)
    return PlannedTruth(times_s, positions_m, unit, gravity_aligned=gravity_aligned, source=source)


def of_body(truth: PlannedTruth, T_measured_body: Array) -> PlannedTruth:
    """The poses of the body, of those of a frame that is fixed to it; ``T_measured_body`` is (4, 4)."""
    if truth.quats_xyzw is None or np.array_equal(T_measured_body, np.eye(4)):
        return truth
    R_world_measured = rotations_from_quats(truth.quats_xyzw)
    return replace(
        truth,
        positions_m=truth.positions_m + R_world_measured @ T_measured_body[:3, 3],
        quats_xyzw=quaternions_from_rotations(R_world_measured @ T_measured_body[:3, :3]),
    )


def matched_truth(truth: PlannedTruth | None, streams: Sequence[PlannedStream]) -> tuple[str, ...]:
    """Notes on the part of the recording that has no ground truth; raises InvalidInput if the clocks do not meet."""
    if truth is None:
        return ("there is no ground truth: runs get no ATE",)
    times_s = streams[0].times_ns / NS_PER_S
    check_clock(truth.times_s, (times_s[0], times_s[-1]), "the ground truth", streams[0].sensor.name)
    first_s, last_s = truth.times_s[0], truth.times_s[-1]
    outside = int(np.count_nonzero((times_s < first_s) | (times_s > last_s)))
    if not outside:
        return ()
    return (f"{outside} of {len(times_s)} messages of {streams[0].sensor.name} are before or after the ground truth",)


def check_clock(times_s: Array, recorded_s: tuple[float, float], truth: str, recorded: str) -> None:
    """Raise InvalidInput with both spans if ground truth and recording have no time in common.

    Args:
        times_s: The times of the ground truth, shape (n,), increasing.
        recorded_s: When the recording begins and ends.
        truth: What messages call the ground truth.
        recorded: What messages call the recording.
    """
    start_s, end_s = recorded_s
    if times_s[-1] < start_s or times_s[0] > end_s:
        raise InvalidInput(
            f"{truth} is from {times_s[0]:.3f} s to {times_s[-1]:.3f} s, "
            f"{recorded} from {start_s:.3f} s to {end_s:.3f} s: the clocks do not meet",
            "give the ground truth of this recording, with the timestamps of its sensors",
        )
