"""Ground truth that comes with a recording: in a file of its own or on a topic."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from slamhive.base.errors import InvalidInput, nearest
from slamhive.recordings.geometry import Array, enu_m
from slamhive.recordings.importers.recording import NAV_SAT_FIX, ODOMETRY, SourceBag
from slamhive.recordings.importers.sensors import TF_TYPES, plain_frame
from slamhive.recordings.importing import PlannedTruth
from slamhive.runtime.messages import stamp_ns
from slamhive.trajectory.evidence import Span
from slamhive.trajectory.model import find_problem, no_rotations
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
        """The ground truth as plans hold it."""
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


# Ground truth on a topic of the recording.


Row = tuple[str, int, Any, Any]
"""The frame that moves, when in ns, its position and its orientation."""

_READERS: dict[str, Callable[[Any], Iterator[Row]]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: iter([("", stamp_ns(m), m.pose.position, m.pose.orientation)]),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: iter(
        [("", stamp_ns(m), m.pose.pose.position, m.pose.pose.orientation)]
    ),
    ODOMETRY: lambda m: iter([(m.child_frame_id, stamp_ns(m), m.pose.pose.position, m.pose.pose.orientation)]),
    "geometry_msgs/msg/TransformStamped": lambda m: iter([_moved(m)]),
    **dict.fromkeys(TF_TYPES, lambda m: (_moved(entry) for entry in m.transforms)),
}
_NO_FIX = -1
"""``NavSatStatus.STATUS_NO_FIX``."""


def read_truth_topic(bag: SourceBag, wanted: str) -> FoundTruth:
    """The poses on the topic ``wanted``; of a transform, ``TOPIC:FRAME`` names the frame that moves.

    Positions of a ``NavSatFix`` are relative to the first one: east, north, up in m.

    Raises InvalidInput for a topic that is not there or of another type, frames that do not part, and bad poses.
    """
    name, _, frame = wanted.partition(":")
    topic = bag.topic(name, "the ground truth")
    if topic.type == NAV_SAT_FIX:
        fixes = [
            (stamp_ns(fix) * 1e-9, fix.latitude, fix.longitude, fix.altitude)
            for _, fix in bag.stream(name)
            if fix.status.status != _NO_FIX
        ]
        rows = np.array(fixes, dtype=np.float64).reshape(-1, 4)
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows) < 2:
            raise InvalidInput(f"topic {name!r} has {len(rows)} positions with a fix", "two are needed at least")
        positions_m = enu_m(rows[:, 1], rows[:, 2], rows[:, 3])
        found = FoundTruth(rows[:, 0], positions_m, None, gravity_aligned=True, source=f"topic {name}")
        return _checked(bag, found)
    if topic.type not in _READERS:
        known = ", ".join(sorted({*_READERS, NAV_SAT_FIX}))
        raise InvalidInput(f"topic {name!r} for the ground truth holds {topic.type}", f"expected one of {known}")
    frames: dict[str, list[tuple[float, ...]]] = {}
    for _, message in bag.stream(name):
        for child, time_ns, p, q in _READERS[topic.type](message):
            frames.setdefault(plain_frame(child), []).append((time_ns * 1e-9, p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    if frame and frame not in frames:
        raise InvalidInput(f"topic {name!r} has no frame {frame!r}; {nearest(frame, list(frames))}")
    if not frame and len(frames) != 1:
        raise InvalidInput(
            f"topic {name!r} has the poses of {len(frames)} frames: {', '.join(sorted(frames))}",
            f"name one: --groundtruth-topic {name}:FRAME",
        )
    child = frame or next(iter(frames))
    rows = np.array(frames[child], dtype=np.float64)
    found = FoundTruth(
        rows[:, 0], rows[:, 1:4], rows[:, 4:8], gravity_aligned=False, source=f"topic {wanted}", frame=child
    )
    return _checked(bag, found)


def _checked(bag: SourceBag, truth: FoundTruth) -> FoundTruth:
    """The poses in order of time, each timestamp once; raises InvalidInput for numbers that are no poses."""
    times_s, kept = np.unique(truth.times_s, return_index=True)
    positions_m = truth.positions_m[kept]
    quats_xyzw = None if truth.quats_xyzw is None else truth.quats_xyzw[kept]
    if quats_xyzw is not None and not quats_xyzw.any():
        quats_xyzw = None
    checked = no_rotations(len(times_s)) if quats_xyzw is None else quats_xyzw
    problem = find_problem(times_s, positions_m, checked)
    if problem is not None:
        place = f"{bag.path}: pose {problem.index + 1} of {truth.source}, the ground truth"
        raise InvalidInput(f"{place}: {problem.found}", problem.remedy)
    if len(times_s) < 2:
        raise InvalidInput(f"{bag.path}: {truth.source} has a single pose", "a ground truth needs two at least")
    if quats_xyzw is not None:
        quats_xyzw = quats_xyzw / np.linalg.norm(quats_xyzw, axis=1, keepdims=True)
    return replace(truth, times_s=times_s, positions_m=positions_m, quats_xyzw=quats_xyzw)


def _moved(entry: Any) -> Row:
    return entry.child_frame_id, stamp_ns(entry), entry.transform.translation, entry.transform.rotation
