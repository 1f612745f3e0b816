"""The main program of a ``mapping.py`` of a ROS 1 system.

Example::

    if __name__ == "__main__":
        sys.exit(run(make))

where ``make`` takes the configuration of the run and returns a :class:`~slamhive.runtime.ros1.system.Ros1System`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamhive.base.errors import InvalidInput
from slamhive.base.files import write_aside
from slamhive.runtime.config import RunConfig, load
from slamhive.runtime.frames import write_frames_csv
from slamhive.runtime.paths import RunPaths, find_recording
from slamhive.runtime.pcd import write_pcd
from slamhive.runtime.program import run_program
from slamhive.runtime.progress import json_text, say
from slamhive.runtime.ros1.programs import SystemFailed
from slamhive.runtime.ros1.system import FiledResults, Ros1System
from slamhive.runtime.ros1.timing import frame_times, queue_drops
from slamhive.runtime.ros_poses import PoseLog, in_sensor_axes
from slamhive.runtime.trajectory import Poses, write_trajectory

if TYPE_CHECKING:
    from slamhive.runtime.ros1.session import Played

MakeSystem = Callable[[RunConfig], Ros1System]


def run(make: MakeSystem) -> int:
    """Run the system that ``make`` describes; returns the exit code. Each known error is one line on stderr."""
    return run_program(lambda paths: _run(make, paths))


def _run(make: MakeSystem, paths: RunPaths) -> None:
    config = load(paths.config)
    recording = find_recording(paths.dataset)
    if recording.suffix != ".bag" or config.playback_mode != "realtime":
        raise InvalidInput(
            f"{recording.name} cannot be played {config.playback_mode} by rosbag play",
            "it plays ROS 1 bags in real time",
        )
    system = make(config)
    write_aside(paths.result / "about.json", json_text(dict(system.about)))
    from slamhive.runtime.ros1.session import Session  # noqa: PLC0415 - only images of ROS can import it

    with Session(system, config, recording, paths) as session:
        session.start()
        played = session.play()
    every = system.every_frame or bool(system.processed)
    lines = frame_times(played.frames, played.arrivals, played.clock, config.playback_rate, every=every)
    write_frames_csv(paths.result / "frames.csv", lines)
    summary = {
        "cpu_s": played.player_cpu_s,
        "lag_max_s": max(0.0, played.clock.lag_max_s(config.playback_rate)),
        "began_at_s": time.time() - (time.monotonic() - played.clock.start_s),
        "dropped_by_nodes": played.dropped_by_nodes,
        "queues": queue_drops(played.statistics),
    }
    write_aside(paths.result / "playback.json", json_text(summary))
    filed = _filed_results(system, played, paths.result)
    if filed.map_points_m is not None and config.general_parameter.get("save_map"):
        write_pcd(paths.result / "Map.pcd", filed.map_points_m)
    if filed.keyframes is not None and len(filed.keyframes.stamps_s):
        write_trajectory(paths.result / "keyframe.txt", filed.keyframes)
    write_trajectory(paths.result / "traj.txt", filed.poses)
    in_queues = sum(queue["dropped"] for queue in summary["queues"])  # type: ignore[attr-defined]
    say(
        f"done: {len(filed.poses.stamps_s)} poses from {len(lines)} frames; dropped in queues: {in_queues}, "
        f"reported by nodes: {played.dropped_by_nodes}"
    )
    write_aside(paths.result / "finished", "")


def _filed_results(system: Ros1System, played: Played, result: Path) -> FiledResults:
    """The results that the nodes saved; for nodes that save nothing what their topics held."""
    live = _published(system, played.poses)
    if system.results is None:
        keyframes = None if played.keyframes is None else _published(system, played.keyframes)
        points_m = played.map_points_m
        return FiledResults(live, keyframes, None if points_m is None else points_m @ np.array(system.R_system_sensor))
    filed = system.results()
    if len(live.stamps_s) and not len(filed.poses.stamps_s):
        published = f"the nodes published {len(live.stamps_s)} poses, but saved no trajectory"
        raise SystemFailed(f"{published}: they were killed, or had lost their map at the end")
    write_trajectory(result / "traj.live.txt", live)
    return filed


def _published(system: Ros1System, log: PoseLog) -> Poses:
    """The poses of a topic, with the time and in the axes of the sensor."""
    poses = log.poses
    T = in_sensor_axes(poses.T_world_sensor, np.array(system.R_system_sensor))
    return Poses(poses.stamps_s + system.pose_delay_s, T)
