"""The experiments that ship, against the real steps and, where they are installed, the real algorithms."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from slamhive.base import strict_yaml
from slamhive.domain.algorithm import GpuNeed
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import SensorKind
from slamhive.experiments.binding import CatalogueView
from slamhive.experiments.expansion import count, expand
from slamhive.experiments.experiment import Experiment
from slamhive.experiments.file import experiment_schema, parse_experiment
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.recordings.importers.kitti import velodyne_layout
from slamhive.recordings.room.dataset import RoomOptions, sensors_of
from slamhive.recordings.room.sensors import make_rig
from slamhive.recordings.variants.steps import RegisteredSteps
from slamhive.recordings.variants.streams import treat
from tests.experiments.sweep_world import CAMERA, IMU, LIDAR, ROOM, dataset

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = ROOT / "docs" / "examples"
SCHEMA = ROOT / "docs" / "schemas" / "experiment.schema.json"


def load(path: Path) -> Experiment:
    return parse_experiment(strict_yaml.read_text(path), str(path))


@pytest.fixture(scope="module")
def room() -> CatalogueView:
    """What is there after ``make demo``."""
    folders = ("orb-slam3", "kiss-icp", "rko-lio")
    algorithms = [entry for folder in folders for entry in load_algorithms(ROOT / "algorithms" / folder)]
    return CatalogueView({entry.name: entry for entry in algorithms}, {"room": ROOM}, RegisteredSteps())


def test_the_papers_experiment_is_1500_configurations():
    path = EXAMPLES / "paper-euroc.yaml"
    assert len(path.read_text().splitlines()) <= 40
    experiment = load(path)
    view = with_shipped_packages(experiment)
    size = count(experiment, view)
    assert (size.combinations, size.configurations, size.runs) == (1500, 1500, 1500)
    assert size.axes == {"algorithm": 10, "dataset": 5, "image_rate": 5, "image_resolution": 6}
    assert size.variants == 5 * (5 * 6 - 1)
    expansion = expand(experiment, view)
    runs = list(expansion)
    assert len({run.content_hash for run in runs}) == 1500
    assert expansion.merged == 0
    assert (runs[0].name, runs[-1].name) == ("paper-euroc-0001", "paper-euroc-1500")
    assert sum(not run.configuration.variant for run in runs) == 10 * 5


def test_a_cut_of_the_papers_experiment_runs_on_two_rooms():
    experiment = load(EXAMPLES / "paper-room.yaml")
    view = with_shipped_packages(experiment)
    size = count(experiment, view)
    assert (size.configurations, size.runs) == (180, 360)
    assert size.axes == {"algorithm": 10, "dataset": 2, "image_rate": 3, "image_resolution": 3}
    variants = {(run.configuration.dataset, run.configuration.variant) for run in expand(experiment, view)}
    assert len(variants) == 2 * 3 * 3
    for name, variant in variants:
        treat(view.datasets[name], variant)  # raises if the room has sensors that no longer fit each other


def test_the_table_of_algorithms_has_all_that_run_in_real_time_without_a_gpu():
    experiment = load(EXAMPLES / "algorithms.yaml")
    names = set(map(str, experiment.algorithms.values))
    packages = with_shipped_packages(experiment).algorithms
    assert names == {
        name
        for name, entry in packages.items()
        if entry.package.gpu is GpuNeed.NONE
        and PlaybackMode.REALTIME in entry.package.playback
        and all(role.kind is not SensorKind.LASER for role in entry.inputs)  # neither dataset has one
    }


@pytest.mark.parametrize(
    ("name", "configurations", "runs", "axes"),
    [
        ("paper-repeats", 50, 250, {"algorithm": 10, "dataset": 5}),
        ("paper-lidar", 4, 4, {"algorithm": 4}),
        ("paper-features", 108, 108, {"image_rate": 3, "imu_rate": 3, "image_resolution": 4, "nFeatures": 3}),
    ],
)
def test_the_papers_smaller_experiments_expand_to_its_runs(name, configurations, runs, axes):
    experiment = load(EXAMPLES / f"{name}.yaml")
    expansion = expand(experiment, with_shipped_packages(experiment))
    assert (expansion.size.configurations, expansion.size.runs, expansion.size.axes) == (configurations, runs, axes)
    assert len({run.content_hash for run in expansion}) == configurations


def with_shipped_packages(experiment: Experiment) -> CatalogueView:
    """All packages of the project, and datasets of the experiment with two cameras and an IMU."""
    folders = sorted(path.parent for path in (ROOT / "algorithms").glob("*/algorithm.yaml"))
    algorithms = {entry.name: entry for folder in folders for entry in load_algorithms(folder)}
    datasets = {name: _recorded(name) for name in map(str, experiment.datasets.values)}
    return CatalogueView(algorithms, datasets, RegisteredSteps())


def _recorded(name: str) -> Dataset:
    """Two cameras and an IMU; of KITTI the LiDAR, whose points have no time and no ring; all sensors of rooms."""
    if name.startswith("kitti"):
        made = dataset(name, ("lidar0", LIDAR, 10))
        return replace(made, sensors=(replace(made.sensors[0], calibration=velodyne_layout().calibration()),))
    if name.startswith("room"):
        options = RoomOptions()
        return replace(dataset(name), sensors=sensors_of(options, make_rig(640, 480, options.lidar_rate_hz)))
    return dataset(name, ("cam0", CAMERA, 20), ("cam1", CAMERA, 20), ("imu0", IMU, 200))


def test_the_sensitivity_experiment_is_5_rates_4_resolutions_2_algorithms(room):
    size = count(load(EXAMPLES / "room-sensitivity.yaml"), room)
    assert size.axes == {"algorithm": 2, "image_rate": 5, "image_resolution": 4}
    assert (size.configurations, size.runs, size.variants) == (40, 40, 19)


def test_the_demo_is_over_in_minutes(room):
    size = count(load(EXAMPLES / "room-demo.yaml"), room)
    # The LiDAR algorithms listen to no camera, so they have no rate to link: the named depth images alone are scaled.
    assert size.axes == {"algorithm": 3, "image_rate + image_resolution": 2, "image_resolution": 2}
    assert size.runs == 4


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.yaml")), ids=lambda path: path.name)
def test_every_example_is_named_like_its_file_and_points_to_the_schema(path):
    assert load(path).name == path.stem
    assert "$schema=../schemas/experiment.schema.json" in path.read_text()


def test_the_published_schema_is_current():
    assert SCHEMA.read_text(encoding="utf-8") == experiment_schema(), "run: .venv/bin/python tools/generate_docs.py"


def test_the_schema_knows_every_key_and_refuses_others():
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    assert schema["required"] == ["name", "algorithms", "datasets"]
    assert schema["additionalProperties"] is False
    assert {"steps", "parameters", "linked", "tied", "where", "stop_when", "limits"} <= set(schema["properties"])


def test_general_names_are_documented_and_mean_the_same_everywhere():
    page = (ROOT / "docs" / "experiments.md").read_text(encoding="utf-8")
    meaning: dict[str, set[tuple[str, str]]] = {}
    for folder in sorted(path.parent for path in (ROOT / "algorithms").glob("*/algorithm.yaml")):
        for entry in load_algorithms(folder):
            for parameter in entry.parameters:
                if parameter.general is not None:
                    meaning.setdefault(parameter.general, set()).add((parameter.type.value, parameter.unit))
    assert meaning
    assert [name for name in meaning if f"`{name}`" not in page] == []
    assert {name: uses for name, uses in meaning.items() if len(uses) > 1} == {}


def test_stated_intrinsics_move_with_the_resolution(room):
    expansion = expand(load(EXAMPLES / "room-stated-intrinsics.yaml"), room)
    runs = list(expansion)
    assert len(runs) == 6
    stated = {}
    for run in runs:
        by_kind = {step.kind: step.options for step in run.configuration.variant}
        scale = by_kind.get("resolution", {"scale": 1.0})["scale"]
        stated[scale] = by_kind.get("calibration", {}).get("cx")
        assert [step.kind for step in run.configuration.variant][-1:] != ["resolution"]
    assert stated == {1.0: None, 0.5: 159.75, 0.25: 79.875}, "at full size the sensor's own values change nothing"


def test_every_experiment_in_the_documentation_is_accepted(room):
    page = (ROOT / "docs" / "experiments.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    whole = [block for block in blocks if block.startswith("name:")]
    assert whole
    sizes = [count(parse_experiment(block, "docs/experiments.md"), room) for block in whole]
    assert "10 configurations, 30 runs" in page
    assert (sizes[0].configurations, sizes[0].runs) == (10, 30)


@pytest.mark.parametrize("kind", RegisteredSteps().kinds())
def test_every_registered_step_can_be_named_in_an_experiment(kind):
    text = f"name: t\nalgorithms: a\ndatasets: room\nsteps:\n  x: {{step: {kind}, sensors: camera}}\n"
    assert parse_experiment(text).steps[0].kind == kind
