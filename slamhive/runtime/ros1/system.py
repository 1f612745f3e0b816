"""A package's description of a ROS 1 system: its start, and the topics that hold its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from slamhive.runtime.point_times import PointTimes, TimeReference
from slamhive.runtime.ros_poses import PoseKind as PoseKind  # noqa: PLC0414 - packages take it from here
from slamhive.runtime.ros_poses import PoseTopic
from slamhive.runtime.trajectory import Poses

SAVING_PATIENCE_S = 45.0
"""How long nodes may take to save their results at the end; then they are killed."""


@dataclass(frozen=True, eq=False)
class FiledResults:
    """Files that the nodes saved at their end; None where there is nothing of the kind.

    Attributes:
        poses: The final trajectory, for ``traj.txt``; the poses of the topic then go to ``traj.live.txt``.
        keyframes: The trajectory of the keyframes, for ``keyframe.txt``.
        map_points_m: The points of the map, (n, 3), m.
    """

    poses: Poses
    keyframes: Poses | None = None
    map_points_m: Any = None


@dataclass(frozen=True)
class Ros1System:
    """One system with the settings of one run.

    Attributes:
        launch: The launch file. It declares an argument for each role, the topic to listen to.
        poses: Where the poses come from.
        keyframes: Where the poses of the keyframes come from, with all that was corrected since, for ``keyframe.txt``.
        frames: The role whose messages are the frames of ``frames.csv``.
        arguments: More arguments of the launch file.
        parameters: Set on the parameter server before the nodes start; a mapping becomes a namespace.
        pose_delay_s: How long after the timestamp of its message a pose holds, in s.
        R_system_sensor: (3, 3) from the axes of the sensor to those in which the system states poses and map. LOAM has
            x to the left, y up and z forward.
        every_frame: Each frame should give a pose. Frames without one, after the first pose, were then dropped inside.
        processed: A topic with the header (``std_msgs/Header``) of each frame that the system is through with. It
            separates dropped frames from lost ones; without it, the poses decide.
        results: Reads what the nodes saved, after their end.
        drop_lines: Regular expressions of the lines by which nodes report a frame that they drop.
        map_topic: A ``PointCloud2`` with the map, whose last message becomes ``Map.pcd``.
        about: What ``about.json`` says: package, version and files used.
    """

    launch: Path
    poses: PoseTopic
    frames: str
    arguments: Mapping[str, str | int | float | bool] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    pose_delay_s: float = 0.0
    R_system_sensor: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    every_frame: bool = True
    processed: str = ""
    results: Callable[[], FiledResults] | None = None
    drop_lines: tuple[str, ...] = ()
    map_topic: str | None = None
    keyframes: PoseTopic | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


def launch_command(system: Ros1System, remap: Mapping[str, str], *, only_names: bool = False) -> list[str]:
    """The ``roslaunch`` command: all nodes print to its output; with ``only_names`` it lists them instead.

    ``remap`` is the run's ``algorithm-remap``.
    """
    given = {**remap, **system.arguments}
    running = ["--screen", "--no-summary", "--skip-log-check", f"--sigint-timeout={SAVING_PATIENCE_S:g}"]
    options = ["--nodes"] if only_names else running
    return ["roslaunch", *options, str(system.launch), *(f"{key}:={_plain(value)}" for key, value in given.items())]


def _plain(value: str | float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


# How the points of a LiDAR state ring and time, for ROS nodes: the parameters that ``slamhive/sweep.h`` reads.


NAMESPACE = "/slamhive/sweep"


def sweep_times(values: Mapping[str, Any], role: str = "points") -> PointTimes:
    """Times of the points of the LiDAR in ``role``, from the parameters of a run."""
    return PointTimes.of(values, float(values[f"{role}_rate_hz"]), role, f"{role}_")


def sweep_parameters(values: Mapping[str, Any], *, rotation: str = "clockwise", role: str = "points") -> dict[str, Any]:
    """The parameters of the LiDAR in ``role``.

    ``rotation`` is the direction in which it turns, seen from above: ``clockwise`` or ``counter-clockwise``. Nodes use
    it for points without a time.
    """
    times = sweep_times(values, role)
    since_start_s = times.stamp.fraction * times.scan_duration_s
    return {
        NAMESPACE: {
            "ring_field": str(values.get(f"{role}_ring_field", "")),
            "time_field": times.field,
            "time_unit_s": times.unit.seconds,
            "time_zero_s": since_start_s if times.reference is TimeReference.TIMESTAMP else 0.0,
            "absolute": times.reference is TimeReference.ABSOLUTE,
            "duration_s": times.scan_duration_s,
            "stamp_fraction": times.stamp.fraction,
            "clockwise": rotation == "clockwise",
        }
    }


def middle_delay_s(values: Mapping[str, Any], role: str = "points") -> float:
    """Time from the timestamp of a message to the middle of its sweep, in s."""
    times = sweep_times(values, role)
    return times.start_s(0.0) + 0.5 * times.scan_duration_s
