"""Presets give each tool's own figure, on the files that the tools were run on."""

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.metrics import CATALOGUE
from slamhive.evaluation.engine import all_metrics
from slamhive.evaluation.evaluators.base import MetricValues
from slamhive.evaluation.pairing import pair
from slamhive.evaluation.presets import PRESETS
from slamhive.evaluation.references import TruthReference
from slamhive.trajectory.layout import read_tum
from slamhive.trajectory.model import Trajectory
from tests.evaluation.tool_inputs import EVO, RUNS, kitti

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data"),
]


def evaluated(name: str, reference: Trajectory, estimate: Trajectory) -> tuple[MetricValues, int]:
    paired = pair(TruthReference(reference), estimate, PRESETS.get(name).protocol)
    return all_metrics(paired), len(paired.aligned)


def test_presets_show_figures_of_the_catalogue_in_words() -> None:
    assert PRESETS.names() == ["eth3d", "evo", "hilti-2026", "kitti", "ov", "rpg", "slam-hive", "tum"]
    fingerprints = {preset.protocol.fingerprint for _, preset in PRESETS}
    assert len(fingerprints) == len(PRESETS.names())
    for _, preset in PRESETS:
        assert set(preset.metrics) <= CATALOGUE.keys()
        assert preset.title
        assert preset.differs
        assert preset.source


def test_keyframes_without_scale_are_whole_as_the_published_slam_hive_counts() -> None:
    """Its trajectories are those of keyframes, often of one camera: gaps below 30 s are none, and the scale is free."""
    truth = read_tum(EVO / "freiburg1_xyz-groundtruth.txt")
    every = slice(None, None, 500)  # 5 s apart
    keyframes = Trajectory(truth.stamps_s[every], 2 * truth.positions_m[every], truth.quats_xyzw[every])
    figures, _ = evaluated("slam-hive", truth, keyframes)
    assert figures.values["ate.rmse"] == pytest.approx(0, abs=1e-9)
    assert figures.values["gap.count"] == 0
    figures, _ = evaluated("evo", truth, keyframes)
    assert figures.values["ate.rmse"] > 0.01
    assert figures.values["gap.count"] > 0


@pytest.mark.parametrize(("name", "ate_m", "pairs"), [("evo", 0.013470, 785), ("tum", 0.013473, 786)])
def test_freiburg1_xyz_as_evo_and_as_tum(name: str, ate_m: float, pairs: int) -> None:
    truth, estimate = (read_tum(EVO / f"freiburg1_xyz-{which}.txt") for which in ("groundtruth", "rgbdslam"))
    figures, matched = evaluated(name, truth, estimate)
    assert figures.values["ate.rmse"] == pytest.approx(ate_m, abs=5e-7)
    assert matched == pairs


def test_kitti_00_as_evo_and_as_the_devkit() -> None:
    figures, _ = evaluated("evo", kitti("gt"), kitti("ORB"))
    assert figures.values["ate.rmse"] == pytest.approx(1.303450, abs=5e-7)
    figures, _ = evaluated("kitti", kitti("gt"), kitti("ORB"))
    values = figures.values
    assert values["kitti.translation"] == pytest.approx(0.699734, abs=5e-7)
    # The devkit takes the files' rotations as they are, with seven digits; ours are orthonormal.
    assert values["kitti.rotation"] == pytest.approx(0.00253352, rel=5e-5)
    assert values["kitti.segments"] == 3283
    counts = [values[f"kitti.segments.{length_m}m"] for length_m in range(100, 900, 100)]
    assert counts == [445, 431, 424, 416, 408, 399, 385, 375]
    by_length = [values[f"kitti.translation.{length_m}m"] for length_m in range(100, 900, 100)]
    assert by_length == pytest.approx([1.0091, 0.8744, 0.7809, 0.7189, 0.6553, 0.5720, 0.4926, 0.4159], abs=5e-5)


@pytest.mark.parametrize("name", ["evo", "tum", "rpg", "ov", "eth3d"])
def test_every_figure_of_a_tool_is_there_for_a_real_run(name: str) -> None:
    truth, estimate = read_tum(RUNS / "MH_01" / "groundtruth.txt"), read_tum(RUNS / "vio_mono" / "MH_01" / "0.txt")
    figures, _ = evaluated(name, truth, estimate)
    assert set(PRESETS.get(name).metrics) <= figures.values.keys()


def test_a_run_without_a_pose_for_every_frame_has_no_figure_as_kitti_counts() -> None:
    truth, estimate = read_tum(RUNS / "MH_01" / "groundtruth.txt"), read_tum(RUNS / "vio_mono" / "MH_01" / "0.txt")
    with pytest.raises(InvalidInput, match="poses are matched by index"):
        evaluated("kitti", truth, estimate)
