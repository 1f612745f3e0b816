"""``config.yaml`` of runs on sensors as imports describe them, without a recording or a container."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.base.project import project_root
from slamhive.domain.configuration import Configuration, parse_step
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import parse_settings
from slamhive.domain.sensors import Sensor
from slamhive.experiments.binding import resolve_variant, seen_dataset
from slamhive.packages.algorithm_file import load_algorithms
from slamhive.packages.run_config import build_run_config
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions
from slamhive.recordings.room.dataset import RoomOptions, sensors_of
from slamhive.recordings.room.sensors import make_rig
from slamhive.recordings.variants.steps import RegisteredSteps, on_all_sensors
from slamhive.runtime.config import RunConfig, from_yaml, to_yaml

SHARED = project_root().parent / "shared" / "data"
SHARED_DATA = [
    pytest.mark.shared_data,
    pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent"),
]


def sensors_of_dataset(name: str) -> tuple[Sensor, ...]:
    """The sensors of ``room``, or of a real recording as its import describes them."""
    if name == "room":
        options = RoomOptions()
        return sensors_of(options, make_rig(640, 480, options.lidar_rate_hz))
    return plan_import(SHARED / name, ImportOptions())[1].sensors


def config_of(package: str, algorithm: str, name: str, *steps: str, **parameters: str) -> RunConfig:
    """``config.yaml`` of a run of ``algorithm`` on the dataset ``name``, as its container reads it."""
    known = {entry.name: entry for entry in load_algorithms(project_root() / "algorithms" / package)}
    chosen = known[algorithm]
    dataset = Dataset(name, Path(name), f"{name}.bag", 1.0, sensors_of_dataset(name), None, "sha256:" + "0" * 64)
    rules = RegisteredSteps()
    variant = resolve_variant(rules, dataset, [on_all_sensors(dataset, parse_step(step)) for step in steps])
    values = parse_settings(algorithm, chosen.parameters, parameters)
    configuration = Configuration(algorithm, name, values, variant=variant)
    return from_yaml(
        to_yaml(build_run_config(chosen, seen_dataset(rules, dataset, variant), configuration, 1, 0, dataset))
    )
