"""What a package says of a ROS 1 system: how to start it, and which topics hold its results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any


class PoseKind(StrEnum):
    """The message types from which poses are read."""

    ODOMETRY = "nav_msgs/Odometry"
    POSE = "geometry_msgs/PoseStamped"
    PATH = "nav_msgs/Path"
    """Each message is the whole trajectory so far; the last one counts."""
    TF = "tf2_msgs/TFMessage"
    """The pose of the frame ``child`` in the frame ``parent``, along the tree of frames."""


@dataclass(frozen=True, slots=True)
class PoseTopic:
    """Where poses come from. ``parent`` and ``child`` are for :attr:`PoseKind.TF` alone."""

    topic: str
    kind: PoseKind
    parent: str = ""
    child: str = ""


@dataclass(frozen=True)
class Ros1System:
    """One system with the settings of one run.

    Attributes:
        launch: The launch file. It declares an argument for each role, the topic to listen to.
        poses: Where the poses come from.
        frames: The role whose messages are the frames of ``frames.csv``.
        arguments: More arguments of the launch file.
        parameters: Set on the parameter server before the nodes start; a mapping becomes a namespace.
        pose_delay_s: How long after the timestamp of its message a pose holds, in s.
        every_frame: Each frame should give a pose. Frames without one, after the first pose, were then dropped inside.
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
    every_frame: bool = True
    drop_lines: tuple[str, ...] = ()
    map_topic: str | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


def launch_command(system: Ros1System, remap: Mapping[str, str], *, only_names: bool = False) -> list[str]:
    """The ``roslaunch`` command: all nodes print to its output; with ``only_names`` it lists them instead.

    ``remap`` is the run's ``algorithm-remap``.
    """
    given = {**remap, **system.arguments}
    options = ["--nodes"] if only_names else ["--screen", "--no-summary", "--skip-log-check"]
    return ["roslaunch", *options, str(system.launch), *(f"{key}:={_plain(value)}" for key, value in given.items())]


def _plain(value: str | float | bool) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
