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
    empty if it does not say, ``antenna`` the frame of positions alone. ``sigmas_m`` (n, 3) are the standard deviations
    of positions along the axes of the world, NaN where a message does not state them.
    """

    times_s: Array
    positions_m: Array
    quats_xyzw: Array | None
    gravity_aligned: bool
    source: str
    frame: str = ""
    antenna: str = ""
    sigmas_m: Array | None = None

    @property
    def planned(self) -> PlannedTruth:
        """The ground truth as plans hold it."""
        return PlannedTruth(
            self.times_s,
            self.positions_m,
            self.quats_xyzw,
            self.gravity_aligned,
            self.source,
            sigmas_m=self.sigmas_m if self.sigmas_m is not None and np.isfinite(self.sigmas_m).all() else None,
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """Say what is known of its uncertainty."""
        if self.sigmas_m is None or not np.isfinite(self.sigmas_m).any():
            return ()
        unknown = int(np.count_nonzero(~np.isfinite(self.sigmas_m).all(axis=1)))
        if unknown:
            found = f"{unknown} of the {len(self.sigmas_m)} covariances of {self.source}"
            return (f"{found} do not state the variance of x, y and z: all are left out (--uncertainty states it)",)
        middle_m = float(np.median(self.sigmas_m))
        return (f"the covariances of {self.source} are the uncertainty of the ground truth: {middle_m:.3g} m (median)",)


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


Row = tuple[str, int, Any, Any, Any]
"""The frame that moves, when in ns, its position, its orientation, and the covariance of both; None without."""
_DIAGONAL = (0, 7, 14)
"""The variances of x, y and z in the 6x6 covariance of a pose."""

_READERS: dict[str, Callable[[Any], Iterator[Row]]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: iter([("", stamp_ns(m), m.pose.position, m.pose.orientation, None)]),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: iter(
        [("", stamp_ns(m), m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance)]
    ),
    ODOMETRY: lambda m: iter(
        [(m.child_frame_id, stamp_ns(m), m.pose.pose.position, m.pose.pose.orientation, m.pose.covariance)]
    ),
    "geometry_msgs/msg/TransformStamped": lambda m: iter([_moved(m)]),
    **dict.fromkeys(TF_TYPES, lambda m: (_moved(entry) for entry in m.transforms)),
}
_NO_FIX, _NO_COVARIANCE = -1, 0
"""``NavSatStatus.STATUS_NO_FIX`` and ``NavSatFix.COVARIANCE_TYPE_UNKNOWN``."""


def read_truth_topic(bag: SourceBag, wanted: str) -> FoundTruth:
    """The poses on the topic ``wanted``; of a transform, ``TOPIC:FRAME`` names the frame that moves.

    Positions of a ``NavSatFix`` are relative to the first one: east, north, up in m.

    Raises InvalidInput for a topic that is not there or of another type, frames that do not part, and bad poses.
    """
    name, _, frame = wanted.partition(":")
    topic = bag.topic(name, "the ground truth")
    if topic.type == NAV_SAT_FIX:
        fixes = [
            (stamp_ns(fix) * 1e-9, fix.latitude, fix.longitude, fix.altitude, *_variances_m2(fix))
            for _, fix in bag.stream(name)
            if fix.status.status != _NO_FIX
        ]
        rows = np.array(fixes, dtype=np.float64).reshape(-1, 7)
        rows = rows[np.isfinite(rows[:, :4]).all(axis=1)]
        if len(rows) < 2:
            raise InvalidInput(f"topic {name!r} has {len(rows)} positions with a fix", "two are needed at least")
        positions_m = enu_m(rows[:, 1], rows[:, 2], rows[:, 3])
        found = FoundTruth(
            rows[:, 0],
            positions_m,
            None,
            gravity_aligned=True,
            source=f"topic {name}",
            antenna=plain_frame(bag.first(name).header.frame_id),
            sigmas_m=_sigmas_m(rows[:, 4:7]),
        )
        return _checked(bag, found)
    if topic.type not in _READERS:
        known = ", ".join(sorted({*_READERS, NAV_SAT_FIX}))
        raise InvalidInput(f"topic {name!r} for the ground truth holds {topic.type}", f"expected one of {known}")
    frames: dict[str, list[tuple[float, ...]]] = {}
    for _, message in bag.stream(name):
        for child, time_ns, p, q, covariance in _READERS[topic.type](message):
            variances_m2 = (0.0, 0.0, 0.0) if covariance is None else (covariance[place] for place in _DIAGONAL)
            row = (time_ns * 1e-9, p.x, p.y, p.z, q.x, q.y, q.z, q.w, *variances_m2)
            frames.setdefault(plain_frame(child), []).append(row)
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
        rows[:, 0],
        rows[:, 1:4],
        rows[:, 4:8],
        gravity_aligned=False,
        source=f"topic {wanted}",
        frame=child,
        sigmas_m=_sigmas_m(rows[:, 8:11]),
    )
    return _checked(bag, found)


def _variances_m2(fix: Any) -> tuple[float, ...]:
    """Of a ``NavSatFix``, east, north, up in m²; zeros where they are not known."""
    if fix.position_covariance_type == _NO_COVARIANCE:
        return 0.0, 0.0, 0.0
    return tuple(float(fix.position_covariance[place]) for place in (0, 4, 8))


def _sigmas_m(variances_m2: Array) -> Array:
    """The standard deviations of variances (n, 3), NaN where they are not known.

    Messages state what is not known as 0 or -1, and what was not measured by a huge number.
    """
    known = np.isfinite(variances_m2) & (variances_m2 > 0) & (variances_m2 < MOST_VARIANCE_M2)
    return np.asarray(np.sqrt(np.where(known, variances_m2, np.nan)))


MOST_VARIANCE_M2 = 1e4
"""Drivers write 1e5 or more, up to the largest double, for a coordinate that they do not measure."""


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
    sigmas_m = None if truth.sigmas_m is None else truth.sigmas_m[kept]
    return replace(truth, times_s=times_s, positions_m=positions_m, quats_xyzw=quats_xyzw, sigmas_m=sigmas_m)


def _moved(entry: Any) -> Row:
    return entry.child_frame_id, stamp_ns(entry), entry.transform.translation, entry.transform.rotation, None
