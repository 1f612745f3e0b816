"""Reading trajectories of the formats that are in use, and what identifies the run that each becomes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from slamhive.errors import InvalidInput
from slamhive.services.imports.request import Candidate, TrajectoryFormat
from slamhive.trajectory.euroc import read_euroc
from slamhive.trajectory.kitti import read_kitti
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.table import count_columns, read_bounded
from slamhive.trajectory.tum import format_tum, parse_positions, parse_tum

_HALF = 16
_FEWEST_POSES = 2
_POSITION_COLUMNS, _TUM_COLUMNS, _KITTI_COLUMNS = 4, 8, 12
_FIRST_NANOSECONDS = 1e11
"""100 s; as seconds it would be three thousand years."""


@dataclass(frozen=True, slots=True)
class Loaded:
    """A candidate that was read.

    Attributes:
        candidate: What it was.
        text: In TUM format; the bytes of the file itself if they were.
        kitti_poses: The bytes of the file itself if it was in KITTI format, else None.
        poses: How many.
        format: Which it was.
        checksum: Of the file, ``sha256:<hex>``.
    """

    candidate: Candidate
    text: bytes
    kitti_poses: bytes | None
    poses: int
    format: TrajectoryFormat
    checksum: str

    @property
    def uid(self) -> str:
        """32 hex digits: the first half tells the trial, the second what was estimated in it."""
        return trial_digits(self.candidate) + hashlib.sha256(self.text).hexdigest()[:_HALF]


@dataclass(frozen=True, slots=True)
class LoadedTruth:
    """A ground truth that was read.

    Attributes:
        text: In TUM format, or lines of stamp and position; the bytes of the file itself if they were.
        kitti_poses: The bytes of the file itself if it was in KITTI format, else None.
        span_s: From its first stamp to its last.
        positions_only: It holds no orientations.
    """

    text: bytes
    kitti_poses: bytes | None
    span_s: float
    positions_only: bool


def trial_digits(candidate: Candidate) -> str:
    """What the ids of all imports of one trial begin with."""
    names = f"{candidate.algorithm}\0{candidate.dataset}\0{candidate.trial}"
    return hashlib.sha256(names.encode()).hexdigest()[:_HALF]


def load(candidate: Candidate) -> Loaded:
    """Read a candidate; raises NotFound or InvalidInput naming file, line and value."""
    data = read_bounded(candidate.path)
    found, trajectory = read_any(candidate.path, data, candidate.format, candidate.times)
    _check_length(candidate.path, trajectory, "trajectory")
    return Loaded(
        candidate=candidate,
        text=data if found is TrajectoryFormat.TUM else _as_tum(trajectory),
        kitti_poses=data if found is TrajectoryFormat.KITTI else None,
        poses=len(trajectory),
        format=found,
        checksum=f"sha256:{hashlib.sha256(data).hexdigest()}",
    )


def load_truth(path: Path, times: Path | None = None) -> LoadedTruth:
    """A ground truth, which may hold positions alone; raises as :func:`load`."""
    data = read_bounded(path)
    positions_only = count_columns(data) == _POSITION_COLUMNS
    if positions_only:
        found, trajectory = TrajectoryFormat.TUM, parse_positions(data, str(path))
    else:
        found, trajectory = read_any(path, data, TrajectoryFormat.AUTO, times)
    _check_length(path, trajectory, "ground truth")
    text = data if found is TrajectoryFormat.TUM else _as_tum(trajectory)
    kitti_poses = data if found is TrajectoryFormat.KITTI else None
    return LoadedTruth(text, kitti_poses, trajectory.span_s, positions_only)


def read_any(
    path: Path, data: bytes, wanted: TrajectoryFormat, times: Path | None
) -> tuple[TrajectoryFormat, Trajectory]:
    """The format of the file at ``path`` with the bytes ``data``, and what it holds."""
    found = _detect(data) if wanted is TrajectoryFormat.AUTO else wanted
    if found is TrajectoryFormat.TUM:
        return found, parse_tum(data, str(path))
    if found is TrajectoryFormat.EUROC:
        return found, read_euroc(path)
    if times is None:
        raise InvalidInput(f"{path} holds KITTI poses, which have no stamps", "give the file of the stamps (--times)")
    return found, read_kitti(path, times)


def _detect(data: bytes) -> TrajectoryFormat:
    columns = count_columns(data)
    if columns == _KITTI_COLUMNS:
        return TrajectoryFormat.KITTI
    if columns >= _TUM_COLUMNS and _first_number(data) >= _FIRST_NANOSECONDS:
        return TrajectoryFormat.EUROC
    return TrajectoryFormat.TUM


def _first_number(data: bytes) -> float:
    row = next(line for line in data.splitlines() if line.strip() and not line.lstrip().startswith(b"#"))
    try:
        return float(row.replace(b",", b" ").split()[0])
    except ValueError:
        return 0.0


def _check_length(path: Path, trajectory: Trajectory, kind: str) -> None:
    if len(trajectory) < _FEWEST_POSES:
        raise InvalidInput(f"{path} holds a single pose", f"a {kind} needs two at least")


def _as_tum(trajectory: Trajectory) -> bytes:
    return format_tum(trajectory.stamps_s, trajectory.positions_m, trajectory.quats_xyzw).encode()
