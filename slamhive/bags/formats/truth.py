"""Ground truth that comes with a recording: in a file of its own or on a topic."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slamhive.bags.bag_writer import NS_PER_S
from slamhive.bags.geometry import Array
from slamhive.bags.importing import PlannedTruth
from slamhive.errors import InvalidInput
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


def check_clock(truth: FoundTruth, recorded_ns: tuple[int, int], name: str) -> None:
    """Raise InvalidInput with both spans if ground truth and recording have no time in common."""
    first_s, last_s = float(truth.times_s[0]), float(truth.times_s[-1])
    start_s, end_s = recorded_ns[0] / NS_PER_S, recorded_ns[1] / NS_PER_S
    if last_s < start_s or first_s > end_s:
        raise InvalidInput(
            f"{name} covers {first_s:.3f} to {last_s:.3f} s, the recording {start_s:.3f} to {end_s:.3f} s: "
            "their clocks do not meet",
            "give the ground truth of this recording, with the clock of its message headers",
        )
