"""Settings files that packages write, against files written by hand from published calibrations."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.bags.importers import plan_import
from slamhive.bags.importing import ImportOptions
from slamhive.bags.room.description import sensors_of
from slamhive.bags.room.options import RoomOptions
from slamhive.bags.room.rig import make_rig
from slamhive.bags.variants.rules import RegisteredSteps, on_all_sensors
from slamhive.catalogue.algorithm_file import load_algorithms
from slamhive.catalogue.run_config import build_run_config
from slamhive.domain.configuration import Configuration
from slamhive.domain.dataset import Dataset
from slamhive.domain.parameters import parse_settings
from slamhive.domain.sensors import Sensor
from slamhive.domain.variant import parse_step
from slamhive.project import project_root
from slamhive.runtime.config import RunConfig, from_yaml, to_yaml
from slamhive.sweep.variants import resolve_variant, seen_dataset

pytestmark = pytest.mark.quick

GOLDEN = Path(__file__).parent / "settings"
ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
shared = [
    pytest.mark.shared_data,
    pytest.mark.skipif(not SHARED.is_dir(), reason="../shared/data is absent"),
]


def recorded(name: str) -> tuple[Sensor, ...]:
    """The sensors of a recording, as an import describes them."""
    return plan_import(SHARED / name, ImportOptions())[1].sensors


def room() -> tuple[Sensor, ...]:
    options = RoomOptions()
    return sensors_of(options, make_rig(640, 480, options.lidar_rate_hz))


def config_of(algorithm: str, name: str, sensors: tuple[Sensor, ...], *steps: str) -> RunConfig:
    """``config.yaml`` of a run, as its container reads it."""
    known = {entry.name: entry for entry in load_algorithms(project_root() / "algorithms" / "orb-slam3")}
    chosen = known[algorithm]
    dataset = Dataset(name, Path(name), f"{name}.bag", 1.0, sensors, None, "sha256:" + "0" * 64)
    rules = RegisteredSteps()
    variant = resolve_variant(rules, dataset, [on_all_sensors(dataset, parse_step(step)) for step in steps])
    configuration = Configuration(algorithm, name, parse_settings(algorithm, chosen.parameters, {}), variant=variant)
    config = build_run_config(chosen, seen_dataset(rules, dataset, variant), configuration, 1, 0, dataset)
    return from_yaml(to_yaml(config))


def entries(path: Path) -> dict[str, Any]:
    """Number, text or matrix by key."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    root = file.root()
    found: dict[str, Any] = {}
    for key in root.keys():  # noqa: SIM118 - a node of OpenCV is no mapping
        node = root.getNode(key)
        found[key] = node.real() if node.isReal() or node.isInt() else node.string() if node.isString() else node.mat()
    return found


@pytest.mark.parametrize(
    ("golden", "dataset", "steps"),
    [
        pytest.param("kitti_06-stereo", "kitti06_stereo_51", (), marks=shared),
        pytest.param("euroc-stereo-inertial", "euroc_v101_static", (), marks=shared),
        ("room-rgbd", "room", ()),
        ("room-stereo-half", "room", ("resolution scale=0.5", "rate hz=10")),
    ],
)
def test_orb_slam3_is_told_the_published_calibration(
    golden: str, dataset: str, steps: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(project_root() / "algorithms" / "orb-slam3" / "slamhive"))
    monkeypatch.delitem(sys.modules, "orb_settings", raising=False)
    mode = golden.partition("-")[2].removesuffix("-half")
    sensors = room() if dataset == "room" else recorded(dataset)
    config = config_of(f"orb-slam3-{mode}", dataset, sensors, *steps)
    written = tmp_path / "settings.yaml"
    written.write_text(import_module("orb_settings").settings_text(config.parameters, set(config.algorithm_remap)))
    ours, published = entries(written), entries(GOLDEN / f"{golden}.yaml")
    for key, value in published.items():
        if isinstance(value, str):
            assert ours[key] == value, key
        else:
            assert np.allclose(ours[key], value, rtol=1e-5, atol=2e-6), (key, ours[key], value)
    calibrated = ("Camera", "Stereo", "RGBD", "IMU")
    assert {key for key in ours if key.startswith(calibrated)} - published.keys() == {"Camera.RGB"}
