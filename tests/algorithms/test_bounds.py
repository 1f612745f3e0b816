"""Every package of the project, in its container, keeps the bounds that its ``algorithm.yaml`` states."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from slamhive.base.project import project_root
from slamhive.documents.submission import Submission
from slamhive.domain.algorithm import Base
from slamhive.domain.protocol import Alignment
from slamhive.domain.sensors import SensorKind
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.services.bounds import BoundTest, bound_tests
from slamhive.services.hive import Hive
from slamhive.trajectory.association import position_misfit
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.transforms import move_sensor, rigid_transform
from tests.algorithms.from_sources import NEEDS_SOURCES
from tests.real_datasets import dataset
from tests.sharing import one_at_a_time

pytestmark = [pytest.mark.integration, pytest.mark.docker]

WITH_IMAGES: dict[str, dict[str, Any]] = {"aloam-room": {}, "orb-slam2-stereo-kitti_06": {"queueSize": 1000}}
"""Of the systems that are compiled for ROS 1, what the tier ``images`` runs, with parameters for a busy machine.

The others are in the tier ``classical``, which plays in real time and needs an idle machine.
"""
SLOW_RATE = 0.15
"""So slow that the systems keep up while other tests use the cores."""

FEWEST_MAP_POINTS = 200
"""Sparse features of a room or a few metres of road are as many; most maps of a LiDAR have thousands."""
SHARE_ON_SURFACES = {SensorKind.LIDAR: 0.75, SensorKind.CAMERA: 0.5}
"""Least share of a map's points within 10 cm of a surface of the room. A LiDAR measures surfaces. Cameras triangulate,
and keep points of small parallax: at least every second one must be right."""
FARTHEST_MEAN_M = 0.75
"""Largest mean distance from the surfaces of the room (8 m x 6 m x 3 m) to the map. A map of one half of the room has
1.2 m, one of a single wall 1.4 m to 4 m."""

A_POSE_FOR_EACH_SCAN = {"icp-slam-2d", "yag-slam"}

LAGGING = {"loam", "lego-loam"}
"""The odometry of both goes 5 % of the way at each step, and ends at the first step below 0.1 degrees and 1 mm. So it
is late where the motion changes, and earlier timestamps fit better than those that the sources state."""


def all_tests() -> list[Any]:
    found = []
    for folder in sorted((project_root() / "algorithms").glob("*/algorithm.yaml")):
        algorithms = load_algorithms(folder.parent)
        compiled = algorithms[0].package.base is Base.ROS1
        tier = "classical" if compiled else "packages"
        for entry in bound_tests(algorithms):
            name = f"{entry.algorithm.name}-{entry.bound.dataset}"
            marks = [getattr(pytest.mark, "images" if name in WITH_IMAGES else tier)]
            found.append(pytest.param(entry, id=name, marks=[*marks, NEEDS_SOURCES] if compiled else marks))
    return found


@pytest.mark.timeout(7200)  # the first run of a package builds its image
@pytest.mark.parametrize("entry", all_tests())
def test_each_algorithm_keeps_its_bounds(systems: Hive, entry: BoundTest, request: pytest.FixtureRequest) -> None:
    dataset(systems, entry.bound.dataset)
    submission = entry.submission()
    has_map = any(parameter.key == "save_map" for parameter in entry.algorithm.parameters)
    if has_map:
        submission = replace(submission, parameters={**submission.parameters, "save_map": True})
    if request.node.get_closest_marker("images") is not None:
        parameters = {**submission.parameters, **WITH_IMAGES[f"{entry.algorithm.name}-{entry.bound.dataset}"]}
        submission = replace(submission, playback_rate=SLOW_RATE, parameters=parameters)
        with one_at_a_time(f"image-{entry.algorithm.package.name}"):
            systems.executors.get("docker").build(entry.algorithm.package, lambda _line: None)
    (queued,) = systems.runs.submit(submission)
    systems.worker(only=[queued.id]).run(until_idle=True)
    result = entry.result(systems.runs.get(queued.id))
    assert result.problem is None, f"{result.problem}\n{systems.runs.log(queued.id)[-2000:]}"
    if entry.algorithm.name in A_POSE_FOR_EACH_SCAN:
        assert systems.runs.get(queued.id).poses == entry.bound.poses
    if has_map:
        check_map(entry, systems.runs.get(queued.id).metrics or {})
    if entry.algorithm.package.name not in LAGGING and any(
        role.kind is SensorKind.LIDAR for role in entry.algorithm.inputs
    ):
        early_m, error_m, late_m = errors_at_shifts(systems, entry, queued.id)
        assert error_m < min(early_m, late_m), "the timestamps of the poses are not those of the sweeps"


def check_map(entry: BoundTest, metrics: Mapping[str, float]) -> None:
    """The map lies on the surfaces of the room and covers it. Without a reference cloud, only points are counted."""
    assert metrics["map.points"] >= FEWEST_MAP_POINTS
    if entry.bound.dataset == "room":
        kinds = {role.kind for role in entry.algorithm.inputs}
        kind = SensorKind.LIDAR if SensorKind.LIDAR in kinds else SensorKind.CAMERA
        assert metrics["map.accuracy.10cm"] >= SHARE_ON_SURFACES[kind]
        assert metrics["map.completeness.mean"] <= FARTHEST_MEAN_M


@NEEDS_SOURCES
@pytest.mark.classical
@pytest.mark.timeout(7200)
def test_messages_that_full_queues_drop_are_counted(systems: Hive) -> None:
    """LOAM's queues hold two sweeps, and no machine is 20 times faster than the recording."""
    dataset(systems, "room")
    (queued,) = systems.runs.submit(Submission("loam", "room", playback_rate=20.0, timeout_s=300.0))
    systems.worker(only=[queued.id]).run(until_idle=True)
    run = systems.runs.get(queued.id)
    queues = json.loads(systems.runs.folder(run.id).playback.read_text())["queues"]
    first = [queue for queue in queues if (queue["topic"], queue["to"]) == ("/points", "/multiScanRegistration")]
    assert run.metrics is not None
    assert first[0]["dropped"] < first[0]["delivered"] <= 150  # ROS counts what it drops as delivered
    assert run.metrics["queues.dropped"] == sum(queue["dropped"] for queue in queues) > 20


def errors_at_shifts(hive: Hive, entry: BoundTest, run_id: int) -> list[float]:
    """The ATE (RMSE, m) with timestamps moved by half a sweep backwards, not at all, and half a sweep forwards."""
    dataset = hive.catalogue.dataset(entry.bound.dataset)
    assert dataset.groundtruth_path is not None
    sensors = entry.algorithm.assign(dataset)
    T_body_sensor = rigid_transform(sensors[entry.algorithm.trajectory_role].T_body_sensor, "T_body_sensor")
    truth = move_sensor(read_tum(dataset.groundtruth_path), T_body_sensor)
    misfit = position_misfit(truth, read_tum(hive.runs.folder(run_id).trajectory), Alignment.SE3)
    half_s = 0.5 / sensors["points"].rate_hz
    return [misfit(shift_s)[0] for shift_s in (-half_s, 0.0, half_s)]
