"""Times at which frames went in and poses came out, from the record of a run. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slamhive.runtime.frames import FrameTimes

SAME_TIMESTAMP_S = 2e-3
"""A pose belongs to the frame of its timestamp. Some systems round, or take the timestamp of a neighbouring message."""


@dataclass(frozen=True, slots=True)
class BagFrame:
    """A message of the bag: its timestamp, and when it was recorded."""

    stamp_s: float
    recorded_s: float


@dataclass(frozen=True)
class PlayedClock:
    """The messages of ``/clock``: arrival (monotonic clock, s) and the time of the bag that they state, s."""

    arrivals_s: Sequence[float]
    bag_times_s: Sequence[float]

    @property
    def start_s(self) -> float:
        """Start of playback, on the monotonic clock."""
        return self.arrivals_s[0]

    def arrival_of(self, recorded_s: float, rate: float) -> float:
        """Time at which a message recorded at ``recorded_s`` was played, on the monotonic clock."""
        if recorded_s <= self.bag_times_s[0]:
            return self.arrivals_s[0] - (self.bag_times_s[0] - recorded_s) / rate
        return float(np.interp(recorded_s, self.bag_times_s, self.arrivals_s))

    def lag_max_s(self, rate: float) -> float:
        """Largest delay of the player behind its schedule."""
        late_s = np.asarray(self.arrivals_s) - np.asarray(self.bag_times_s) / rate
        return float(late_s.max() - late_s[: max(1, len(late_s) // 20)].min())


def frame_times(
    frames: Sequence[BagFrame], poses: Iterable[tuple[float, float]], clock: PlayedClock, rate: float, *, every: bool
) -> list[FrameTimes]:
    """One line of ``frames.csv`` for each frame.

    Args:
        frames: All frames of the bag.
        poses: Timestamp and arrival of each pose.
        clock: What was played when.
        rate: The playback rate.
        every: Each frame should give a pose: those without one after the first pose were dropped. Otherwise none is.
    """
    # When the first pose of each frame arrived, by the number of the frame.
    done: dict[int, float] = {}
    order = np.argsort([frame.stamp_s for frame in frames], kind="stable")
    stamps_s = np.array([frames[index].stamp_s for index in order])
    for stamp_s, pose_s in poses if len(stamps_s) else ():
        after = int(np.searchsorted(stamps_s, stamp_s))
        near = min((max(after - 1, 0), min(after, len(stamps_s) - 1)), key=lambda index: abs(stamps_s[index] - stamp_s))
        number = int(order[near])
        if abs(stamps_s[near] - stamp_s) <= SAME_TIMESTAMP_S:
            done[number] = min(pose_s, done.get(number, pose_s))

    first = min(done, default=len(frames))
    lines = []
    for number, frame in enumerate(frames):
        received_s = clock.arrival_of(frame.recorded_s, rate) - clock.start_s
        arrived_s = done.get(number)
        done_s = None if arrived_s is None else max(received_s, arrived_s - clock.start_s)
        silent = done_s is None and not (every and number > first)
        lines.append(FrameTimes(number, frame.stamp_s, received_s, done_s, silent))
    return lines


def queue_drops(statistics: Iterable[Any]) -> list[dict[str, Any]]:
    """Delivered and dropped messages of each queue, from the messages of ``/statistics``, by topic and nodes."""
    queues: dict[tuple[str, str, str], list[int]] = {}
    for message in statistics:
        counts = queues.setdefault((message.topic, message.node_pub, message.node_sub), [0, 0])
        counts[0] += message.delivered_msgs
        counts[1] += message.dropped_msgs
    return [
        {"topic": topic, "from": source, "to": target, "delivered": delivered, "dropped": dropped}
        for (topic, source, target), (delivered, dropped) in sorted(queues.items())
    ]
