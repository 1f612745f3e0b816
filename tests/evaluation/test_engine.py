"""The engine on made-up trajectories; the comparison with evo's command line is in test_evo_agreement.py."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slamhive.domain.metrics import CATALOGUE
from slamhive.domain.protocol import Alignment, Protocol
from slamhive.domain.verdict import FROM_REPEATS
from slamhive.evaluation.evaluators.base import MetricValues
from slamhive.evaluation.evaluators.consistency import Consistency
from slamhive.evaluation.job import Artefacts, EvaluationResult, EvaluationTask, result_from_json
from slamhive.evaluation.references import References
from slamhive.evaluation.work import FILES, run_task
from slamhive.runtime.pcd import write_pcd
from slamhive.trajectory.layout import write_tum
from slamhive.trajectory.model import Trajectory
from slamhive.trajectory.transforms import move_sensor, rotations_from_quats

pytestmark = pytest.mark.quick

STAMPS_S = np.arange(0.0, 20.0, 0.05)


def curve(count: int = len(STAMPS_S)) -> tuple[np.ndarray, np.ndarray]:
    t = STAMPS_S[:count]
    positions_m = np.column_stack([3 * np.cos(t / 3), 4 * np.sin(t / 3), 0.5 * np.sin(t)])
    yaw = t / 3
    quats = np.column_stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)])
    return positions_m, quats


class Bench:
    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.truth, self.estimate = folder / "groundtruth.txt", folder / "traj.txt"
        positions_m, quats = curve()
        write_tum(self.truth, STAMPS_S, positions_m, quats)
        write_tum(self.estimate, STAMPS_S, positions_m, quats)

    def run(self, alignment: Alignment = Alignment.SE3, **options: Any) -> EvaluationResult:
        output = self.folder / "out"
        output.mkdir(exist_ok=True)
        task = EvaluationTask("7", self.estimate, self.truth, output, Protocol(alignment))
        task = replace(task, **{"artefacts": Artefacts.METRICS, **options})
        result = run_task(task, References())
        assert result_from_json((output / "result.json").read_text()) == result
        assert all(math.isfinite(value) for value in result.metrics.values())
        return result


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_keys_are_those_of_the_catalogue(bench: Bench) -> None:
    expected = {key for key, metric in CATALOGUE.items() if metric.needs_protocol}
    result = bench.run()
    assert set(result.metrics) | set(result.missing) <= expected
    assert not set(result.metrics) & set(result.missing)


@pytest.mark.parametrize("alignment", [Alignment.SE3, Alignment.SIM3])
def test_a_rigid_move_gives_zero(bench: Bench, alignment: Alignment) -> None:
    positions_m, quats = curve()
    R = rotations_from_quats(np.array([[0.5, 0.5, 0.5, 0.5]]))[0]
    write_tum(bench.estimate, STAMPS_S, positions_m @ R.T + [5, 6, 7], quats)
    result = bench.run(alignment)
    assert result.reason is None
    assert result.metrics["ate.rmse"] == pytest.approx(0, abs=1e-7)
    assert result.metrics["alignment.scale"] == pytest.approx(1)
    assert result.poses == result.matched_poses == len(STAMPS_S)


def test_a_scale_is_found_by_sim3_and_by_nothing_else(bench: Bench) -> None:
    positions_m, quats = curve()
    write_tum(bench.estimate, STAMPS_S, positions_m / 1.02, quats)
    result = bench.run(Alignment.SIM3)
    assert result.metrics["ate.rmse"] == pytest.approx(0, abs=1e-7)
    assert result.metrics["rpe.rmse"] == pytest.approx(0, abs=1e-7)
    assert result.metrics["alignment.scale"] == pytest.approx(1.02)
    other = bench.run(Alignment.SE3)
    assert other.metrics["ate.rmse"] > 0.01
    assert other.metrics["alignment.scale"] == 1


def test_yaw_position_leaves_tilt_in_and_none_leaves_all_in(bench: Bench) -> None:
    positions_m, quats = curve()
    write_tum(bench.estimate, STAMPS_S, positions_m[:, [1, 0, 2]] * [-1, 1, 1] + [1, 2, 3], quats)
    assert bench.run(Alignment.YAW_POSITION).metrics["ate.rmse"] == pytest.approx(0, abs=1e-7)
    write_tum(bench.estimate, STAMPS_S, positions_m[:, [0, 2, 1]] * [1, -1, 1], quats)
    assert bench.run(Alignment.YAW_POSITION).metrics["ate.rmse"] > 1
    write_tum(bench.estimate, STAMPS_S, positions_m + np.array([3, 0, 4]), quats)
    assert bench.run(Alignment.NONE).metrics["ate.mean"] == pytest.approx(5)


def test_the_missing_middle_shows_in_completeness_only(bench: Bench) -> None:
    positions_m, quats = curve()
    kept = (STAMPS_S < 5) | (STAMPS_S >= 15)
    write_tum(bench.estimate, STAMPS_S[kept], positions_m[kept], quats[kept])
    result = bench.run()
    assert result.metrics["ate.rmse"] == pytest.approx(0, abs=1e-7)
    assert result.metrics["tracked_fraction"] == pytest.approx(0.5, abs=0.01)
    assert result.metrics["gap.count"] == 1


def test_the_ground_truth_is_moved_into_the_sensor_frame(bench: Bench) -> None:
    positions_m, quats = curve()
    T_body_sensor = np.array([[0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 0.2], [0, 0, 0, 1.0]])
    rotations = rotations_from_quats(quats)
    write_tum(bench.estimate, STAMPS_S, positions_m + rotations @ T_body_sensor[:3, 3], quats)
    assert bench.run().metrics["ate.rmse"] > 0.01
    moved = bench.run(T_body_sensor=tuple(T_body_sensor.ravel().tolist()))
    assert moved.metrics["ate.rmse"] == pytest.approx(0, abs=1e-7)


def test_a_path_shorter_than_the_delta_has_ate_and_no_rpe(bench: Bench) -> None:
    positions_m, quats = curve()
    write_tum(bench.truth, STAMPS_S, positions_m * 0.01, quats)
    write_tum(bench.estimate, STAMPS_S, positions_m * 0.01, quats)
    result = bench.run(artefacts=Artefacts.FILES)
    assert result.reason is None
    assert "ate.rmse" in result.metrics
    assert "rpe.rmse" not in result.metrics
    assert "1 m of path" in result.missing["rpe.rmse"]
    assert not (bench.folder / "out" / "rpe.zip").exists()


def _rows(start: float, count: int = 10) -> str:
    return "".join(f"{start + i / 10} {i} {i * i} 0 0 0 0 1\n" for i in range(count))


@pytest.mark.parametrize(
    ("which", "text", "message"),
    [
        ("truth", None, "there is no ground truth: groundtruth.txt does not exist"),
        ("truth", "1 2 3\n", "ground truth groundtruth.txt, line 1: 3 columns instead of 8"),
        ("truth", _rows(0)[::-1].strip() + "\n", "ground truth groundtruth.txt, line"),
        ("truth", _rows(5, 1), "the ground truth has one pose"),
        ("estimate", None, "there is no estimate: traj.txt does not exist"),
        ("estimate", "", "estimate traj.txt is empty"),
        ("estimate", _rows(0) + _rows(0), "estimate traj.txt, line 11: timestamp 0.000000000 comes after"),
        ("estimate", _rows(5000), "estimate and ground truth do not overlap in time: estimate 5000.000 to"),
        ("estimate", _rows(0.02), "no estimated pose is within 0.01 s of a ground-truth pose"),
        ("estimate", _rows(5, 1), "only 1 of 1 estimated poses match the ground truth in time, at least 3"),
        ("estimate", _rows(5, 2), "only 2 of 2 estimated poses match"),
        ("estimate", "".join(f"{i} {i} {2 * i} 0 0 0 0 1\n" for i in range(19)), "alignment is not possible: the 19 "),
        (
            "estimate",
            "".join(f"{i} 1 1 1 0 0 0 1\n" for i in range(19)),
            "alignment is not possible: the estimate",
        ),
    ],
)
def test_failures_are_one_clear_line(bench: Bench, which: str, text: str | None, message: str) -> None:
    path = getattr(bench, which)
    if text is None:
        path.unlink()
    else:
        path.write_text(text)
    result = bench.run()
    assert result.reason is not None
    assert result.reason.startswith(message)
    assert "\n" not in result.reason
    assert result.metrics == {}


def test_an_estimate_that_is_a_link_is_refused(bench: Bench) -> None:
    bench.estimate.unlink()
    bench.estimate.symlink_to(bench.truth)
    assert "is a link" in (bench.run().reason or "")


def test_files_are_there_and_a_later_failure_removes_them(bench: Bench) -> None:
    result = bench.run(artefacts=Artefacts.FILES)
    output = bench.folder / "out"
    assert {path.name for path in output.iterdir()} == {*FILES, "result.json"}
    lines = (output / "errors.csv").read_text().splitlines()
    assert lines[0] == "timestamp,ape_m"
    assert len(lines) == result.matched_poses + 1
    bench.estimate.unlink()
    bench.run(artefacts=Artefacts.FILES)
    assert {path.name for path in output.iterdir()} == {"result.json"}
    assert json.loads((output / "result.json").read_text())["reason"]


def test_a_ground_truth_is_read_once(bench: Bench) -> None:
    references = References()
    task = EvaluationTask("1", bench.estimate, bench.truth, bench.folder, Protocol(Alignment.SE3))
    references.preload([task] * 5)
    bench.truth.unlink()
    assert references.of(task) is references.of(task)


MOUNTED = (1.0, 0.0, 0.0, 0.5, 0.0, 0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0)


def relations(folder: Path) -> Path:
    """Between poses of the body a second apart."""
    positions_m, quats = curve()
    R = rotations_from_quats(quats)
    rows = []
    for i in range(0, 380, 20):
        x, y, z = R[i].T @ (positions_m[i + 20] - positions_m[i])
        rows.append(f"{STAMPS_S[i]} {STAMPS_S[i + 20]} {x} {y} {z} 0 0 {1 / 3}\n")
    path = folder / "a.relations"
    path.write_text("".join(rows))
    return path


def test_relations_serve_where_there_is_no_ground_truth(bench: Bench) -> None:
    body = Trajectory(STAMPS_S, *curve())
    sensor = move_sensor(body, np.reshape(MOUNTED, (4, 4)))
    write_tum(bench.estimate, sensor.stamps_s, sensor.positions_m, sensor.quats_xyzw)
    given: dict[str, Any] = {"reference": None, "files": {"relations": relations(bench.folder)}}
    result = bench.run(T_body_sensor=MOUNTED, artefacts=Artefacts.PLOTS, **given)
    assert result.reason is None
    assert (result.metrics["relations.matched_fraction"], result.matched_poses) == (1, 0)
    assert result.metrics["relations.translation.max"] == pytest.approx(0, abs=1e-6)
    assert result.metrics["relations.rotation.max"] == pytest.approx(0, abs=1e-5)
    assert result.missing["ate.rmse"] == "the dataset has relations and no ground-truth trajectory"
    assert result.missing["map.entropy"] == "the algorithm wrote no Map.pcd"
    assert set(result.metrics) | set(result.missing) == {
        key for key, entry in CATALOGUE.items() if entry.needs_protocol and key not in FROM_REPEATS
    }
    assert [name for name in FILES if (bench.folder / "out" / name).exists()] == []
    assert bench.run(**given).metrics["relations.translation.max"] > 0.01, "the lever arm counts"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"protocol": Protocol(Alignment.SIM3)}, "leaves the scale of the estimate open"),
        ({"protocol": Protocol(Alignment.SE3, offset_search_s=1.0)}, "a time offset can be searched only where"),
        ({"protocol": Protocol(Alignment.SE3, time_offset_s=1e6)}, "no poses at the times of any of the 19 relations"),
        ({"files": {}}, "the file of the dataset's relations does not exist"),
    ],
)
def test_relations_that_cannot_be_compared_are_told(bench: Bench, options: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"reference": None, "files": {"relations": relations(bench.folder)}}
    result = bench.run(**(given | options))
    assert message in (result.reason or "")
    assert result.metrics == {}


def test_a_map_is_measured_without_a_ground_truth_as_far_as_it_can_be(bench: Bench) -> None:
    side_m = np.linspace(0, 1, 40)
    floor = np.column_stack([*(axis.ravel() for axis in np.meshgrid(side_m, side_m)), np.zeros(1600)])
    files = {"relations": relations(bench.folder)} | {
        name: bench.folder / f"{name}.pcd" for name in ("map", "reference_map")
    }
    for name in ("map", "reference_map"):
        write_pcd(files[name], floor)
    result = bench.run(reference=None, files=files)
    assert {"map.points", "map.entropy"} <= result.metrics.keys()
    assert "nothing moves the map" in result.missing["map.chamfer"]


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("Singular matrix"), ZeroDivisionError("division by zero")])
def test_numbers_that_break_one_evaluator_leave_the_others(bench: Bench, monkeypatch, error: Exception) -> None:
    def broken(_self: Consistency, _paired: object) -> MetricValues:
        raise error

    monkeypatch.setattr(Consistency, "evaluate", broken)
    result = bench.run()
    assert result.reason is None
    assert "ate.rmse" in result.metrics
    assert result.missing["nees.position"] == f"it cannot be computed: {error}"


def test_only_the_ground_truth_of_a_clip_counts(bench: Bench):
    part = (STAMPS_S >= 10.0) & (STAMPS_S <= 12.0)
    positions_m, quats = curve()
    write_tum(bench.estimate, STAMPS_S[part], positions_m[part], quats[part])
    whole, clip = bench.run().metrics, bench.run(span_s=(10.0, 12.0)).metrics
    assert whole["tracked.path"] < 0.5
    assert clip["tracked.path"] == pytest.approx(1.0)
    assert "where the recording was clipped" in str(bench.run(span_s=(900.0, 901.0)).reason)
