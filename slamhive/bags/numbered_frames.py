"""Frames of which only a number is known: files in the order of the number in their names, at a nominal rate."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from slamhive.bags.geometry import Array, quaternions_from_rotations
from slamhive.bags.importing import PlannedTruth
from slamhive.bags.rgbd import Frames, nominal_times_ns
from slamhive.domain.sensors import IDENTITY4, is_rigid
from slamhive.errors import InvalidInput
from slamhive.files import visible_files
from slamhive.trajectory.table import NumberTable, parse_table, read_bounded

_DIGITS = re.compile(r"\d+")


def numbered(folder: Path, *patterns: str) -> dict[int, Path]:
    """The files of the first of ``patterns`` that matches, by the first number in their names; none without a match.

    Raises InvalidInput if two files have one number.
    """
    for pattern in patterns:
        found: dict[int, Path] = {}
        for path in visible_files(folder, pattern):
            digits = _DIGITS.search(path.name)
            if digits is None or len(digits[0]) > 12:
                continue
            if int(digits[0]) in found:
                raise InvalidInput(f"{found[int(digits[0])]} and {path} have the same number", "keep one of them")
            found[int(digits[0])] = path
        if found:
            return dict(sorted(found.items()))
    return {}


def timed(frames: dict[int, Path], frames_per_s: float) -> Frames:
    """The frames with nominal timestamps: number 0 is at 0 s; raises InvalidInput."""
    return Frames(nominal_times_ns(list(frames), frames_per_s), list(frames.values()))


def nominal_note(frames_per_s: float) -> str:
    """What users should know of such timestamps."""
    return f"timestamps are nominal: {frames_per_s:g} frames per second (--frame-rate)"


def read_pose_table(path: Path, columns: int, layout: str) -> Array:
    """The numbers of a pose file, float64 (n, columns); raises InvalidInput."""
    return parse_table(read_bounded(path), str(path), columns, layout).values


def read_frame_poses(path: Path, columns: int, layout: str, numbers: Sequence[int]) -> tuple[list[int], NumberTable]:
    """The poses of numbered frames: line n + 1 is that of frame n, or of the n-th frame from the first one.

    Args:
        path: One pose a line. A blank line stands for a frame whose pose is not known.
        columns: How many numbers a pose has.
        layout: The columns in words, for messages.
        numbers: Of the frames that are there, increasing.

    Returns:
        The frame of each pose, and the poses.

    Raises:
        InvalidInput: A row is bad, or it is in doubt to which frames the lines belong.
    """
    table = parse_table(read_bounded(path), str(path), columns, layout)
    count = int(table.places[-1]) + 1
    if count > numbers[-1]:
        first = 0
    elif count == numbers[-1] - numbers[0] + 1:
        first = numbers[0]
    else:
        raise InvalidInput(
            f"{path} has {count} poses, there are {len(numbers)} images from number {numbers[0]} to {numbers[-1]}",
            f"each needs its pose: line {numbers[-1] + 1} for the last, or as many lines as numbers from the first one",
        )
    return [first + place for place in table.places.tolist()], table


def truth_of_matrices(times_ns: Array, poses: Array, source: str, *, gravity_aligned: bool = False) -> PlannedTruth:
    """Ground truth of poses (n, 4, 4) that are known to be rigid."""
    return PlannedTruth(
        times_ns / 1e9,
        poses[:, :3, 3],
        quaternions_from_rotations(poses[:, :3, :3]),
        gravity_aligned=gravity_aligned,
        source=source,
    )


def is_pose(matrix: Array) -> bool:
    """Whether a (4, 4) is a rigid transform; formats write NaN, infinity or zeros for poses that are not known."""
    numbers = matrix.reshape(-1).tolist()
    return numbers[12:] == list(IDENTITY4[12:]) and is_rigid(tuple(numbers))
