"""Our figures against evo's command line, with the arguments that a user gives, on real trajectories: equal to 1e-9."""

import csv
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from slamhive.domain.protocol import Alignment, Protocol, RpePairs
from slamhive.evaluation.job import Artefacts, EvaluationResult, EvaluationTask
from slamhive.evaluation.presets import PRESETS
from slamhive.evaluation.runner import EvaluationRunner, ProcessStarter
from slamhive.evaluation.work import FILES
from slamhive.trajectory.kitti import read_kitti
from slamhive.trajectory.layout import write_tum
from tests.evaluation.evo_commands import evo_commands
from tests.evaluation.tool_inputs import EVO, RECORDED, RUNS

ROOT = Path(__file__).resolve().parent.parent.parent
FLAGS = {Alignment.NONE: [], Alignment.SE3: ["-a"], Alignment.SIM3: ["-a", "-s"]}

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not RUNS.is_dir(), reason="the recorded data is not in ../shared/data"),
]


def evaluate(
    folder: Path, pairs: list[tuple[Path, Path]], protocol: Protocol, artefacts: Artefacts
) -> list[EvaluationResult]:
    tasks = []
    for number, (reference, estimate) in enumerate(pairs):
        output = folder / str(number)
        output.mkdir(parents=True)
        tasks.append(EvaluationTask(str(number), estimate, reference, output, protocol, artefacts=artefacts))
    scratch = folder / "scratch"
    scratch.mkdir()
    return EvaluationRunner(ProcessStarter(ROOT)).run(tasks, scratch, lambda _result: None)


@pytest.fixture(scope="module")
def command_line(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[..., None]]:
    with evo_commands(tmp_path_factory.mktemp("home")) as run:
        yield run


def statistics(archive: Path) -> dict[str, float]:
    with zipfile.ZipFile(archive) as opened:
        content: dict[str, float] = json.loads(opened.read("stats.json"))
    return content


@pytest.fixture(scope="module")
def kitti(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("kitti")
    for name in ("gt", "ORB"):
        trajectory = read_kitti(EVO / f"KITTI_00_{name}.txt", EVO / "KITTI_00_gt_times.txt")
        write_tum(folder / f"{name}.txt", trajectory.stamps_s, trajectory.positions_m, trajectory.quats_xyzw)
    return folder / "gt.txt", folder / "ORB.txt"


@pytest.mark.parametrize("alignment", list(FLAGS))
def test_equal_to_the_command_line(
    tmp_path: Path, command_line: Callable[..., None], kitti: tuple[Path, Path], alignment: Alignment
) -> None:
    pairs = [
        (RUNS / "MH_01" / "groundtruth.txt", RUNS / "vio_mono" / "MH_01" / "0.txt"),
        (EVO / "freiburg1_xyz-groundtruth.txt", EVO / "freiburg1_xyz-rgbdslam.txt"),
        kitti,
    ]
    results = evaluate(tmp_path, pairs, Protocol(alignment), Artefacts.METRICS)
    for (reference, estimate), result in zip(pairs, results, strict=True):
        assert result.reason is None
        for key, command, options in (
            ("ate", "evo_ape", ["-r", "trans_part"]),
            ("rpe", "evo_rpe", ["-r", "trans_part", "--all_pairs", "-d", "1", "-u", "m"]),
        ):
            archive = tmp_path / f"{key}{result.id}.zip"
            arguments = ["tum", str(reference), str(estimate), *FLAGS[alignment], *options, "--save_results"]
            command_line(command, *arguments, str(archive))
            for name, value in statistics(archive).items():
                assert result.metrics[f"{key}.{name}"] == pytest.approx(value, rel=1e-9, abs=1e-9), (estimate, name)


def test_the_preset_is_equal_to_the_command_line(tmp_path: Path, command_line: Callable[..., None]) -> None:
    pairs = [RECORDED[name] for name in ("freiburg1_xyz ORB keyframes", "vislam_ba MH_03")]
    results = evaluate(tmp_path, pairs, PRESETS.get("evo").protocol, Artefacts.METRICS)
    for (reference, estimate), result in zip(pairs, results, strict=True):
        for key, command, options in (
            ("ate", "evo_ape", ["-a"]),
            ("rpe.frames", "evo_rpe", []),
            ("rpe_rot.frames", "evo_rpe", ["-r", "angle_deg"]),
        ):
            archive = tmp_path / f"{key}{result.id}.zip"
            arguments = ["tum", str(reference), str(estimate), *options, "--save_results", str(archive)]
            command_line(command, *arguments)
            for name in ("rmse", "mean", "median", "max"):
                expected = pytest.approx(statistics(archive)[name], rel=1e-6, abs=1e-9)
                assert result.metrics[f"{key}.{name}"] == expected, (estimate, key, name)
        with zipfile.ZipFile(archive) as opened:
            errors = np.load(io.BytesIO(opened.read("error_array.npy")))
        assert result.metrics["rpe.frames.pairs"] == len(errors)


def test_what_tums_script_counts_opens_with_evo_and_is_drawn(tmp_path: Path, command_line: Callable[..., None]) -> None:
    pair = RECORDED["freiburg1_xyz ORB keyframes"]
    (result,) = evaluate(tmp_path, [pair], PRESETS.get("tum").protocol, Artefacts.PLOTS)
    assert result.reason is None
    assert (tmp_path / "0" / "rpe_map.png").read_bytes().startswith(b"\x89PNG")
    assert statistics(tmp_path / "0" / "rpe.zip")["rmse"] == pytest.approx(result.metrics["rpe.rmse"])
    table = tmp_path / "rpe.csv"
    command_line("evo_res", str(tmp_path / "0" / "rpe.zip"), "--save_table", str(table))
    assert "rmse" in table.read_text()


def test_published_golden_values(tmp_path: Path, kitti: tuple[Path, Path]) -> None:
    xyz = (EVO / "freiburg1_xyz-groundtruth.txt", EVO / "freiburg1_xyz-rgbdslam.txt")
    results = evaluate(tmp_path, [kitti, xyz], Protocol(Alignment.SE3), Artefacts.METRICS)
    assert results[0].metrics["ate.rmse"] == pytest.approx(1.303450, abs=5e-7)
    assert results[1].metrics["ate.rmse"] == pytest.approx(0.013470, abs=5e-7)
    assert results[1].matched_poses == 785


def test_all_euroc_runs_agree_with_the_independent_figures(tmp_path: Path) -> None:
    """Every evaluator on every run. The test of their import compares the error under the other alignments."""
    with (RUNS / "ate_rmse.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 122
    pairs = [
        (RUNS / row["sequence"] / "groundtruth.txt", RUNS / row["algorithm"] / row["sequence"] / f"{row['trial']}.txt")
        for row in rows
    ]
    results = evaluate(tmp_path, pairs, Protocol(Alignment.SE3), Artefacts.METRICS)
    for row, result in zip(rows, results, strict=True):
        assert result.reason is None
        assert result.matched_poses == int(row["n_matched"])
        assert result.metrics["ate.rmse"] == pytest.approx(float(row["ate_rmse_se3_m"]), abs=5.1e-5)


def test_artefacts_open_with_evo_and_figures_are_drawn(tmp_path: Path, command_line: Callable[..., None]) -> None:
    pair = (EVO / "freiburg1_xyz-groundtruth.txt", EVO / "freiburg1_xyz-rgbdslam.txt")
    (result,) = evaluate(tmp_path, [pair], Protocol(Alignment.SE3), Artefacts.PLOTS)
    output = tmp_path / "0"
    figures = {f"traj_{name}.png" for name in ("trajectories", "xyz", "rpy", "speeds")}
    figures |= {f"{key}_{name}.png" for key in ("ape", "rpe") for name in ("raw", "map")}
    assert {path.name for path in output.iterdir()} == {*FILES, *figures, "result.json"}
    for name in figures:
        assert (output / name).read_bytes().startswith(b"\x89PNG")
    for key in ("ape", "rpe"):
        table = tmp_path / f"{key}.csv"
        command_line("evo_res", str(output / f"{key}.zip"), "--save_table", str(table))
        assert "rmse" in table.read_text()
    errors_m = np.loadtxt(output / "errors.csv", delimiter=",", skiprows=1)[:, 1]
    assert np.sqrt(np.mean(errors_m**2)) == pytest.approx(result.metrics["ate.rmse"], abs=1e-8)
    command_line(
        "evo_ape",
        "tum",
        str(output / "groundtruth.tum"),
        str(output / "traj.tum"),
        "--save_results",
        str(tmp_path / "again.zip"),
    )
    assert statistics(tmp_path / "again.zip")["rmse"] == pytest.approx(result.metrics["ate.rmse"], abs=1e-8)


def test_errors_of_distances_are_evos_point_distance(tmp_path: Path, command_line: Callable[..., None]) -> None:
    """The ground truth is declared positions only; evo gets its orientations, which do not count there."""
    reference, estimate = RUNS / "MH_01" / "groundtruth.txt", RUNS / "vio_mono" / "MH_01" / "0.txt"
    for rule, options in (("consecutive", []), ("all", ["--all_pairs"])):
        protocol = Protocol(Alignment.SE3, rpe_pairs=RpePairs(rule), rpe_delta_m=2.0, rpe_delta_frames=10)
        folder = tmp_path / rule
        output = folder / "out"
        output.mkdir(parents=True)
        task = EvaluationTask("1", estimate, reference, output, protocol, positions_only=True)
        (folder / "scratch").mkdir()
        (result,) = EvaluationRunner(ProcessStarter(ROOT)).run([task], folder / "scratch", lambda _result: None)
        assert "rpe.rmse" in result.missing
        for key, delta, unit in (("rpe_point", "2", "m"), ("rpe_point.frames", "10", "f")):
            archive = folder / f"{key}.zip"
            given = ["-a", "-r", "point_distance", "-d", delta, "-u", unit, *options]
            command_line("evo_rpe", "tum", str(reference), str(estimate), *given, "--save_results", str(archive))
            for name in ("rmse", "mean", "median", "max"):
                expected = statistics(archive)[name]
                assert result.metrics[f"{key}.{name}"] == pytest.approx(expected, rel=1e-9), (rule, key, name)
            with zipfile.ZipFile(archive) as opened:
                errors = np.load(io.BytesIO(opened.read("error_array.npy")))
            assert result.metrics[f"{key}.pairs"] == len(errors)
        assert 0.1 < result.metrics["segment_point.error"] < 3
