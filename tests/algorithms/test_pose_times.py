"""Every package states the instant that its poses describe, and its code holds to it."""

from __future__ import annotations

import ast
import re

import pytest

from slamhive.base.project import project_root
from slamhive.domain.algorithm import Algorithm
from slamhive.domain.protocol import PoseTime
from slamhive.domain.sensors import SensorKind
from slamhive.packages.algorithm_file import load_algorithms
from tests.algorithms.algorithm_runs import load_module
from tests.algorithms.recorded_configs import config_of

pytestmark = pytest.mark.quick

FOLDERS = sorted(path.parent for path in (project_root() / "algorithms").glob("*/algorithm.yaml"))
SHIPPED = [algorithm for folder in FOLDERS for algorithm in load_algorithms(folder)]
SINCE_START_S = {PoseTime.SWEEP_START: 0.0, PoseTime.SWEEP_MIDDLE: 0.05, PoseTime.SWEEP_END: 0.1}


def of_package(name: str) -> list[Algorithm]:
    return [algorithm for algorithm in SHIPPED if algorithm.package.name == name]


def script_of(algorithm: Algorithm) -> str:
    return (algorithm.package.folder / "slamhive" / "mapping.py").read_text()


@pytest.mark.parametrize("algorithm", SHIPPED, ids=lambda algorithm: algorithm.name)
def test_each_package_states_trajectory_and_time(algorithm: Algorithm) -> None:
    assert algorithm.trajectory is not None
    assert algorithm.pose_time is not None
    lidar = any(entry.kind is SensorKind.LIDAR for entry in algorithm.inputs)
    assert (algorithm.pose_time is PoseTime.MESSAGE) != lidar


@pytest.mark.parametrize("name", ["aloam", "loam", "lego-loam", "lio-sam"])
def test_systems_for_ros1_get_that_delay(name: str) -> None:
    """The timestamp of a sweep of the room is its start, and a sweep takes 0.1 s."""
    (algorithm,) = of_package(name)
    assert algorithm.pose_time is not None
    delay_s = load_module(name, "mapping").make(config_of(name, name, "room")).pose_delay_s
    assert delay_s == pytest.approx(SINCE_START_S[algorithm.pose_time])


def test_adapters_of_libraries_use_that_instant() -> None:
    adapters = [algorithm for algorithm in SHIPPED if "scan_odometry" in script_of(algorithm)]
    assert len(adapters) >= 10
    for algorithm in adapters:
        if algorithm.package.name == "evalio":
            continue
        stated = re.search(r"^    pose_at = SweepInstant\.(\w+)$", script_of(algorithm), re.MULTILINE)
        expected = f"sweep_{stated[1].lower()}" if stated else "sweep_end"
        assert algorithm.pose_time == expected, algorithm.name


def test_pipelines_of_evalio_use_that_instant() -> None:
    algorithms = of_package("evalio")
    tree = ast.parse(script_of(algorithms[0]))
    stated = {
        key.value: value.elts[1].attr.lower()
        for node in ast.walk(tree)
        if isinstance(node, ast.Dict)
        for key, value in zip(node.keys, node.values, strict=True)
        if isinstance(key, ast.Constant) and isinstance(value, ast.Tuple) and isinstance(value.elts[1], ast.Attribute)
    }
    assert {entry.name: entry.pose_time for entry in algorithms} == {
        name: PoseTime(f"sweep_{instant}") for name, instant in stated.items()
    }
