"""The templates for ROS systems: valid packages, whose files are what the documentation says of them."""

from __future__ import annotations

import ast
import importlib.util
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.algorithm import Base
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.image_context import stage_context
from slamhive.runtime.config import RunConfig

pytestmark = pytest.mark.quick

EXTEND = project_root() / "docs" / "extend"
ROS1, ROS2 = EXTEND / "ros1-template", EXTEND / "ros2-template"


def module_at(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("folder", [ROS1, ROS2], ids=lambda folder: folder.name)
def test_a_template_is_a_package_whose_files_are_whole(folder: Path, tmp_path: Path) -> None:
    (algorithm,) = load_algorithms(folder)
    context = stage_context(algorithm.package, project_root(), tmp_path / "context", tmp_path, {})
    lines = (context.path / context.dockerfile).read_text().splitlines()
    sources = [part for line in lines if line.startswith("COPY ") for part in line.split()[1:-1]]
    assert all((context.path / source).exists() for source in sources)
    for path in folder.rglob("*.py"):
        ast.parse(path.read_text(), str(path))
    readme = (folder / "README.md").read_text()
    for path in (folder / "slamhive").iterdir():
        assert path.name == "__pycache__" or path.name in readme


def test_the_launch_file_of_ros1_has_an_argument_for_each_role_and_a_node_that_is_there() -> None:
    (algorithm,) = load_algorithms(ROS1)
    assert algorithm.package.base is Base.ROS1
    launch = ET.parse(ROS1 / "slamhive" / "my_slam.launch").getroot()
    assert {entry.get("name") for entry in launch.iter("arg")} == {entry.role for entry in algorithm.inputs}
    (node,) = launch.iter("node")
    package = ET.parse(ROS1 / "nodes" / "package.xml").getroot()
    assert package.findtext("name") == node.get("pkg")
    assert (ROS1 / "nodes" / str(node.get("type"))).is_file()


def test_the_mapping_of_ros1_describes_the_system() -> None:
    system = module_at(ROS1 / "slamhive" / "mapping.py").make(
        RunConfig("my-slam", "room", algorithm_parameters={"gravity": 9.8, "settling": 0.2})
    )
    assert system.launch.is_file()
    assert system.parameters == {"/my_slam": {"gravity": 9.8, "settling": 0.2}}


def test_the_node_of_ros1_integrates_what_an_imu_measures(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("rospy", "geometry_msgs.msg", "sensor_msgs.msg", "tf2_msgs.msg"):
        stand_in = SimpleNamespace(TransformStamped=None, Imu=None, PointCloud2=None, TFMessage=None)
        monkeypatch.setitem(sys.modules, name, stand_in)
    node = module_at(ROS1 / "nodes" / "dead_reckoning.py")
    system = node.DeadReckoning(gravity=9.81, settling_s=0.1)
    tilt = node.rotation(np.array([0.3, 0.0, 0.0]))
    for number in range(21):
        system.add(number * 0.01, np.zeros(3), tilt.T @ [0.0, 0.0, 9.81])
    np.testing.assert_allclose(system.R_world_imu, tilt, atol=1e-9)
    assert list(system.found()) == []
    for stamp_s in (0.05, 0.1601, 0.5):
        system.want(SimpleNamespace(to_sec=lambda stamp_s=stamp_s: stamp_s))
    assert [stamp.to_sec() for stamp, _, _ in system.found()] == [0.1601]
    for number in range(21, 121):
        acceleration = system.R_world_imu.T @ [0.0, 0.0, 9.81] + [1.0, 0.0, 0.0]
        system.add(number * 0.01, np.array([0.5, 0.0, 0.0]), acceleration)
    np.testing.assert_allclose(system.R_world_imu, node.rotation(np.array([0.8, 0.0, 0.0])), atol=1e-9)
    (found,) = system.found()
    assert found[0].to_sec() == 0.5
    np.testing.assert_allclose(found[2], node.rotation(np.array([0.45, 0.0, 0.0])), atol=1e-9)
    assert system.position_m[0] == pytest.approx(0.5, rel=0.02)
    np.testing.assert_allclose(np.abs(node.quaternion_xyzw(tilt)), [np.sin(0.15), 0, 0, np.cos(0.15)], atol=1e-9)


def test_the_run_of_ros2_plays_what_the_configuration_names() -> None:
    run = module_at(ROS2 / "slamhive" / "ros2_run.py")
    config = RunConfig(
        "my-ros2-slam",
        "room",
        algorithm_remap={"points": "/points", "imu": "/imu"},
        dataset_remap={"/points": "/points", "/imu": "/imu0"},
        playback_rate=0.5,
    )
    played = run.play_command(config, Path("/slamhive/dataset/room"))
    assert played[played.index("--topics") :] == ["--topics", "/points", "/imu0", "--remap", "/imu0:=/imu"]
    assert played[played.index("--rate") + 1] == "0.5"
    assert run.launch_command(config, Path("/slamhive"))[3:] == ["points:=/points", "imu:=/imu"]
    with pytest.raises(InvalidInput, match="is a ROS 1 bag"):
        run.check_config(config, Path("room.bag"))
    shell = module_at(ROS2 / "slamhive" / "mapping.py").command("jazzy", Path("/slamhive/ros2_run.py"))
    assert shell[-1].startswith(". /opt/ros/jazzy/setup.sh && ")


def test_poses_of_ros2_are_read_from_each_type_of_message(monkeypatch: pytest.MonkeyPatch) -> None:
    run = module_at(ROS2 / "slamhive" / "ros2_run.py")
    header = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=500_000_000), frame_id="map")
    at, turned = SimpleNamespace(x=1.0, y=2.0, z=3.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(position=at, orientation=turned)
    moved = SimpleNamespace(translation=at, rotation=turned)
    stamped = SimpleNamespace(header=header, pose=pose)
    messages = {
        run.PoseKind.ODOMETRY: SimpleNamespace(header=header, pose=SimpleNamespace(pose=pose)),
        run.PoseKind.POSE: stamped,
        run.PoseKind.PATH: SimpleNamespace(poses=[stamped]),
        run.PoseKind.TF: SimpleNamespace(
            transforms=[SimpleNamespace(header=header, child_frame_id="imu", transform=moved)]
        ),
    }
    assert set(messages) == set(run.PoseKind)
    for kind, message in messages.items():
        found = run.PoseLog(run.PoseTopic("/poses", kind, parent="map", child="imu"))
        found.add(message, 7.0)
        assert found.poses.stamps_s.tolist() == [3.5]
        assert found.poses.T_world_sensor[0, :3, 3].tolist() == [1.0, 2.0, 3.0]
        package, _, name = kind.partition("/")
        monkeypatch.setitem(sys.modules, package, SimpleNamespace())
        monkeypatch.setitem(sys.modules, f"{package}.msg", SimpleNamespace(**{name: kind}))
        assert run.message_type(kind) is kind
