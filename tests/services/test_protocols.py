"""Protocols by name, the one that is shown, and a run as published tools count; evaluated for real."""

from __future__ import annotations

import json
from math import cos, sin
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.base.errors import Conflict, InvalidInput, NotFound
from slamhive.base.settings import Settings
from slamhive.cli.main import main
from slamhive.documents.submission import Submission
from slamhive.domain.protocol import Alignment, ProtocolRequest
from slamhive.domain.run import RunState
from slamhive.evaluation.presets import PRESETS
from slamhive.executors.spec import RunSpec
from slamhive.executors.status import Exited
from slamhive.services.evaluations import SENSOR_FRAME
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from tests.services.fake_executor import FakeExecutor

pytestmark = pytest.mark.integration


@pytest.fixture
def run_id(hive: Hive) -> int:
    """A run that succeeded, whose trajectory is the ground truth, one centimetre larger in a metre."""

    path = hive.settings.datasets_folder / "track" / "groundtruth.txt"
    # A ground truth that never turns on its winding path would count as positions alone.
    lines = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    halves = [0.002 * number for number in range(len(lines))]
    turned = [
        [*row[:4], "0", "0", f"{sin(half):.9f}", f"{cos(half):.9f}"] for row, half in zip(lines, halves, strict=True)
    ]
    path.write_text("".join(" ".join(row) + "\n" for row in turned))

    def write(spec: RunSpec) -> None:
        truth = (hive.settings.datasets_folder / "track" / "groundtruth.txt").read_text()
        rows = [line.split() for line in truth.splitlines() if not line.startswith("#")]
        scaled = [[row[0], *(f"{1.01 * float(value):.9f}" for value in row[1:4]), *row[4:]] for row in rows]
        folder = hive.runs.folder(number)
        folder.trajectory.write_text("".join(" ".join(row) + "\n" for row in scaled))

    hive.executors.opened["process"] = FakeExecutor([Exited(0)], write)
    number = hive.runs.submit(Submission("tiny", "track", executor="process", evaluate=False))[0].id
    hive.worker().run(until_idle=True)
    hive.executors.opened.clear()
    assert hive.runs.get(number).state is RunState.SUCCEEDED
    return number


def evaluate(hive: Hive, run_id: int, name: str | None = None) -> None:
    hive.evaluations.queue([run_id], name)
    hive.worker().run(until_idle=True)


def ate_m(hive: Hive, run_id: int) -> float:
    return (hive.runs.get(run_id).metrics or {})["ate.rmse"]


def test_names_files_and_fingerprints_lead_to_a_protocol(hive: Hive, tmp_path: Path) -> None:
    protocols = hive.protocols
    assert protocols.named("default") == ProtocolRequest(name="default")
    assert protocols.named("sim3").values == {"alignment": "sim3"}
    assert protocols.named("tum").values["association"] == "one_to_one"
    path = tmp_path / "mine.yaml"
    path.write_text("alignment: sim3\nrpe_delta_m: 2\n")
    assert protocols.find(str(path)).values == {"alignment": "sim3", "rpe_delta_m": 2.0}
    with pytest.raises(NotFound, match="unknown protocol 'evvo'; did you mean 'evo'"):
        protocols.find("evvo")
    with pytest.raises(NotFound, match="unknown protocol 'simm3'; did you mean 'sim3'"):
        protocols.find("simm3")
    with pytest.raises(NotFound, match="unknown protocol '0123456789ab'"):
        protocols.find("0123456789ab")
    with pytest.raises(InvalidInput, match=r"none\.yaml does not exist"):
        protocols.find("none.yaml")


def test_another_protocol_leaves_what_is_shown_until_it_is_chosen(hive: Hive, run_id: int) -> None:
    evaluate(hive, run_id, "se3")
    shown = ate_m(hive, run_id)
    assert shown > 0
    evaluate(hive, run_id, "sim3")
    assert ate_m(hive, run_id) == shown
    figures = hive.current_protocols.figures(run_id)
    assert len(figures) == 2
    sim3 = next(entry.protocol for entry in hive.protocols.used() if entry.protocol.alignment is Alignment.SIM3)
    assert figures[sim3.fingerprint]["ate.rmse"] < 1e-6 < shown
    hive.current_protocols.use([run_id], sim3.fingerprint)
    assert ate_m(hive, run_id) == figures[sim3.fingerprint]["ate.rmse"]
    assert hive.protocols.named(sim3.fingerprint).on(sim3) == sim3
    with pytest.raises(Conflict, match="has no metrics under protocol"):
        hive.current_protocols.use_asked([run_id], hive.protocols.named("none"))
    assert ate_m(hive, run_id) == figures[sim3.fingerprint]["ate.rmse"]


def test_the_choice_survives_a_lost_database(hive: Hive, run_id: int) -> None:
    for name in ("sim3", "se3"):
        evaluate(hive, run_id, name)
    before = hive.runs.get(run_id)
    assert before.protocol is not None
    assert before.protocol.label.startswith("Sim(3)")
    reindex(hive, lambda _done, _total: None)
    assert hive.runs.get(run_id).protocol == before.protocol
    assert hive.runs.get(run_id).metrics == before.metrics


def test_a_failed_evaluation_leaves_the_older_one_alone(hive: Hive, run_id: int) -> None:
    evaluate(hive, run_id, "se3")
    before, record = hive.runs.get(run_id), hive.runs.record(run_id)
    evaluate(hive, run_id, "kitti")
    hive.runs.folder(run_id).trajectory.write_text("nonsense\n")
    evaluate(hive, run_id, "sim3")
    failed = hive.evaluations.of_run(run_id)[-1]
    assert (failed.reason or "").startswith("estimate traj.txt, line 1: 'nonsense' is not a number")
    assert hive.runs.get(run_id) == before
    assert hive.runs.record(run_id) == record


def test_a_run_as_every_tool_counts(hive: Hive, run_id: int) -> None:
    evaluate(hive, run_id)
    shown = hive.runs.get(run_id)
    assert {row.note for row in hive.comparisons.of(run_id)} == {"not evaluated"}
    hive.comparisons.queue(run_id)
    hive.worker().run(until_idle=True)
    rows = {row.name: row for row in hive.comparisons.of(run_id)}
    assert list(rows) == PRESETS.names()
    assert rows["evo"].figures["ate.rmse"] > rows["rpg"].figures["ate.rmse"]
    assert rows["kitti"].note == "the path is 37.43 m, the shortest segment 100 m"
    assert not rows["kitti"].figures
    assert hive.runs.get(run_id) == shown, "comparing changes nothing of what is shown"
    assert str(rows["eth3d"].note).startswith("no two poses of the ground truth are within 0.0133333 s")
    again = hive.comparisons.queue(run_id)
    assert len(again) == 1, "what is there is not evaluated again, only what failed"


def test_too_few_poses_for_the_alignment_are_refused_before_anything_is_queued(hive: Hive, run_id: int) -> None:
    asked = ProtocolRequest({"alignment": "sim3", "align_poses": 3}, "mine.yaml")
    with pytest.raises(InvalidInput, match="sim3 needs at least 4 poses, align_poses is 3; use 4 or more"):
        hive.evaluations.queue([run_id], asked)
    for alignment in ("se3", "yaw_position"):
        hive.evaluations.queue([run_id], ProtocolRequest({"alignment": alignment, "align_poses": 1}, "one"))
    hive.worker().run(until_idle=True)
    assert len(hive.current_protocols.figures(run_id)) == 2


def test_a_protocol_that_does_not_fit_the_dataset_is_refused(hive: Hive, run_id: int) -> None:
    asked = ProtocolRequest({"reference": "leica.txt"}, "mine.yaml")
    with pytest.raises(InvalidInput, match=r"dataset track has no file 'leica\.txt' to compare with"):
        hive.evaluations.queue([run_id], asked)
    truth = hive.settings.datasets_folder / "track" / "groundtruth.txt"
    (truth.parent / "leica.txt").write_text(truth.read_text())
    hive.evaluations.queue([run_id], asked)
    hive.worker().run(until_idle=True)
    assert ate_m(hive, run_id) > 0
    description = truth.parent / "dataset.yaml"
    description.write_text(description.read_text().replace("gravity_aligned: true", "gravity_aligned: false"))
    with pytest.raises(InvalidInput, match="needs a ground truth whose z axis points up; that of track does not"):
        hive.evaluations.queue([run_id], "yaw_position")
    assert "does not fit" in str({row.name: row for row in hive.comparisons.of(run_id)}["ov"].note)


def test_the_settings_take_part_unless_a_preset_says_otherwise(hive: Hive, run_id: int) -> None:
    hive.evaluations._settings = Settings(data=hive.settings.data, association_tolerance_s=0.5)
    of = hive.evaluations.protocol_of
    run = hive.runs.get(run_id)
    assert of(run).association_tolerance_s == 0.5
    assert of(run, hive.protocols.named("sim3")).association_tolerance_s == 0.5
    assert of(run, hive.protocols.named("evo")).association_tolerance_s == 0.01
    assert json.loads(json.dumps(of(run).content))["association_tolerance_s"] == 0.5


def test_the_frame_of_a_sensor_is_taken_from_the_dataset(hive: Hive, run_id: int) -> None:
    run, dataset = hive.runs.get(run_id), hive.catalogue.dataset("track")
    sensor = dataset.sensors[0]
    protocol = hive.evaluations.protocol_of(run, ProtocolRequest({SENSOR_FRAME: sensor.name}))
    assert protocol.T_body_sensor == sensor.T_body_sensor
    with pytest.raises(NotFound, match="dataset track has no sensor 'cam9'"):
        hive.evaluations.protocol_of(run, ProtocolRequest({SENSOR_FRAME: "cam9"}))


def test_a_printed_number_leads_to_the_protocols_that_give_it(hive: Hive, run_id: int) -> None:
    hive.evaluations.queue([run_id], "evo")
    hive.worker().run(until_idle=True)
    (values,) = hive.current_protocols.figures(run_id).values()
    printed = f"{values['ate.rmse']:.5f}"
    found = hive.protocol_searches.search(run_id, printed, "ate")
    assert found.matches[0].preset == "evo"
    assert found.matches[0].value == pytest.approx(values["ate.rmse"], abs=1e-12)
    assert found.tried > 1000
    with pytest.raises(InvalidInput, match="'errors' is not known; use one of ate, ate_rot"):
        hive.protocol_searches.search(run_id, printed, "errors")
    arguments = ["--data", str(hive.settings.data), "protocol", "search", str(run_id), "--ate"]
    shown = CliRunner().invoke(main, [*arguments, printed, "--json"])
    assert json.loads(shown.stdout)["matches"][0]["preset"] == "evo"
    assert CliRunner().invoke(main, [*arguments, "123456"]).exit_code == 1
