"""Presets give what the tools print: the tools were run on the same files, and their numbers are held here.

``tool_values.json`` holds what each tool gave:

- TUM's ``evaluate_ate.py`` and ``evaluate_rpe.py --fixed_delta --max_pairs 0``, in the Python 3 port that the source
  distribution of evo 1.38.1 carries, with ``sorted(keys)`` where the port still sorts a view;
- the modules of rpg_trajectory_evaluation (``trajectory.py`` 995e584), with the search for the ends of segments written
  in numpy;
- OpenVINS' ``error_singlerun`` (``AlignUtils.cpp`` 5d9fbee) and ETH3D's ``main.cc`` 30edfa0, compiled with Eigen 3.4,
  without plots and covariances. The list of images for ETH3D was that of the ground truth's timestamps; for
  "eth3d images", one of 27 Hz that begins before the ground truth and ends behind it.

OpenVINS and ETH3D take quaternions as they are written; ours are made unit. So these two were run twice: on files with
unit quaternions of all digits, and on the files as they are, whose quaternions have six or seven.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamhive.domain.protocol import Protocol, ProtocolRequest
from slamhive.evaluation.engine import all_metrics
from slamhive.evaluation.evaluators.base import IMAGE_TIMES
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.presets import PRESETS
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.pose_file import format_times, read_image_times
from tests.evaluation.tool_inputs import RECORDED, RUNS, recorded, synthetic

pytestmark = pytest.mark.integration  # evo takes seconds to load

TOOLS: dict[str, Any] = json.loads((Path(__file__).parent / "tool_values.json").read_text(encoding="utf-8"))
ROUNDING = 2e-9
AS_WRITTEN = {"ov": 0.01, "eth3d": 2e-4}
"""How far rounded quaternions may move a figure: 0.9 % is the most that is found, of a median of degrees."""

needs_data = (
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data"),
)
INPUTS = ["synthetic", *(pytest.param(name, marks=needs_data) for name in RECORDED)]


def trajectories(name: str) -> tuple[Trajectory, Trajectory]:
    return synthetic() if name == "synthetic" else recorded(name)


def figures(name: str, protocol: Protocol) -> dict[str, float]:
    truth, estimate = trajectories(name)
    paired = pair(TruthReference(truth), estimate, protocol)
    return {**all_metrics(paired).values, "matched": float(len(paired.aligned))}


def assert_equal(found: Mapping[str, float], tool: Mapping[str, float], within: float) -> None:
    assert tool.keys() <= found.keys()
    for key, value in tool.items():
        if key == "matched" or ".count" in key or ".pairs" in key:
            assert found[key] == value, key
        else:
            assert found[key] == pytest.approx(value, rel=within), key


@pytest.mark.parametrize("preset", ["tum", "rpg", "ov", "eth3d"])
@pytest.mark.parametrize("name", INPUTS)
def test_a_preset_gives_what_its_tool_prints(name: str, preset: str) -> None:
    found = figures(name, PRESETS.get(preset).protocol)
    assert_equal(found, TOOLS[name][preset], ROUNDING)
    if preset in TOOLS[name].get("as written", {}):
        assert_equal(found, TOOLS[name]["as written"][preset], AS_WRITTEN[preset])


@pytest.mark.parametrize("name", INPUTS)
def test_eth3d_compares_at_the_times_of_images_where_they_are_known(name: str, tmp_path: Path) -> None:
    truth, estimate = trajectories(name)
    begin_s, end_s = truth.stamps_s[0] - 0.2, truth.stamps_s[-1] + 0.2
    images_s = np.round(np.arange(begin_s, end_s, 1 / 27) + 0.0013, 6)
    listed = "".join(f"{image_s:.6f} rgb/{image_s:.6f}.png\n" for image_s in images_s)
    (tmp_path / "rgb.txt").write_text(f"# timestamp filename\n{listed}")
    read_s = read_image_times(tmp_path / "rgb.txt", (float(truth.stamps_s[0]), float(truth.stamps_s[-1])))
    (tmp_path / "image_times.txt").write_bytes(format_times(read_s))
    protocol = PRESETS.get("eth3d").protocol
    found = all_metrics(pair(TruthReference(truth), estimate, protocol, {IMAGE_TIMES: tmp_path / "image_times.txt"}))
    assert_equal(found.values, TOOLS[name]["eth3d images"], ROUNDING)
    without = all_metrics(pair(TruthReference(truth), estimate, protocol)).values
    assert without["ate.rmse"] != pytest.approx(TOOLS[name]["eth3d images"]["ate.rmse"], rel=1e-6)


@pytest.mark.parametrize("preset", ["ov", "rpg"])
@pytest.mark.parametrize("name", INPUTS)
def test_yaw_and_position_of_the_first_pose(name: str, preset: str) -> None:
    """``posyawsingle`` of OpenVINS; rpg_trajectory_evaluation has the same for one frame."""
    protocol = replace(PRESETS.get(preset).protocol, alignment=PRESETS.get("ov").protocol.alignment, align_poses=1)
    assert_equal(figures(name, protocol), TOOLS[name][f"{preset} posyawsingle"], ROUNDING)


def test_the_made_up_flight_has_what_the_tools_stumble_over() -> None:
    """Each rule differs from the plain one there, so that equal values say that it is followed."""
    truth, estimate = synthetic()
    for preset, plain in (
        ("tum", {"rpe_pairs": "all"}),
        ("rpg", {"segment_rule": "matched"}),
        ("ov", {"association": "one_to_one"}),
        ("eth3d", {"segment_rule": "matched"}),
        ("eth3d", {"hold_interval_s": None}),
    ):
        protocol = PRESETS.get(preset).protocol
        asked = ProtocolRequest(plain).on(protocol) if None not in plain.values() else replace(protocol, **plain)
        found = all_metrics(pair(TruthReference(truth), estimate, asked)).values
        tool = TOOLS["synthetic"][preset]
        assert any(abs(found.get(key, 0.0) / value - 1) > 1e-3 for key, value in tool.items() if value), (preset, plain)
