"""Ground truth that comes with a recording: in a file of its own or on a topic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slamhive.bags.geometry import Array
from slamhive.bags.importing import PlannedTruth
from slamhive.trajectory.evidence import Span
from slamhive.trajectory.pose_file import read_ground_truth


@dataclass(frozen=True, eq=False)
class FoundTruth:
    """Poses of a frame: times (n,) in s, positions (n, 3) in m, unit quaternions (n, 4) x y z w.

    ``quats_xyzw`` is None where only positions are known. ``frame`` is what the recording calls the frame that moves,
    empty if it does not say.
    """

    times_s: Array
    positions_m: Array
    quats_xyzw: Array | None
    gravity_aligned: bool
    source: str
    frame: str = ""

    @property
    def planned(self) -> PlannedTruth:
        """As plans hold it."""
        return PlannedTruth(self.times_s, self.positions_m, self.quats_xyzw, self.gravity_aligned, self.source)


def read_truth_file(path: Path, recorded: Span, source: str = "") -> FoundTruth:
    """The ground truth in a TUM or EuRoC file, or one of timestamps and positions.

    Args:
        path: The file.
        recorded: When the recording begins and ends, in s: it shows the unit of the timestamps.
        source: What measured it.

    Raises:
        NotFound: There is no such file.
        InvalidInput: It is damaged, or unit or order of its numbers are in doubt; names file, line and value.
    """
    trajectory, oriented = read_ground_truth(path, recorded)
    quats_xyzw = trajectory.quats_xyzw if oriented else None
    return FoundTruth(trajectory.stamps_s, trajectory.positions_m, quats_xyzw, gravity_aligned=False, source=source)
