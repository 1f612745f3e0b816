"""A ground truth that jumps, before four imported systems: what the command, the page, the API and a protocol say."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from slamhive.base.project import project_root
from slamhive.cli.main import main
from slamhive.cli.waiting import evaluate_to_end
from slamhive.domain.accounts import ANYBODY, Visibility
from slamhive.domain.protocol import ProtocolRequest
from slamhive.domain.sensors import SensorSetup
from slamhive.services.hive import Hive
from slamhive.services.imports.request import ImportRequest
from slamhive.services.sharing import SharingChange
from slamhive.trajectory.layout import read_tum, write_tum
from tests.web.web_world import Web, make_web

SOURCE = project_root().parent / "shared" / "data" / "euroc_vio_runs"
ROOT = Path(__file__).resolve().parents[2]
SYSTEMS = ("vio_mono", "vio_stereo", "vislam_ba", "vislam_rp")

pytestmark = [
    pytest.mark.shared_data,
    pytest.mark.integration,
    pytest.mark.skipif(not SOURCE.is_dir(), reason="the recorded runs are not in ../shared/data/euroc_vio_runs"),
]


@pytest.fixture
def web(hive: Hive, tmp_path: Path) -> Web:
    """The pages of an installation that can evaluate."""
    (tmp_path / "project" / "templates").rmdir()
    for name in ("templates", "static", "docs"):
        (tmp_path / "project" / name).symlink_to(ROOT / name)
    return make_web(hive)


def test_a_jump_of_the_truth_is_shown_and_can_be_left_out(web: Web, tmp_path: Path) -> None:
    source = tmp_path / "source"
    for name in SYSTEMS:
        (source / name / "V2_02").mkdir(parents=True)
        shutil.copyfile(SOURCE / name / "V2_02" / "0.txt", source / name / "V2_02" / "0.txt")
    truth = read_tum(SOURCE / "V2_02" / "groundtruth.txt")
    start_s = float(truth.stamps_s[0])
    wrong = truth.positions_m.copy()
    wrong[(truth.stamps_s > start_s + 40) & (truth.stamps_s < start_s + 46)] += [0.0, 0.3, 0.0]
    (source / "V2_02").mkdir()
    write_tum(source / "V2_02" / "groundtruth.txt", truth.stamps_s, wrong, truth.quats_xyzw)
    hive = web.hive
    sensors = {"": SensorSetup.STEREO_INERTIAL}
    report = hive.imports.carry_out(ImportRequest(source, sensors=sensors, gravity_aligned=True), lambda *_: None)
    assert web.client.get("/api/v1/datasets/V2_02/trial").status_code == 404
    assert "has not been tried yet" in web.client.get("/datasets/V2_02").text
    evaluate_to_end(hive.evaluations, hive.evaluations.queue(report.run_ids))

    plot = tmp_path / "residuals.svg"
    command = ["--data", str(hive.settings.data), "dataset", "trial", "V2_02"]
    shown = CliRunner().invoke(main, [*command, "--plot", str(plot)])
    assert shown.exit_code == 0, shown.output
    assert "The ground truth is wrong from " in shown.output
    assert "vio_mono" in shown.output
    assert "leave_out_s: [" in shown.output
    assert b"<svg" in plot.read_bytes()[:500]

    stored = web.client.get("/api/v1/datasets/V2_02/trial").get_json()
    assert stored["stretches"][0]["blame"] == "truth"
    assert set(stored["runs"]) == set(SYSTEMS)
    page = web.client.get("/datasets/V2_02").text
    assert "contradict the ground truth in" in page
    figures = web.client.get("/datasets/V2_02/figures.json").get_json()["figures"]
    assert [trace["name"] for trace in figures["residuals"]["data"]][-1] == "in common"
    assert len(figures["residuals"]["layout"]["shapes"]) == len(stored["stretches"])

    leaving = ProtocolRequest({"leave_out_s": stored["leave_out_s"]}, "leaving")
    ended = evaluate_to_end(hive.evaluations, hive.evaluations.queue(report.run_ids, leaving))
    assert "without" in ended[0].protocol.label
    for entry in ended:
        by_protocol = hive.current_protocols.figures(entry.run_id)
        leaving_out = by_protocol.pop(entry.protocol.fingerprint)
        assert leaving_out["ate.rmse"] < 0.9 * min(values["ate.rmse"] for values in by_protocol.values())

    (hive.settings.datasets_folder / "V2_02" / "groundtruth.txt").write_bytes(
        (SOURCE / "V2_02" / "groundtruth.txt").read_bytes()
    )
    assert hive.truth_trials.stored(hive.catalogue.dataset("V2_02")) is None, "the ground truth has changed since"
    token = web.client.get("/datasets/V2_02").text.partition('name="csrf_token" value="')[2].partition('"')[0]
    answer = web.client.post("/datasets/V2_02/trial", data={"csrf_token": token})
    assert answer.status_code == 303
    again = json.loads(CliRunner().invoke(main, [*command, "--json"]).stdout)
    assert again["stretches"] == []
    assert np.isfinite([value for value in again["common_m"] if value is not None]).all()


def test_a_trial_needs_three_systems(web: Web) -> None:
    shown = CliRunner().invoke(main, ["--data", str(web.hive.settings.data), "dataset", "trial", "track"])
    assert "no verdict, 3 systems are needed, 0 have poses" in shown.output
    assert "No verdict: 3 systems are needed" in web.client.get("/datasets/track").text


def test_private_runs_bear_no_witness_and_visitors_see_no_trial(web: Web, tmp_path: Path) -> None:
    source = tmp_path / "source"
    for name in SYSTEMS[:2]:
        (source / name / "V2_02").mkdir(parents=True)
        shutil.copyfile(SOURCE / name / "V2_02" / "0.txt", source / name / "V2_02" / "0.txt")
    (source / "V2_02").mkdir()
    shutil.copyfile(SOURCE / "V2_02" / "groundtruth.txt", source / "V2_02" / "groundtruth.txt")
    hive = web.hive
    sensors = {"": SensorSetup.STEREO_INERTIAL}
    report = hive.imports.carry_out(ImportRequest(source, sensors=sensors, gravity_aligned=True), lambda *_: None)
    evaluate_to_end(hive.evaluations, hive.evaluations.queue(report.run_ids))
    dataset = hive.catalogue.dataset("V2_02")
    (hidden, kept) = sorted(hive.truth_trials.witnesses(dataset), key=lambda witness: witness.system)
    hive.sharings.runs([hidden.run.id], SharingChange(Visibility.PRIVATE))
    assert [witness.system for witness in hive.truth_trials.witnesses(dataset)] == [kept.system]
    hive.truth_trials.judge(dataset)
    assert hive.truth_trials.stored(dataset) is not None
    with hive.store.seen_by(ANYBODY):
        assert hive.truth_trials.stored(dataset) is None
