"""Frames, the input of one step of an algorithm, assembled from the messages of a recording."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slamhive.base.files import write_aside
from slamhive.runtime.messages import LaserScan, PointCloud

Array = NDArray[Any]
Entry = TypeVar("Entry")

ODOMETRY_COLUMNS = 14
IMU_COLUMNS = 7
_ENTRY_WORDS: dict[type, str] = {np.ndarray: "an image", PointCloud: "points", LaserScan: "a laser scan"}

_MOST_WAITING = 100
"""The most messages of one stream that wait for partners, so that a missing partner does not fill the memory."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One message of each stream, taken at the same time, and the IMU samples since the frame before.

    Attributes:
        number: Counts all frames of the recording from 0, dropped ones too.
        stamp_s: The timestamp in the header of the first stream's message.
        received_s: When it came in, seconds of the monotonic clock since playback began.
        fraction: How far in the recording it lies, 0..1.
        data: For each role an image array (``messages.to_image``), a
            :class:`~slamhive.runtime.messages.PointCloud` or a :class:`~slamhive.runtime.messages.LaserScan`.
        imu: (n, 7) float64 ``t, gyro xyz, acc xyz`` (s, rad/s, m/s²): all samples recorded before this frame and not
            delivered yet, those of dropped frames included.
        odometry: (m, 14) float64 ``t, position xyz, quaternion xyzw, velocity xyz, angular rate xyz`` (s, m, m/s,
            rad/s), collected as ``imu`` is.
    """

    number: int
    stamp_s: float
    received_s: float
    fraction: float
    data: dict[str, Array | PointCloud | LaserScan]
    imu: Array
    odometry: Array = field(default_factory=lambda: np.empty((0, ODOMETRY_COLUMNS)))

    def image(self, role: str) -> Array:
        """The image in ``role``."""
        return self._entry(role, np.ndarray)

    def points(self, role: str) -> PointCloud:
        """The point cloud in ``role``."""
        return self._entry(role, PointCloud)

    def laser_scan(self, role: str) -> LaserScan:
        """The laser scan in ``role``."""
        return self._entry(role, LaserScan)

    def _entry(self, role: str, kind: type[Entry]) -> Entry:
        entry = self.data[role]
        if not isinstance(entry, kind):
            raise TypeError(f"{role} holds {_ENTRY_WORDS[type(entry)]}, not {_ENTRY_WORDS[kind]}")
        return entry


@dataclass(frozen=True, eq=False)
class Received:
    """A message with its header timestamp and receive time."""

    stamp_ns: int
    recorded_ns: int
    message: Any


class Synchroniser:
    """Groups messages of several streams by their timestamps.

    Args:
        roles: The streams; a single one makes each message a group.
        tolerance_ns: Largest difference between the timestamps of a group.
    """

    def __init__(self, roles: list[str], tolerance_ns: int) -> None:
        self._waiting: dict[str, deque[Received]] = {role: deque() for role in roles}
        self._tolerance_ns = tolerance_ns
        self.unmatched = 0
        """Messages that found no partner."""

    def add(self, role: str, received: Received) -> dict[str, Received] | None:
        """Add a message; returns the group that it completes."""
        own = self._waiting[role]
        own.append(received)
        if len(own) > _MOST_WAITING:
            own.popleft()
            self.unmatched += 1
        while all(self._waiting.values()):
            heads = {name: queue[0] for name, queue in self._waiting.items()}
            oldest = min(heads, key=lambda name: heads[name].stamp_ns)
            newest_ns = max(head.stamp_ns for head in heads.values())
            if newest_ns - heads[oldest].stamp_ns <= self._tolerance_ns:
                for queue in self._waiting.values():
                    queue.popleft()
                return heads
            self._waiting[oldest].popleft()
            self.unmatched += 1
        return None

    def end(self) -> None:
        """Count all waiting messages as unmatched at the end of the recording."""
        self.unmatched += sum(len(queue) for queue in self._waiting.values())
        for queue in self._waiting.values():
            queue.clear()


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """One line of ``frames.csv``; ``done_s`` is None for a frame that was dropped, or that was taken and ``silent``."""

    number: int
    stamp_s: float
    received_s: float
    done_s: float | None
    silent: bool = False
    """The algorithm took the frame, but gave no pose for it."""


def write_frames_csv(path: Path, frames: list[FrameTimes]) -> None:
    """Write ``timestamp,received,done,dropped`` for every frame in the order of the recording.

    ``timestamp`` is the recording's time in s, ``received`` and ``done`` are seconds since playback began.
    """
    lines = ["timestamp,received,done,dropped\n"]
    for entry in sorted(frames, key=lambda frame: frame.number):
        done = "" if entry.done_s is None else f"{entry.done_s:.6f}"
        dropped = entry.done_s is None and not entry.silent
        lines.append(f"{entry.stamp_s:.9f},{entry.received_s:.6f},{done},{int(dropped)}\n")
    write_aside(path, "".join(lines))


def imu_array(rows: list[tuple[float, ...]]) -> Array:
    """``rows`` as an array (n, 7), even if there are none."""
    return np.array(rows, dtype=np.float64).reshape(-1, IMU_COLUMNS)


def odometry_array(rows: list[tuple[float, ...]]) -> Array:
    """``rows`` as an array (n, 14), even if there are none."""
    return np.array(rows, dtype=np.float64).reshape(-1, ODOMETRY_COLUMNS)
