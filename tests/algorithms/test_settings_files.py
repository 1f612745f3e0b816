"""Settings files that packages write, against files written by hand from published calibrations."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slamhive.base.project import project_root
from tests.algorithms.recorded_configs import SHARED_DATA, config_of

pytestmark = pytest.mark.quick

GOLDEN = Path(__file__).parent / "settings"


def entries(path: Path) -> dict[str, Any]:
    """Number, text or matrix by key."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    root = file.root()
    found: dict[str, Any] = {}
    for key in root.keys():  # noqa: SIM118 - a node of OpenCV is no mapping
        node = root.getNode(key)
        found[key] = node.real() if node.isReal() or node.isInt() else node.string() if node.isString() else node.mat()
    return found


@pytest.mark.integration
@pytest.mark.parametrize(
    ("golden", "dataset", "steps"),
    [
        pytest.param("kitti_06-stereo", "kitti06_stereo_51", (), marks=SHARED_DATA),
        pytest.param("euroc-stereo-inertial", "euroc_v101_static", (), marks=SHARED_DATA),
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
    config = config_of("orb-slam3", f"orb-slam3-{mode}", dataset, *steps)
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
