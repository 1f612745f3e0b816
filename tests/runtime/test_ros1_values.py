"""What a run of a ROS 1 system makes of messages, clocks and lines of output; none of it needs ROS."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest

from slamhive.runtime.ros1.programs import NodeWatch, SystemFailed
from slamhive.runtime.ros1.system import (
    NAMESPACE,
    PoseKind,
    PoseTopic,
    Ros1System,
    launch_command,
    middle_delay_s,
    sweep_parameters,
)
from slamhive.runtime.ros1.timing import BagFrame, PlayedClock, frame_times, queue_drops
from slamhive.runtime.ros_poses import PoseLog, in_sensor_axes

QUARTER_TURN = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))


def header(stamp_s: float, frame: str = "map") -> Message:
    return Message(stamp=Message(to_sec=lambda: stamp_s), frame_id=frame)


def pose(x: float, quat: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)) -> Message:
    return Message(position=Message(x=x, y=0.0, z=0.0), orientation=Message(**dict(zip("xyzw", quat, strict=True))))


def edge(stamp_s: float, parent: str, child: str, x: float, quat: tuple[float, ...] = (0, 0, 0, 1)) -> Message:
    at = pose(x, quat)
    transform = Message(translation=at.position, rotation=at.orientation)
    return Message(header=header(stamp_s, parent), child_frame_id=child, transform=transform)


def log_of(kind: PoseKind, *messages: Any, **frames: str) -> PoseLog:
    log = PoseLog(PoseTopic("/poses", kind, **frames))
    for number, message in enumerate(messages):
        log.add(message, 100.0 + number)
    return log


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (PoseKind.ODOMETRY, Message(header=header(5.0), pose=Message(pose=pose(1.5, QUARTER_TURN)))),
        (PoseKind.POSE, Message(header=header(5.0), pose=pose(1.5, QUARTER_TURN))),
    ],
)
def test_a_pose_is_read_from_messages_with_one(kind: PoseKind, message: Message) -> None:
    log = log_of(kind, message)
    assert log.arrivals == [(5.0, 100.0)]
    assert log.poses.stamps_s.tolist() == [5.0]
    expected = np.array([[0, -1, 0, 1.5], [1, 0, 0, 0], [0, 0, 1, 0]])
    np.testing.assert_allclose(log.poses.T_world_sensor[0, :3], expected, atol=1e-12)


def test_the_last_path_is_the_trajectory_and_earlier_ones_say_when_poses_came() -> None:
    first = Message(poses=[Message(header=header(1.0), pose=pose(1.0))])
    second = Message(poses=[Message(header=header(stamp), pose=pose(stamp + 0.1)) for stamp in (1.0, 2.0)])
    log = log_of(PoseKind.PATH, Message(poses=[]), first, second)
    assert log.arrivals == [(1.0, 101.0), (2.0, 102.0)]
    np.testing.assert_allclose(log.poses.T_world_sensor[:, 0, 3], [1.1, 2.1])


def test_a_pose_along_the_tree_of_frames_uses_the_newest_of_each_edge() -> None:
    messages = [
        Message(transforms=[edge(1.0, "odom", "base", 1.0)]),  # nothing leads to the map yet
        Message(transforms=[edge(1.0, "/map", "/odom", 10.0, QUARTER_TURN)]),
        Message(transforms=[edge(2.0, "odom", "base", 2.0), edge(2.0, "base", "camera", 7.0)]),
    ]
    log = log_of(PoseKind.TF, *messages, parent="map", child="base")
    assert log.arrivals == [(2.0, 102.0)]
    np.testing.assert_allclose(log.poses.T_world_sensor[0, :3, 3], [10.0, 2.0, 0.0], atol=1e-12)


def test_a_circle_of_frames_ends() -> None:
    messages = [Message(transforms=[edge(1.0, "a", "b", 1.0)]), Message(transforms=[edge(1.0, "b", "a", 1.0)])]
    assert log_of(PoseKind.TF, *messages, parent="map", child="a").arrivals == []


def test_poses_in_the_axes_of_loam_are_turned_to_those_of_the_sensor() -> None:
    loam = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    T_system = np.eye(4)
    T_system[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # a quarter turn about LOAM's y, which points up
    T_system[:3, 3] = [0.2, 0.3, 1.0]  # 0.2 m to the left, 0.3 m up, 1 m forward
    expected = np.array([[0, -1, 0, 1.0], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    np.testing.assert_allclose(in_sensor_axes(T_system[None], loam)[0], expected, atol=1e-12)


FRAMES = [BagFrame(stamp_s, stamp_s + 0.02) for stamp_s in (10.0, 10.1, 10.2, 10.3)]
CLOCK = PlayedClock([50.0, 51.0, 52.5], [10.0, 10.5, 11.0])
"""Played at half the rate; the second half came half a second late."""


def test_latency_is_from_the_playing_of_a_message_to_its_pose() -> None:
    poses = [(10.1005, 50.44), (10.1, 50.9), (10.3, 50.0), (99.0, 60.0)]
    lines = frame_times(FRAMES, poses, CLOCK, 0.5, every=True)
    assert [round(line.received_s, 6) for line in lines] == [0.04, 0.24, 0.44, 0.64]
    assert lines[1].done_s == pytest.approx(0.44)
    assert lines[3].done_s == lines[3].received_s, "a pose before its message would be a negative latency"


def test_only_a_system_that_answers_every_frame_has_dropped_the_silent_ones() -> None:
    poses = [(10.1, 50.5), (10.3, 51.0)]
    assert [line.silent for line in frame_times(FRAMES, poses, CLOCK, 0.5, every=True)] == [True, False, False, False]
    assert [line.silent for line in frame_times(FRAMES, poses, CLOCK, 0.5, every=False)] == [True, False, True, False]
    assert all(line.silent for line in frame_times(FRAMES, [], CLOCK, 0.5, every=True))


def test_lag_is_measured_against_the_first_messages() -> None:
    assert CLOCK.lag_max_s(0.5) == pytest.approx(0.5)
    assert PlayedClock([1.0], [3.0]).lag_max_s(1.0) == 0.0


def test_drops_are_added_up_for_each_queue() -> None:
    def counted(delivered: int, dropped: int) -> Message:
        return Message(
            topic="/points", node_pub="/play", node_sub="/scan", delivered_msgs=delivered, dropped_msgs=dropped
        )

    (queue,) = queue_drops([counted(10, 1), counted(9, 2)])
    assert queue == {"topic": "/points", "from": "/play", "to": "/scan", "delivered": 19, "dropped": 3}


def test_a_node_that_died_is_named_with_how_it_ended() -> None:
    printed: list[str] = []
    watch = NodeWatch(["^drop lidar"], printed.append)
    for line in ("[mapping-3] process has finished cleanly", "drop lidar frame", "I drop lidar frame"):
        watch.take(line)
    watch.check()
    assert watch.dropped == 1
    watch.take("[ns/mapping-3] process has died [pid 90, exit code -11, cmd /opt/ros1/x __name:=mapping].")
    with pytest.raises(SystemFailed, match=r"the node ns/mapping-3 died \(signal SIGSEGV\)"):
        watch.check()
    assert len(printed) == 4


def test_roles_and_settings_become_arguments_of_the_launch_file() -> None:
    source = PoseTopic("/odom", PoseKind.ODOMETRY)
    system = Ros1System(Path("/slamhive/a.launch"), source, "points", arguments={"deskew": True, "rate": 0.5})
    command = launch_command(system, {"points": "/points"})
    assert command[0] == "roslaunch"
    assert command[-4:] == ["/slamhive/a.launch", "points:=/points", "deskew:=true", "rate:=0.5"]
    assert launch_command(system, {}, only_names=True)[:3] == ["roslaunch", "--nodes", "/slamhive/a.launch"]


@pytest.mark.parametrize(
    ("keys", "zero_s", "absolute", "middle_s"),
    [
        ({}, 0.0, False, 0.05),
        ({"points_stamp": "end", "points_point_time_reference": "timestamp"}, 0.1, False, -0.05),
        ({"points_stamp": "end"}, 0.0, False, -0.05),
        ({"points_point_time_reference": "absolute", "points_point_time_unit": "ns"}, 0.0, True, 0.05),
    ],
)
def test_nodes_learn_how_the_points_state_their_time(
    keys: dict[str, Any], zero_s: float, absolute: bool, middle_s: float
) -> None:
    values = {"points_rate_hz": 10.0, "points_ring_field": "ring", "points_point_time_field": "time", **keys}
    parameters = sweep_parameters(values, rotation="counter-clockwise")[NAMESPACE]
    assert parameters["time_zero_s"] == pytest.approx(zero_s)
    assert parameters["absolute"] is absolute
    assert (parameters["ring_field"], parameters["time_field"]) == ("ring", "time")
    assert parameters["time_unit_s"] == (1e-9 if absolute else 1.0)
    assert middle_delay_s(values) == pytest.approx(middle_s)
