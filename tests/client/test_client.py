"""The Python client answers the same on the files of a data root and over HTTP."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from slamhive.base.errors import Forbidden, InvalidInput, NotFound
from slamhive.client import Hive
from slamhive.services.hive import open_hive
from tests.web.web_world import RUNS, loop_path

pytestmark = pytest.mark.quick


@pytest.mark.integration
def test_runs_are_searched_and_sorted(client: Hive) -> None:
    assert [run.id for run in client.runs] == [5, 4, 3, 2, 1]
    assert [run.id for run in client.runs.sort("id")] == [1, 2, 3, 4, 5]
    good = client.runs.where("ate.rmse < 0.1")
    assert ([run.id for run in good], len(good)) == ([RUNS["done"]], 1)
    both = client.runs.where("state = succeeded or state = failed").where("id > 1")
    assert [run.id for run in both] == [RUNS["failed"], RUNS["bare"]]
    assert len(client.runs.where("ate.rmse > 5")) == 0


def test_a_run_tells_what_is_known_of_it(client: Hive) -> None:
    run = client.runs.get(RUNS["done"])
    assert (run.id, run.algorithm, run.dataset, run.state) == (1, "eye-slam-stereo", "room", "succeeded")
    assert run.parameters["nFeatures"] == 2000
    assert run.metrics["ate.rmse"] == 0.04567
    assert "tracking" in run.log
    assert "traj.txt" in run.files
    assert json.loads(run.file("run.json"))["id"] == 1
    assert "eye-slam-stereo on room, succeeded" in repr(run)
    assert run.refresh().document == run.document


def test_documents_are_those_of_the_command_line(client: Hive, installation: Path) -> None:
    hive = open_hive({"data": str(installation)})
    assert client.runs.get(1).document.content == hive.runs.in_full(1).content
    hive.close()


def test_claims_are_those_that_were_checked(client: Hive) -> None:
    (found,) = client.claims()
    assert (found.name, found.words) == ("paper", "1 of 4 hold")
    assert [claim.state for claim in found.claims] == ["holds", "differs", "undecided", "cannot be run"]


def test_trajectories_go_to_evo(client: Hive) -> None:
    run = client.runs.get(RUNS["done"])
    found = run.trajectory().to_evo()
    expected = loop_path(noise_m=0.02)
    np.testing.assert_allclose(found.timestamps, expected[:, 0])
    np.testing.assert_allclose(found.positions_xyz, expected[:, 1:4])
    np.testing.assert_allclose(found.orientations_quat_wxyz, np.roll(expected[:, 4:8], 1, axis=1))
    assert found.check()[0]
    np.testing.assert_allclose(run.groundtruth().positions_m, loop_path()[:, 1:4])
    assert len(run.trajectory(aligned=True)) == 400
    assert list(run.trajectory().to_pandas()) == ["timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw"]


def test_runs_become_a_data_frame(client: Hive) -> None:
    frame = client.runs.sort("id").to_pandas()
    assert list(frame["id"]) == [1, 2, 3, 4, 5]
    assert list(frame["state"]) == ["succeeded", "succeeded", "failed", "running", "queued"]
    assert set(frame["parameter.nFeatures"]) == {2000}
    assert frame["ate.rmse"].dtype == float
    assert frame["ate.rmse"][0] == 0.04567
    assert frame["ate.rmse"].isna().sum() == 4
    assert str(frame["created_at"].dtype).endswith("UTC]")
    assert "gpu.memory.max" not in frame


def test_a_data_frame_has_the_chosen_columns(client: Hive) -> None:
    frame = client.runs.where("state = succeeded").to_pandas(["id", "ate.rmse", "parameter.nFeatures"])
    assert list(frame) == ["id", "ate.rmse", "parameter.nFeatures"]
    assert frame["parameter.nFeatures"].tolist() == [2000, 2000]


@pytest.mark.integration
def test_no_runs_are_an_empty_data_frame(client: Hive) -> None:
    frame = client.runs.where("id > 99").to_pandas()
    assert len(frame) == 0
    assert "algorithm" in frame


def test_datasets_and_algorithms_are_documents(client: Hive) -> None:
    (name,) = [dataset.name for dataset in client.datasets if dataset.name == "room"]
    room = client.datasets.get(name)
    assert room.duration_s > 0
    assert {sensor.kind for sensor in room.sensors}
    assert client.algorithms.get("eye-slam-stereo") in list(client.algorithms)
    with pytest.raises(NotFound, match="no-such"):
        client.datasets.get("no-such")
    with pytest.raises(NotFound, match="no-such"):
        client.algorithms.get("no-such")


def test_mistakes_name_the_value(client: Hive) -> None:
    with pytest.raises(NotFound, match="99"):
        client.runs.get(99)
    with pytest.raises(InvalidInput, match=r"ate\.rmse"):
        list(client.runs.where("ate.rmse < low"))
    with pytest.raises(NotFound, match="no_such_column"):
        client.runs.to_pandas(["no_such_column"])
    with pytest.raises(NotFound, match=r"no-file\.txt"):
        client.runs.get(1).file("no-file.txt")
    with pytest.raises(NotFound, match="run 2 has not been evaluated"):
        client.runs.get(RUNS["bare"]).groundtruth()
    with pytest.raises(NotFound, match="no_such_experiment"):
        client.experiments.get("no_such_experiment")


def test_what_only_reads_changes_nothing(client: Hive) -> None:
    with pytest.raises(Forbidden):
        client.runs.submit("eye-slam-stereo", "room")
    with pytest.raises(Forbidden):
        client.runs.get(RUNS["queued"]).cancel()
    with pytest.raises(Forbidden):
        client.runs.where("id > 0").delete()
    with pytest.raises(Forbidden):
        client.experiments.start("name: nothing\n")
    with pytest.raises(Forbidden):
        client.runs.get(RUNS["done"]).annotate("a note")


def test_unknown_options_are_refused(client: Hive) -> None:
    with pytest.raises(InvalidInput, match="repeats"):
        client.runs.submit("eye-slam-stereo", "room", repeats=3)


def test_reading_creates_nothing(copy: Path) -> None:
    before = {path: path.stat().st_size for path in copy.rglob("*")}
    with Hive.open(copy) as hive:
        assert len(hive.runs) == 5
        hive.runs.get(1).trajectory()
        hive.runs.to_pandas()
        assert list(hive.experiments) == []
    assert {path: path.stat().st_size for path in copy.rglob("*")} == before


def test_a_mistyped_data_root_stays_missing(tmp_path: Path) -> None:
    for writable in (False, True):
        with pytest.raises(NotFound, match="does not exist"):
            Hive.open(tmp_path / "wrong", writable=writable)
    assert not list(tmp_path.iterdir())
