"""Hidden protocols, computed by the evaluation itself, are among those that give the printed number."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.domain.claim import MetricFamily, PrintedUnit, read_printed
from slamhive.domain.protocol import Alignment, Association, Duplicates, Protocol
from slamhive.domain.sensors import Matrix4
from slamhive.evaluation.evaluators.evo_errors import AbsoluteError
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.presets import PRESETS
from slamhive.evaluation.protocol_search import SearchInput, search_protocols
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.layout import read_tum as read_tum_file
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import move_sensor

DATA = project_root().parent / "shared" / "data"
RUNS, EVO = DATA / "euroc_vio_runs", DATA / "evo_trajectories"

pytestmark = [
    pytest.mark.integration,
    pytest.mark.shared_data,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data"),
]
read_tum = cache(read_tum_file)
ARM = np.eye(4)
ARM[:3, 3] = (0.08, -0.05, 0.03)
CAMERA: Matrix4 = tuple(ARM.ravel())


def comparable(truth: Trajectory, estimate: Trajectory, *, upright: bool = True) -> SearchInput:
    def reference_of(T_body_sensor: Matrix4 | None) -> TruthReference:
        moved = truth if T_body_sensor is None else move_sensor(truth, np.reshape(T_body_sensor, (4, 4)))
        return TruthReference(moved)

    return SearchInput(reference_of, {None: estimate}, {"cam0": CAMERA}, upright)


HIDDEN = [name for name in PRESETS.names() if name in ("evo", "slam-hive", "tum", "rpg", "ov", "eth3d")]


def test_a_hidden_protocol_is_among_the_matches() -> None:
    """The rules of six tools and rarer ones, on real runs, printed with three digits; evo computes the number."""
    chooser = random.Random(1)
    found = unique = 0
    hidden: list[tuple[Protocol, str]] = [(PRESETS.get(name).protocol, "rmse") for name in HIDDEN]
    plain = Protocol(Alignment.SE3, duplicates=Duplicates.KEEP)
    hidden += [
        (replace(plain, T_body_sensor=CAMERA), "mean"),
        (replace(plain, alignment=Alignment.FIRST_POSE), "rmse"),
        (replace(plain, alignment=Alignment.SCALE, association=Association.INTERPOLATE), "max"),
        (replace(plain, align_poses=100), "median"),
    ]
    paths = sorted(RUNS.glob("v*/*/0.txt"))
    for protocol, statistic in hidden:
        path = chooser.choice(paths)
        truth, estimate = read_tum(RUNS / path.parts[-2] / "groundtruth.txt"), read_tum(path)
        searched = comparable(truth, estimate)
        paired = pair(searched.reference_of(protocol.T_body_sensor), estimate, protocol)
        value = AbsoluteError().evaluate(paired).values[f"ate.{statistic}"]
        printed = read_printed(f"{value:.4f}", PrintedUnit.M)
        result = search_protocols(searched, printed, MetricFamily.ATE)
        same = [
            match for match in result.matches if match.key == f"ate.{statistic}" and abs(match.value - value) < 1e-9
        ]
        found += bool(same)
        unique += len(result.matches) == 1
        rarities = [match.rarity for match in result.matches]
        assert rarities == sorted(rarities)
        assert all(printed.shows(match.value) for match in result.matches)
    assert found >= 0.95 * len(hidden)
    assert unique >= 1


def test_more_digits_leave_the_right_one_alone_and_name_its_tool() -> None:
    truth, estimate = read_tum(EVO / "freiburg1_xyz-groundtruth.txt"), read_tum(EVO / "freiburg1_xyz-rgbdslam.txt")
    found = search_protocols(comparable(truth, estimate, upright=False), read_printed("0.0134735"), MetricFamily.ATE)
    assert [(match.preset, match.key) for match in found.matches] == [("tum", "ate.rmse")]
    assert found.matches[0].protocol.association is Association.ONE_TO_ONE
    by_evo = search_protocols(comparable(truth, estimate, upright=False), read_printed("0.013470"), MetricFamily.ATE)
    assert by_evo.matches[0].preset == "evo"
    relative = search_protocols(comparable(truth, estimate, upright=False), read_printed("0.0195237"), MetricFamily.RPE)
    assert (relative.matches[0].preset, relative.matches[0].key) == ("tum", "rpe.seconds.mean")


def test_percent_and_centimetres_are_tried_and_a_unit_limits_them() -> None:
    truth, estimate = read_tum(RUNS / "V2_02" / "groundtruth.txt"), read_tum(RUNS / "vislam_ba" / "V2_02" / "0.txt")
    searched = comparable(truth, estimate)
    paired = pair(TruthReference(truth), estimate, Protocol(Alignment.SE3))
    value_m = AbsoluteError().evaluate(paired).values["ate.rmse"]
    text = f"{100 * value_m:.4f}"
    units = {match.unit for match in search_protocols(searched, read_printed(text), MetricFamily.ATE).matches}
    assert PrintedUnit.CM in units
    only = search_protocols(searched, read_printed(text, PrintedUnit.PERCENT), MetricFamily.ATE).matches
    assert {match.unit for match in only} <= {PrintedUnit.PERCENT}


def test_the_digits_of_a_printed_number_count() -> None:
    assert read_printed("0.016").shows(0.0164)
    assert not read_printed("0.0160").shows(0.0164)
    assert read_printed("1.6e-2").shows(0.0164)
    for text in ("", "nan", "-1", "1e999", "0,016", "inf", "0x10"):
        with pytest.raises(InvalidInput, match=r"such as 0\.016"):
            read_printed(text)
