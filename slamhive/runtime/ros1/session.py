"""One run from the start of roscore to the end of all programs."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import rosbag
import rosgraph

from slamhive.base.errors import InvalidInput
from slamhive.runtime.config import RunConfig
from slamhive.runtime.paths import RunPaths
from slamhive.runtime.progress import Progress, say
from slamhive.runtime.ros1.programs import NodeWatch, Program, SystemFailed, children_cpu_s
from slamhive.runtime.ros1.recorder import Recorder
from slamhive.runtime.ros1.system import SAVING_PATIENCE_S, Ros1System, launch_command
from slamhive.runtime.ros1.timing import BagFrame, PlayedClock
from slamhive.runtime.ros_poses import PoseLog

if TYPE_CHECKING:
    from types import TracebackType

MASTER_URI = "http://127.0.0.1:11311"
START_PATIENCE_S = 60.0
"""How long roscore and the nodes may take to start."""
SETTLED_S = 0.5
"""The nodes are ready when nothing of the graph has changed for so long."""
QUIET_S = 2.0
"""The run is over when no pose has come for so long after the end of the recording."""
BUSY_S = 10.0
"""The same for systems that say which frames they are through with, while frames are left."""
DRAIN_PATIENCE_S = 60.0
STOP_PATIENCE_S = SAVING_PATIENCE_S + 10.0
_STEP_S = 0.05


@dataclass(frozen=True)
class Played:
    """Remains of a run."""

    frames: Sequence[BagFrame]
    poses: PoseLog
    arrivals: Sequence[tuple[float, float]]
    clock: PlayedClock
    statistics: Sequence[Any]
    dropped_by_nodes: int
    player_cpu_s: float
    map_points_m: Any
    keyframes: PoseLog | None


class Session:
    """The programs of one run; use as a context manager, which ends them all."""

    def __init__(self, system: Ros1System, config: RunConfig, recording: Path, paths: RunPaths) -> None:
        self._system = system
        self._config = config
        self._paths = paths
        self._frames = bag_frames(recording, config.topic_in_bag(system.frames))
        self._progress = Progress(paths.result / "progress.json", len(self._frames))
        self._nodes = NodeWatch(system.drop_lines, say)
        self._programs: list[Program] = []
        self._seen = 0
        self._environment = ros_environment()
        os.environ.update(self._environment)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for program in reversed(self._programs):
            program.stop(STOP_PATIENCE_S)

    def start(self) -> None:
        """Start roscore and the nodes; returns when all are there and listen. Raises SystemFailed."""
        command = launch_command(self._system, self._config.algorithm_remap, only_names=True)
        listed = subprocess.run(command, capture_output=True, text=True, check=False)
        if listed.returncode != 0:
            words = (listed.stderr or listed.stdout).strip().splitlines() or ["no output"]
            raise InvalidInput(f"{self._system.launch} cannot be launched: {words[-1]}")
        names = listed.stdout.split()
        self._run("roscore", ["roscore"], lambda _line: None)
        master = rosgraph.Master("/slamhive")
        self._wait("roscore", master.is_online)
        self._recorder = Recorder(self._system, self._system.parameters)
        launch = launch_command(self._system, self._config.algorithm_remap)
        self._run("roslaunch", launch, self._nodes.take)
        topics = list(self._config.algorithm_remap.values())
        until_s = time.monotonic() + START_PATIENCE_S
        graph, since_s = self._recorder.graph(), time.monotonic()
        while True:
            self._check(*self._programs)
            missing = self._recorder.missing(names, topics)
            if (now := self._recorder.graph()) != graph:
                graph, since_s = now, time.monotonic()
            if not missing and time.monotonic() - since_s > SETTLED_S:
                say(f"{len(names)} nodes are ready")
                return
            if time.monotonic() > until_s:
                what = missing[0] if missing else "an unchanging graph"
                raise SystemFailed(f"after {START_PATIENCE_S:g} s there is no {what.removeprefix('a ')}")
            time.sleep(_STEP_S)

    def play(self) -> Played:
        """Play the recording to its end, and wait for the last poses. Raises SystemFailed."""
        # What has ended until now is not part of the player's time.
        cpu_before_s = children_cpu_s()
        script = self._paths.dataset / "rosbag_play.py"
        if not script.is_file():
            raise InvalidInput(f"dataset {self._config.dataset} has no rosbag_play.py", "import it again")
        topics = [self._config.topic_in_bag(role) for role in self._config.algorithm_remap]
        command = [sys.executable, str(script), "--quiet", "--wait-for-subscribers", "--topics", *topics]
        player = self._run("rosbag play", command, _say_unless_running)
        while player.exit_code is None:
            self._check(*self._programs[:-1])
            self._report()
            time.sleep(_STEP_S)
        if player.exit_code:
            player.check_running()
        player_cpu_s = children_cpu_s() - cpu_before_s
        if self._recorder.bag_time_s is None:
            raise SystemFailed(f"rosbag play played nothing: {player.last_line or 'no output'}")
        # Until no pose has come for a while: slow systems still work on what they have.
        ticking = self._recorder.run_clock_on(self._config.playback_rate)
        seen, since_s = -1, time.monotonic()
        until_s = since_s + DRAIN_PATIENCE_S
        while time.monotonic() - since_s < self._patience_s() and time.monotonic() < until_s:
            self._check(*self._programs[:-1])
            ticking.tick()
            arrived = len(self._recorder.arrivals)
            if arrived != seen:
                seen, since_s = arrived, time.monotonic()
            time.sleep(_STEP_S / 5)
        self._progress.end(len(self._frames))
        clock, map_points_m = self._recorder.clock, self._recorder.map_points_m()
        self._recorder.close()
        return Played(
            self._frames,
            self._recorder.poses,
            tuple(self._recorder.arrivals),
            clock,
            tuple(self._recorder.statistics),
            self._nodes.dropped,
            player_cpu_s,
            map_points_m,
            self._recorder.keyframes,
        )

    def _run(self, name: str, command: Sequence[str], take: Callable[[str], None]) -> Program:
        program = Program(name, command, take, {**os.environ, **self._environment})
        self._programs.append(program)
        return program

    def _wait(self, name: str, ready: Callable[[], bool]) -> None:
        until_s = time.monotonic() + START_PATIENCE_S
        while not ready():
            self._check(*self._programs)
            if time.monotonic() > until_s:
                raise SystemFailed(f"{name} did not start within {START_PATIENCE_S:g} s")
            time.sleep(_STEP_S)

    def _check(self, *programs: Program) -> None:
        self._nodes.check()
        for program in programs:
            program.check_running()

    def _report(self) -> None:
        now_s = self._recorder.bag_time_s
        if now_s is None:
            return
        first_s, last_s = self._frames[0].recorded_s, self._frames[-1].recorded_s
        over = sum(frame.recorded_s <= now_s for frame in self._frames)
        fraction = min(1.0, max(0.0, (now_s - first_s) / max(last_s - first_s, 1e-9)))
        poses = len(self._recorder.poses.arrivals)
        self._progress.update(over, now_s, fraction, self._nodes.dropped, poses > self._seen)
        self._seen = poses

    def _patience_s(self) -> float:
        """Time to wait for the next pose after the end of the recording."""
        last_s = max((stamp_s for stamp_s, _ in self._recorder.arrivals), default=0.0)
        return BUSY_S if self._system.processed and last_s < self._frames[-1].stamp_s else QUIET_S


def ros_environment() -> dict[str, str]:
    """Environment of ROS programs in a container without a network, whatever user they have."""
    os.environ.pop("ROS_HOSTNAME", None)
    home = Path(os.environ.get("TMPDIR", "/tmp")) / "ros"  # noqa: S108 - the container's own
    return {
        "ROS_MASTER_URI": MASTER_URI,
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(home),
        "ROS_LOG_DIR": str(home / "log"),
        "LOGNAME": os.environ.get("LOGNAME", "slamhive"),
    }


def _say_unless_running(line: str) -> None:
    if "[RUNNING]" not in line:
        say(line)


# The frames of the recording.


_HEADER = struct.Struct("<III")
"""How every message with a header begins: sequence number, seconds and nanoseconds of its timestamp."""


def bag_frames(recording: Path, topic: str) -> list[BagFrame]:
    """All messages of ``topic`` in the order of recording. Raises InvalidInput for a damaged bag."""
    frames = []
    try:
        with rosbag.Bag(str(recording)) as bag:
            for _, raw, recorded in bag.read_messages(topics=[topic], raw=True):
                _, seconds, nanoseconds = _HEADER.unpack_from(raw[1])
                frames.append(BagFrame(seconds + nanoseconds * 1e-9, recorded.to_sec()))
    except (rosbag.ROSBagException, struct.error, OSError, ValueError) as error:
        raise InvalidInput(f"{recording} cannot be read as a ROS 1 bag: {error}", "import it again") from None
    if not frames:
        raise InvalidInput(f"{recording.name} has no messages on {topic}", "correct the topic in dataset.yaml")
    return frames
