"""Ground truth of an import: reads pose files, and checks that its clock meets that of the sensors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slamhive.bags.bag_writer import NS_PER_S
from slamhive.bags.geometry import Array, quaternions_from_rotations
from slamhive.bags.importing import PlannedTruth, Stream
from slamhive.bags.timed_list import TimedList
from slamhive.domain.protocol import Duplicates
from slamhive.errors import InvalidInput, NotFound
from slamhive.trajectory.model import find_problem
from slamhive.trajectory.table import read_bounded
from slamhive.trajectory.transforms import rotations_from_quats
from slamhive.trajectory.tum import parse_tum


def tum_truth(path: Path, source: str, *, gravity_aligned: bool) -> PlannedTruth:
    """The poses of the body in a TUM file; of poses with equal timestamps, the first. Raises InvalidInput."""
    try:
        poses = parse_tum(read_bounded(path), str(path), Duplicates.FIRST)
    except NotFound as error:
        raise InvalidInput(error.message, "give the ground truth as a TUM file") from None
    return PlannedTruth(
        poses.stamps_s, poses.positions_m, poses.quats_xyzw, gravity_aligned=gravity_aligned, source=source
    )


def listed_truth(rows: TimedList, quats_xyzw: Array | None, source: str, *, gravity_aligned: bool) -> PlannedTruth:
    """The poses of a list whose first three columns are x, y, z in m; raises InvalidInput naming the line.

    Args:
        rows: The list.
        quats_xyzw: Unit quaternions (n, 4), None for positions only.
        source: What measured them.
        gravity_aligned: The z axis of the world points up.
    """
    times_s, positions_m = rows.times_ns / NS_PER_S, rows.numbers(0, 3)
    quats = np.tile((0.0, 0.0, 0.0, 1.0), (len(rows), 1)) if quats_xyzw is None else quats_xyzw
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
    return PlannedTruth(
        truth.times_s,
        truth.positions_m + R_world_measured @ T_measured_body[:3, 3],
        quaternions_from_rotations(R_world_measured @ T_measured_body[:3, :3]),
        gravity_aligned=truth.gravity_aligned,
        source=truth.source,
    )


def matched_truth(truth: PlannedTruth | None, streams: Sequence[Stream]) -> tuple[str, ...]:
    """Notes on the part of the recording that has no ground truth; raises InvalidInput if the clocks do not meet."""
    if truth is None:
        return ("there is no ground truth: runs get no ATE",)
    first_s, last_s = float(truth.times_s[0]), float(truth.times_s[-1])
    times_s = streams[0].times_ns / NS_PER_S
    if last_s < times_s[0] or first_s > times_s[-1]:
        raise InvalidInput(
            f"the ground truth is from {first_s:.3f} s to {last_s:.3f} s, "
            f"{streams[0].sensor.name} from {times_s[0]:.3f} s to {times_s[-1]:.3f} s: the clocks do not meet",
            "give ground truth with timestamps of the sensors' clock",
        )
    outside = int(np.count_nonzero((times_s < first_s) | (times_s > last_s)))
    if not outside:
        return ()
    return (f"{outside} of {len(times_s)} messages of {streams[0].sensor.name} are before or after the ground truth",)
