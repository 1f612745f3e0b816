"""The part of the run that speaks ROS: reads topics, knows which nodes are there, and keeps the clock running."""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import rosgraph
import roslib.message
import rospy
from rosgraph_msgs.msg import Clock, TopicStatistics
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from slamhive.runtime.ros1.system import Ros1System
from slamhive.runtime.ros1.timing import PlayedClock
from slamhive.runtime.ros_poses import PoseLog

NAME = "/slamhive"
_QUEUE = 10_000
_SETTINGS = {
    "/use_sim_time": True,
    "/enable_statistics": True,
    "/statistics_window_min_elements": 1,
    "/statistics_window_max_elements": 20,
    "/statistics_window_min_size": 1,
    "/statistics_window_max_size": 1,
}
"""The clock of the recording for all, and the statistics of queues once a second, which are off otherwise."""


class Recorder:
    """Records what a system publishes, from now on.

    Args:
        system: Which topics.
        parameters: Set on the parameter server first.
    """

    def __init__(self, system: Ros1System, parameters: Mapping[str, Any]) -> None:
        self._master = rosgraph.Master(NAME)
        for key, value in {**_SETTINGS, **parameters}.items():
            self._master.setParam(key, value)
        self.poses = PoseLog(system.poses)
        self.keyframes = None if system.keyframes is None else PoseLog(system.keyframes)
        self.statistics: list[Any] = []
        self.map: Any = None
        self._processed: list[tuple[float, float]] | None = [] if system.processed else None
        self._over = False
        self._clock_arrivals_s: list[float] = []
        self._clock_times_s: list[float] = []
        rospy.init_node(NAME.lstrip("/"), disable_signals=True, disable_rostime=True)
        subscribe_poses(self.poses)
        if self.keyframes is not None:
            subscribe_poses(self.keyframes)
        subscribe("/clock", Clock, self._take_clock)
        subscribe("/statistics", TopicStatistics, self.statistics.append)
        if system.processed:
            subscribe(system.processed, Header, self._take_processed)
        if system.map_topic:
            subscribe(system.map_topic, PointCloud2, self._take_map)

    @property
    def arrivals(self) -> list[tuple[float, float]]:
        """Timestamp of each frame that the system is through with, and when it said so, both in s."""
        return self.poses.arrivals if self._processed is None else self._processed

    @property
    def clock(self) -> PlayedClock:
        """Messages that have been played until now."""
        return PlayedClock(tuple(self._clock_arrivals_s), tuple(self._clock_times_s))

    @property
    def bag_time_s(self) -> float | None:
        """The time of the recording that is played now; None before the start."""
        return self._clock_times_s[-1] if self._clock_times_s else None

    def missing(self, nodes: Collection[str], topics: Collection[str]) -> list[str]:
        """In words, which of ``nodes`` are not there and which of ``topics`` nobody listens to."""
        _, subscribers, _ = self._master.getSystemState()
        heard = {topic for topic, listeners in subscribers if set(listeners) - {NAME}}
        absent = [f"node {node}" for node in nodes if not self._is_there(node)]
        return absent + [f"a subscriber of {topic}" for topic in topics if topic not in heard]

    def graph(self) -> object:
        """All publishers, subscribers and services; it changes while nodes start."""
        return self._master.getSystemState()

    def run_clock_on(self, rate: float) -> ClockAfterEnd:
        """The clock after the end of the recording: nodes that wait for a later time would wait for ever."""
        self._over = True
        return ClockAfterEnd(self._clock_times_s[-1], rate)

    def map_points_m(self) -> Any:
        """The points of the last map, (n, 3) float32, m; None if none was published."""
        return None if self.map is None else points_of(self.map)

    def close(self) -> None:
        """Take no more messages."""
        rospy.signal_shutdown("the run is over")

    def _is_there(self, node: str) -> bool:
        try:
            self._master.lookupNode(node)
        except rosgraph.MasterError:
            return False
        return True

    def _take_clock(self, message: Any) -> None:
        now_s = time.monotonic()
        if self._over:
            return
        if not self._clock_times_s or message.clock.to_sec() > self._clock_times_s[-1]:
            self._clock_arrivals_s.append(now_s)
            self._clock_times_s.append(message.clock.to_sec())

    def _take_processed(self, header: Any) -> None:
        if self._processed is not None:
            self._processed.append((header.stamp.to_sec(), time.monotonic()))

    def _take_map(self, message: Any) -> None:
        if message.width * message.height:
            self.map = message


class ClockAfterEnd:
    """Publishes ``/clock`` from the end of the recording on; call :meth:`tick` often."""

    def __init__(self, end_s: float, rate: float) -> None:
        self._end_s = end_s
        self._rate = rate
        self._since_s = time.monotonic()
        self._publisher = rospy.Publisher("/clock", Clock, queue_size=10)

    def tick(self) -> None:
        """Publish the time now."""
        now_s = self._end_s + (time.monotonic() - self._since_s) * self._rate
        self._publisher.publish(Clock(rospy.Time.from_sec(now_s)))


def subscribe_poses(log: PoseLog) -> None:
    """Take what is published on the topic of ``log``."""
    kind = roslib.message.get_message_class(log.source.kind.value)
    subscribe(log.source.topic, kind, lambda message: log.add(message, time.monotonic()))


def subscribe(topic: str, kind: Any, take: Any) -> None:
    """Call ``take`` with each message of ``topic``; no message is dropped here."""
    rospy.Subscriber(topic, kind, take, queue_size=_QUEUE, tcp_nodelay=True)


def points_of(message: Any) -> Any:
    """The finite points of a ``PointCloud2``, (n, 3) float32, m."""
    offsets = {field.name: field.offset for field in message.fields}
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": ["<f4"] * 3,
            "offsets": [offsets[axis] for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    rows = np.frombuffer(message.data, dtype=layout)
    points_m = np.column_stack([rows[axis] for axis in "xyz"])
    return points_m[np.isfinite(points_m).all(axis=1)]
