"""Read trajectories in common formats, and identify the run that each one becomes."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from slamhive.domain.protocol import Duplicates
from slamhive.errors import InvalidInput
from slamhive.services.imports.conventions import Partner, Truth, settle, settle_truth
from slamhive.services.imports.request import Candidate, Reading
from slamhive.trajectory.evidence import Span
from slamhive.trajectory.layout import Convention, QuaternionOrder, TimeUnit
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.pose_file import PoseFile, TrajectoryFormat, read_pose_file
from slamhive.trajectory.tum import format_tum

_HALF = 16
_FEWEST_POSES = 2


@dataclass(frozen=True, slots=True)
class Loaded:
    """A candidate whose conventions are known.

    Attributes:
        candidate: The file.
        text: In TUM format; the original bytes if the file was in that format.
        kitti_poses: The bytes of the file itself if it was in KITTI format, else None.
        poses: Number of poses.
        format: The layout of its rows.
        checksum: Of the file, ``sha256:<hex>``.
        reading: Its conventions.
    """

    candidate: Candidate
    text: bytes
    kitti_poses: bytes | None
    poses: int
    format: TrajectoryFormat
    checksum: str
    reading: Reading

    @property
    def uid(self) -> str:
        """32 hex digits: the first half identifies the trial, the second its estimate."""
        return trial_digits(self.candidate) + hashlib.sha256(self.text).hexdigest()[:_HALF]


@dataclass(frozen=True, slots=True)
class LoadedTruth:
    """A ground truth whose numbers are understood.

    Attributes:
        text: In TUM format, or lines of timestamp and position; the bytes of the file itself if they were.
        kitti_poses: The bytes of the file itself if it was in KITTI format, else None.
        truth: What estimates are compared with.
        reading: Its conventions.
    """

    text: bytes
    kitti_poses: bytes | None
    truth: Truth
    reading: Reading


def trial_digits(candidate: Candidate) -> str:
    """The common prefix of the ids of all imports of one trial."""
    names = f"{candidate.algorithm}\0{candidate.dataset}\0{candidate.trial}"
    return hashlib.sha256(names.encode()).hexdigest()[:_HALF]


def read_candidate(candidate: Candidate) -> PoseFile:
    """Read the numbers of a candidate; raises NotFound or InvalidInput naming file, line and value."""
    found = read_pose_file(candidate.path, candidate.format, candidate.times, columns=candidate.columns)
    _check_length(found, "trajectory")
    return found


def load(
    candidate: Candidate, file: PoseFile, truth: Truth | None, duplicates: Duplicates, relations: Span | None = None
) -> Loaded:
    """Determine the conventions of a candidate; raises InvalidInput if they are unclear or it is no trajectory.

    ``truth`` is the ground truth for comparison, None if there is none. ``relations`` is the time in s of relations.
    """
    reading = settle(file, candidate.name, candidate.told, truth, relations)
    trajectory = _trajectory(file, reading, duplicates)
    kitti_poses = file.data if file.format is TrajectoryFormat.KITTI else None
    return Loaded(
        candidate=candidate,
        text=_text(file, reading, trajectory),
        kitti_poses=kitti_poses,
        poses=len(trajectory),
        format=file.format,
        checksum=f"sha256:{hashlib.sha256(file.data).hexdigest()}",
        reading=reading,
    )


def load_truth(
    path: Path, times: Path | None, name: str, told: Convention, partners: Sequence[Partner], duplicates: Duplicates
) -> LoadedTruth:
    """A ground truth, which may hold positions alone; raises NotFound or InvalidInput.

    ``partners`` may tell its unit and order where it does not by itself. ``name`` is what its reading is called.
    """
    file = read_pose_file(path, TrajectoryFormat.AUTO, times, positions=True)
    _check_length(file, "ground truth")
    reading = settle_truth(file, name, told, partners)
    trajectory = _trajectory(file, reading, duplicates)
    kitti_poses = file.data if file.format is TrajectoryFormat.KITTI else None
    text = _text(file, reading, trajectory, positions=True)
    return LoadedTruth(text, kitti_poses, Truth(trajectory, file.raw.orientations), reading)


def read_truth_here(path: Path, *, positions_only: bool) -> Truth | None:
    """The ground truth of a dataset that is here; None if it cannot be read, which an evaluation will tell."""
    try:
        file = read_pose_file(path, TrajectoryFormat.TUM, None, positions=True)
        trajectory = file.raw.trajectory(TimeUnit.S, QuaternionOrder.XYZW, Duplicates.KEEP)
    except InvalidInput:
        return None
    return Truth(trajectory, file.raw.orientations and not positions_only)


def _check_length(file: PoseFile, kind: str) -> None:
    if len(file.raw.times) < _FEWEST_POSES:
        raise InvalidInput(f"{file.raw.table.name} holds a single pose", f"a {kind} needs two at least")


def _trajectory(file: PoseFile, reading: Reading, duplicates: Duplicates) -> Trajectory:
    """All poses of the file, including duplicates: the evaluation decides which of those count."""
    kept = Duplicates.REFUSE if duplicates is Duplicates.REFUSE else Duplicates.KEEP
    return file.raw.trajectory(reading.time_unit, reading.quaternion_order or QuaternionOrder.XYZW, kept)


def _text(file: PoseFile, reading: Reading, trajectory: Trajectory, *, positions: bool = False) -> bytes:
    """The text that runs and datasets store; with ``positions``, a file without orientations has those alone."""
    if reading.as_it_stands:
        return file.data
    if positions and not file.raw.orientations:
        rows = zip(trajectory.stamps_s.tolist(), trajectory.positions_m.tolist(), strict=True)
        return "".join(f"{stamp_s:.9f} {x:.9f} {y:.9f} {z:.9f}\n" for stamp_s, (x, y, z) in rows).encode()
    return format_tum(trajectory.stamps_s, trajectory.positions_m, trajectory.quats_xyzw).encode()
