"""The player: a separate process that reads the recording and sends frames to the algorithm.

Started by :class:`slamhive.runtime.playback.Player` as ``python3 -m slamhive.runtime.player``; the two talk through a
socket. The algorithm asks for each frame (``NEXT``), so nothing is buffered between the processes and the player's own
queue is the only one. In real time it behaves as a ROS subscriber does: a frame joins the queue when it is due, a full
queue loses its oldest frame. Sequentially, the next frame is read when it is asked for.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections import deque
from dataclasses import asdict, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.runtime.frames import Frame, FrameTimes, Received, Synchroniser, imu_array, odometry_array
from slamhive.runtime.messages import BETWEEN_FRAMES, IMU, ODOMETRY, convert, imu_row, odometry_row, stamp_ns
from slamhive.runtime.recording import Incoming, Recording, forget_pages

NEXT = "next"


@dataclass(frozen=True, slots=True)
class PlayerOptions:
    """The recording to play, and the way to play it.

    ``topics`` maps role to topic; the first that is neither IMU nor odometry gives a frame its timestamp.
    """

    recording: str
    topics: dict[str, str]
    realtime: bool
    rate: float
    queue_size: int
    tolerance_s: float


@dataclass(frozen=True, slots=True)
class PlaybackSummary:
    """The content of ``playback.json``. Lag is how late frames joined the queue; None when there was no schedule.

    ``cpu_s`` is all CPU time of the player's process since its start, which is subtracted from the algorithm's.
    ``duration_s`` is the time from the first message to the last. ``began_at_s`` is the time of day when playback
    began, in s since 1970 (UTC).
    """

    frames_total: int
    frames_sent: int
    frames_dropped: int
    unmatched: int
    imu_samples: int
    lag_max_s: float | None
    lag_mean_s: float | None
    cpu_s: float
    duration_s: float
    began_at_s: float


@dataclass(eq=False)
class _Group:
    """A frame before its messages are converted; ``imu`` and ``odometry`` came since the group before."""

    number: int
    received_s: float
    fraction: float
    messages: dict[str, Received]
    imu: list[tuple[float, ...]]
    odometry: list[tuple[float, ...]]


@dataclass(eq=False)
class _Counts:
    frames: int = 0
    sent: int = 0
    imu: int = 0
    lags_s: list[float] = field(default_factory=list)
    dropped: list[FrameTimes] = field(default_factory=list)


class _Playback:
    """One pass through a recording."""

    def __init__(self, options: PlayerOptions, recording: Recording, connection: Connection[Any, Any]) -> None:
        self._options = options
        self._recording = recording
        self._connection = connection
        self._roles = [role for role in options.topics if recording.kinds[role] not in BETWEEN_FRAMES]
        if not self._roles:
            raise InvalidInput("the algorithm has no input that makes frames", "a camera, a LiDAR or a laser is needed")
        self._synchroniser = Synchroniser(self._roles, round(options.tolerance_s * 1e9))
        self._queue: deque[_Group] = deque()
        self._imu: list[tuple[float, ...]] = []
        self._odometry: list[tuple[float, ...]] = []
        self._counts = _Counts()
        self._asked = False
        self._start_s = 0.0
        self._began_at_s = 0.0

    def run(self) -> None:
        """Wait until the algorithm is ready, play everything, then send the summary."""
        total = min(self._recording.count(role) for role in self._roles)
        self._connection.send(("ready", total))
        self._wait_until_asked()
        self._start_s = time.monotonic()
        self._began_at_s = time.time()
        self._connection.send(("start", self._start_s))
        source = self._recording.messages()
        if self._options.realtime:
            for incoming in source:
                due_s = (incoming.recorded_ns - self._recording.start_ns) * 1e-9 / self._options.rate
                while True:  # requests are answered until the message is due
                    self._serve()
                    left_s = self._start_s + due_s - time.monotonic()
                    if left_s <= 0:
                        break
                    if self._asked:
                        time.sleep(left_s)
                    elif self._connection.poll(left_s):
                        self._receive()
                group = self._take(incoming, self._since_start_s())
                if group is not None:
                    self._counts.lags_s.append(max(0.0, group.received_s - due_s))
                    self._queue.append(group)
                    if len(self._queue) > self._options.queue_size:
                        # As a queue of ROS: the oldest frame is lost, but not the samples that came with it.
                        lost = self._queue.popleft()
                        self._queue[0].imu = lost.imu + self._queue[0].imu
                        self._queue[0].odometry = lost.odometry + self._queue[0].odometry
                        self._counts.dropped.append(FrameTimes(lost.number, self._stamp_s(lost), lost.received_s, None))
                self._serve()
        else:
            for incoming in source:
                group = self._take(incoming, self._since_start_s())
                if group is not None:
                    self._wait_until_asked()
                    group.received_s = self._since_start_s()
                    self._queue.append(group)
                    self._send_oldest()
        self._synchroniser.end()
        while self._queue:
            self._wait_until_asked()
            self._send_oldest()
        self._wait_until_asked()
        forget_pages(Path(self._options.recording))
        self._connection.send(("end", self._summary(), self._counts.dropped))

    def _take(self, incoming: Incoming, received_s: float) -> _Group | None:
        if incoming.kind == IMU:
            self._imu.append(imu_row(incoming.message))
            self._counts.imu += 1
            return None
        if incoming.kind == ODOMETRY:
            self._odometry.append(odometry_row(incoming.message))
            return None
        received = Received(stamp_ns(incoming.message), incoming.recorded_ns, incoming.message)
        messages = self._synchroniser.add(incoming.role, received)
        if messages is None:
            return None
        span_ns = max(self._recording.end_ns - self._recording.start_ns, 1)
        fraction = (incoming.recorded_ns - self._recording.start_ns) / span_ns
        group = _Group(self._counts.frames, received_s, fraction, messages, self._imu, self._odometry)
        self._imu, self._odometry = [], []
        self._counts.frames += 1
        return group

    def _serve(self) -> None:
        if not self._asked and self._connection.poll():
            self._receive()
        if self._asked and self._queue:
            self._send_oldest()

    def _wait_until_asked(self) -> None:
        if not self._asked:
            self._receive()

    def _receive(self) -> None:
        self._connection.recv()
        self._asked = True

    def _send_oldest(self) -> None:
        group = self._queue.popleft()
        data = {role: convert(group.messages[role].message, self._recording.kinds[role]) for role in self._roles}
        frame = Frame(
            number=group.number,
            stamp_s=self._stamp_s(group),
            received_s=group.received_s,
            fraction=group.fraction,
            data=data,
            imu=imu_array(group.imu),
            odometry=odometry_array(group.odometry),
        )
        self._connection.send(("frame", frame, len(self._counts.dropped)))
        self._asked = False
        self._counts.sent += 1

    def _stamp_s(self, group: _Group) -> float:
        return group.messages[self._roles[0]].stamp_ns * 1e-9

    def _since_start_s(self) -> float:
        return time.monotonic() - self._start_s

    def _summary(self) -> dict[str, Any]:
        lags_s = self._counts.lags_s
        summary = PlaybackSummary(
            frames_total=self._counts.frames,
            frames_sent=self._counts.sent,
            frames_dropped=len(self._counts.dropped),
            unmatched=self._synchroniser.unmatched,
            imu_samples=self._counts.imu,
            lag_max_s=max(lags_s) if lags_s else None,
            lag_mean_s=sum(lags_s) / len(lags_s) if lags_s else None,
            cpu_s=time.process_time(),
            duration_s=self._since_start_s(),
            began_at_s=self._began_at_s,
        )
        return asdict(summary)


def main(arguments: list[str]) -> int:
    """The process: ``arguments`` are the socket's descriptor and the options as JSON."""
    descriptor, text = arguments
    options = PlayerOptions(**json.loads(text))
    connection: Connection[Any, Any] = Connection(int(descriptor))
    try:
        with Recording(Path(options.recording), options.topics) as recording:
            _Playback(options, recording, connection).run()
    except SlamHiveError as error:
        connection.send(("error", error.message, error.remedy))
        return 1
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return 1
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stdout.flush()
    os._exit(code)
