"""Rows with more than a pose: which columns hold it, by name, by number, or as the user says."""

import random

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.trajectory.layout import UNKNOWN, TimeUnit
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.pose_file import (
    SYSTEMS,
    PoseFile,
    TrajectoryFormat,
    find_columns,
    read_pose_file,
    stated_columns,
)
from tests.cases import case
from tests.fuzzing import mutated

ANGLES = np.linspace(0.1, 1.5, 30)
POSITIONS_M = np.column_stack((5 * np.cos(ANGLES), 5 * np.sin(ANGLES), 0.1 * ANGLES))
XYZW = np.column_stack((0 * ANGLES, 0 * ANGLES, np.sin(ANGLES / 2), np.cos(ANGLES / 2)))
TIMES_S = 1_500_000_000 + 0.5 * np.arange(30)
TUM = np.column_stack((TIMES_S, POSITIONS_M, XYZW))


def rows(values, header="", separator=" "):
    lines = [separator.join(f"{number:.9f}" for number in row) for row in values.tolist()]
    return "\n".join([*([header] if header else []), *lines]) + "\n"


def matrices():
    c, s, zero = np.cos(ANGLES), np.sin(ANGLES), 0 * ANGLES
    x, y, z = POSITIONS_M.T
    return np.column_stack((TIMES_S, c, -s, zero, x, s, c, zero, y, zero, zero, zero + 1, z))


def extra(count):
    return np.column_stack((TUM, np.tile(np.arange(count) * 0.3, (30, 1))))


def numbered(values):
    return np.column_stack((np.arange(30), values))


def in_ns(values):
    return np.column_stack((values[:, 0] * 1e9, values[:, 1:]))


VELOCITIES = ", v_WS_W_x, v_WS_W_y, v_WS_W_z, b_g_x, b_g_y, b_g_z, b_a_x, b_a_y, b_a_z"
OKVIS2 = "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w" + VELOCITIES
FILES = {
    "openvins of 14": rows(extra(6)),
    "openvins of 20": rows(extra(12)),
    "rtab-map": rows(np.column_stack((TUM, np.arange(30))), "#timestamp x y z qx qy qz qw id"),
    "okvis2": rows(in_ns(extra(9)), OKVIS2, ", "),
    "header without #": rows(TUM, "timestamp,tx,ty,tz,qx,qy,qz,qw", ","),
    "mcd": rows(numbered(TUM), "num,t,x,y,z,qx,qy,qz,qw", ","),
    "w first by name": rows(extra(1)[:, [0, 1, 2, 3, 7, 4, 5, 6, 8]], "# t[s] x y z q_w q_x q_y q_z score"),
    "quaternion before the position": rows(TUM[:, [0, 4, 5, 6, 7, 1, 2, 3]], "# time qx qy qz qw px py pz"),
    "ros": rows(
        TUM,
        "stamp,pose.position.x,pose.position.y,pose.position.z,"
        "pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w",
        ",",
    ),
    "kitti with times": rows(matrices()),
    "kimera": rows(
        in_ns(extra(9)[:, [0, 1, 2, 3, 7, 4, 5, 6, *range(8, 17)]]),
        "#timestamp,x,y,z,qw,qx,qy,qz,vx,vy,vz,bgx,bgy,bgz,bax,bay,baz",
        ",",
    ),
    "vins, with a comma at the end": rows(
        in_ns(extra(3)[:, [0, 1, 2, 3, 7, 4, 5, 6, 8, 9, 10]]), separator=","
    ).replace("\n", ",\n"),
    "mulran": rows(in_ns(matrices()), separator=","),
    "plain": rows(TUM),
}


def read(tmp_path, text, columns=None) -> PoseFile:
    path = tmp_path / "poses.txt"
    path.write_text(text)
    return read_pose_file(path, TrajectoryFormat.AUTO, None, columns=columns)


def trajectory_of(file: PoseFile) -> Trajectory | None:
    unit = file.unit(UNKNOWN, None).value
    order = None if unit is None else file.order(UNKNOWN, unit, {}).value
    return None if unit is None or order is None else file.raw.trajectory(unit, order)


def assert_is_the_trajectory(file: PoseFile) -> None:
    found = trajectory_of(file)
    assert found is not None
    assert found.stamps_s == pytest.approx(TIMES_S, abs=1e-5)
    assert found.positions_m == pytest.approx(POSITIONS_M, abs=1e-8)
    assert found.quats_xyzw == pytest.approx(XYZW, abs=1e-8)


@pytest.mark.parametrize("name", FILES)
def test_poses_are_found_among_other_columns(tmp_path, name):
    file = read(tmp_path, FILES[name])
    assert_is_the_trajectory(file)
    assert (file.plain and file.format is TrajectoryFormat.TUM) is (name == "plain")


@pytest.mark.parametrize("name", FILES)
def test_mutated_files_are_read_or_refused_in_a_line(tmp_path, name):
    refused = set()
    for seed in range(40):
        path = tmp_path / "poses.txt"
        path.write_bytes(mutated(FILES[name].encode(), random.Random(f"{name}{seed}")))
        try:
            trajectory_of(read_pose_file(path, TrajectoryFormat.AUTO, None))
        except SlamHiveError as error:
            refused.add(str(error))
    assert len(refused) > 5
    assert not [text for text in refused if "\n" in text]


@pytest.mark.parametrize(
    ("columns", "order"),
    [
        ("t,x,y,z,qw,qx,qy,qz", [0, 1, 2, 3, 7, 4, 5, 6, 0]),
        ("-,t,x,y,z,qx,qy,qz,qw", [0, 0, 1, 2, 3, 4, 5, 6, 7]),
        ("qx,qy,qz,qw,t,z,y,x", [4, 5, 6, 7, 0, 3, 2, 1, 0]),
    ],
)
def test_columns_can_be_stated(tmp_path, columns, order):
    assert_is_the_trajectory(read(tmp_path, rows(TUM[:, order]), columns))


@pytest.mark.parametrize(
    ("columns", "problem"),
    [
        ("t,x,y", "lacks t, x, y, z, or a part of q"),
        ("t,x,y,z,qx,qy,qz", "lacks t, x, y, z, or a part of q"),
        ("t,x,y,z,qx,qy,qz,qw,-", "names 9 of 8 columns"),
        ("", "lacks t, x, y, z"),
    ],
)
def test_columns_that_are_no_pose_are_refused(columns, problem):
    with pytest.raises(InvalidInput, match=problem):
        stated_columns(columns, 8)


@pytest.mark.parametrize("count", [9, 13, 14, 20])
def test_a_count_alone_is_no_evidence(count):
    values = np.column_stack((TIMES_S, np.random.default_rng(1).normal(0, 300, (30, count - 1))))
    assert count in SYSTEMS
    assert find_columns(rows(values).encode()) is None


def test_a_first_line_that_names_no_pose_is_an_error(tmp_path):
    with pytest.raises(InvalidInput, match="line 1: 'latitude' is not a number"):
        read(tmp_path, "latitude,longitude\n" + rows(TUM, separator=","))


@pytest.mark.parametrize("place", ["openvins/gore", "okvis2/s", "rtab/s", "rosexp/s", "openvins/iron", "basalt/s"])
def test_real_trajectories_of_common_systems_are_read(place):
    file = read_pose_file(case("trajectory_columns") / place / "1.txt", TrajectoryFormat.AUTO, None)
    assert file.unit(UNKNOWN, None).value is (TimeUnit.NS if place in {"okvis2/s", "basalt/s"} else TimeUnit.S)
    assert len(file.raw.times) > 50
