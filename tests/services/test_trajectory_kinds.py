"""Runs that give several trajectories: what is stored, what is evaluated, and what lists show."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import InvalidInput
from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind, exactly, protocol_from_content
from slamhive.evaluation.job import EvaluationResult
from slamhive.runtime.trajectory import Poses, Trajectories, write_trajectories
from slamhive.services.evaluations.service import estimate_of, other_trajectories
from slamhive.services.hive import Hive
from slamhive.store import Lease
from tests.web import web_world as world

pytestmark = pytest.mark.integration

LIVE, FINAL, KEYFRAMES = TrajectoryKind.LIVE, TrajectoryKind.FINAL, TrajectoryKind.KEYFRAMES
SE3 = Protocol(Alignment.SE3)


@pytest.fixture
def hive(tmp_path: Path, sqlite_template: Path) -> Iterator[Hive]:
    (tmp_path / "data").mkdir()
    shutil.copy(sqlite_template, tmp_path / "data" / "slamhive.db")
    opened = world.make_hive(tmp_path)
    yield opened
    opened.close()


def finished_run(hive: Hive, kind: TrajectoryKind | None, *others: TrajectoryKind) -> int:
    (run_id,) = world.add_runs(hive)
    world.finish_run(hive, run_id)
    hive.runs.folder(run_id).current_protocol.parent.mkdir()
    hive.store.write(lambda t: t.runs.update(run_id, None, trajectory=kind))
    for other in others:
        np.savetxt(hive.runs.folder(run_id).trajectory_of(other), world.loop_path(noise_m=0.5))
    return run_id


def evaluated(hive: Hive, run_id: int, evaluation_id: int, protocol: Protocol, ate_m: float) -> None:
    result = EvaluationResult(str(evaluation_id), protocol.fingerprint, None, {"ate.rmse": ate_m}, 400, 398, "evo 1.0")

    def work(t):
        t.evaluations.claim(Lease("test", world.NOW, 30.0), runs=[run_id])
        t.evaluations.finish(evaluation_id, "test", result, world.NOW)

    hive.store.write(work)


def test_each_trajectory_is_evaluated_and_the_main_one_is_shown(hive: Hive) -> None:
    run_id = finished_run(hive, FINAL, LIVE, KEYFRAMES)
    ids = hive.evaluations.queue([run_id])
    records = {entry.protocol.trajectory: entry for entry in hive.evaluations.records(ids)}
    assert set(records) == {None, LIVE, KEYFRAMES}
    evaluated(hive, run_id, records[LIVE].id, records[LIVE].protocol, 0.26)
    assert hive.runs.get(run_id).protocol is None
    evaluated(hive, run_id, records[None].id, records[None].protocol, 0.003)
    run = hive.runs.get(run_id)
    assert run.trajectory is FINAL
    assert (run.metrics or {})["ate.rmse"] == 0.003
    label = records[LIVE].protocol.label
    assert "live trajectory" in label
    hive.current_protocols.use([run_id], records[LIVE].protocol.fingerprint)
    shown = hive.runs.get(run_id)
    assert ((shown.metrics or {})["ate.rmse"], shown.protocol and shown.protocol.label) == (0.26, label)


def test_a_protocol_that_names_a_kind_takes_that_file(hive: Hive) -> None:
    both, live = finished_run(hive, FINAL, LIVE), finished_run(hive, LIVE)
    asked = replace(SE3, trajectory=LIVE)
    folders = {run_id: hive.runs.folder(run_id) for run_id in (both, live)}
    assert estimate_of(hive.runs.get(both), folders[both], asked).name == "traj.live.txt"
    assert estimate_of(hive.runs.get(live), folders[live], asked).name == "traj.txt"
    assert estimate_of(hive.runs.get(both), folders[both], SE3).name == "traj.txt"
    with pytest.raises(InvalidInput, match=f"run {live} has no keyframe trajectory; it has live"):
        estimate_of(hive.runs.get(live), folders[live], replace(SE3, trajectory=KEYFRAMES))
    folders[live].trajectory_of(FINAL).touch()
    assert other_trajectories(hive.runs.get(live), folders[live]) == []


def test_runs_of_before_state_nothing_and_stay_valid(hive: Hive) -> None:
    old, new = finished_run(hive, None), finished_run(hive, LIVE)
    found = hive.runs.page(hive.searches.read("trajectory = live")).records
    assert [run.id for run in found] == [new]
    assert len(hive.evaluations.queue([old])) == 1
    with pytest.raises(InvalidInput, match=r"no live trajectory; it has traj\.txt, whose kind is not stated"):
        estimate_of(hive.runs.get(old), hive.runs.folder(old), replace(SE3, trajectory=LIVE))


def test_lists_that_mix_kinds_say_so(hive: Hive) -> None:
    runs = [finished_run(hive, kind) for kind in (LIVE, FINAL, None)]
    for run_id in runs:
        world.evaluate_run(hive, run_id)
    mixed = hive.current_protocols.mixed(runs)
    assert mixed is not None
    assert mixed.words == "1 run uses the final trajectory, 1 the live trajectory, 1 an unstated one: not comparable."
    assert hive.current_protocols.mixed(runs[1:]) is None


def test_runs_are_shown_with_the_kind_that_was_judged(hive: Hive) -> None:
    runs = [finished_run(hive, kind) for kind in (LIVE, LIVE, FINAL, None)]
    for run_id in runs:
        world.evaluate_run(hive, run_id)
    first, _, final, unknown = (hive.runs.get(run_id).protocol for run_id in runs)
    assert first is not None
    assert final is not None
    assert unknown is not None
    assert (first.label, final.label) == (f"{unknown.label}, live trajectory", f"{unknown.label}, final trajectory")
    same = hive.run_comparisons.of(runs[:2])
    assert same.protocol is not None
    assert (same.protocol.label, same.mixed_trajectories) == (first.label, {})
    mixed = hive.run_comparisons.of(runs)
    assert mixed.protocol is not None
    assert mixed.protocol.label == unknown.label
    assert mixed.mixed_trajectories == {"live": (runs[0], runs[1]), "final": (runs[2],)}


def test_the_label_of_a_protocol_names_the_trajectory_in_english() -> None:
    assert "keyframe trajectory" in replace(SE3, trajectory=KEYFRAMES).label


def test_the_field_changes_no_fingerprint_of_before() -> None:
    assert "trajectory" not in SE3.content
    named = replace(SE3, trajectory=KEYFRAMES)
    assert named.fingerprint != SE3.fingerprint
    assert protocol_from_content(named.content) == named
    assert exactly(SE3, "x").on(named) == SE3


def test_the_runtime_writes_what_holds_poses(tmp_path: Path) -> None:
    poses, none = Poses(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1))), Poses(np.empty(0), np.empty((0, 4, 4)))
    assert write_trajectories(tmp_path, Trajectories(poses, {"live": poses, "keyframes": none})) is poses
    assert sorted(path.name for path in tmp_path.iterdir()) == ["traj.live.txt", "traj.txt"]
    assert write_trajectories(tmp_path / ".", none) is none
    assert (tmp_path / "traj.txt").read_text().count("\n") == 1
