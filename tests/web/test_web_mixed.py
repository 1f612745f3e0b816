"""Runs side by side under several protocols: one banner on each page, whose button brings them under one."""

from __future__ import annotations

import json
import re
import threading
from html import unescape
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.base.settings import Mode
from slamhive.cli import main
from slamhive.domain.protocol import Alignment, Protocol, TrajectoryKind
from slamhive.domain.side_by_side import of_live
from slamhive.filters.binding import Search
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.stored_analyses.computing import AnalysisJobs
from slamhive.store.searches import SearchRepository
from tests.web import web_world as world
from tests.web.test_web_experiments import TRIAL
from tests.web.web_world import PROTOCOL, Web

pytestmark = pytest.mark.quick

SIM3 = Protocol(Alignment.SIM3)
SAID = (
    "3 runs use SE(3), 2 Sim(3): not comparable. "
    f"Evaluate all under Sim(3): slamhive evaluate RUNS --protocol {SIM3.fingerprint} --current"
)
BANNER = re.compile(r"<div class=\"alert alert-warning mixed\".*?</div>", re.DOTALL)


def mix(web: Web) -> tuple[list[int], list[int]]:
    """Two runs under Sim(3) and three under SE(3), counting the one that is there."""
    mono, stereo = world.add_runs(web.hive, 2, "eye-slam-mono"), world.add_runs(web.hive, 2)
    for runs, protocol in ((mono, SIM3), (stereo, PROTOCOL)):
        for run in runs:
            world.finish_run(web.hive, run)
            world.evaluate_run(web.hive, run, protocol=protocol)
    return mono, [web.runs["done"], *stereo]


def banner(web: Web, address: str) -> str:
    found = BANNER.search(web.client.get(address).text)
    return "" if found is None else found[0]


def press(web: Web, text: str, **changed: str) -> str:
    """Press the button of a banner; the address that it leads to."""
    fields = dict(re.findall(r'name="(\w+)" value="([^"]*)"', text)) | changed
    data = {name: unescape(value) for name, value in fields.items()}
    action = re.search(r'action="([^"]+)"', text)
    assert action is not None
    answer = web.client.post(action[1], data=data)
    assert answer.status_code == 303, answer.text
    return str(answer.location)


def test_a_list_says_how_many_use_what_and_offers_the_protocol_that_fits_all(web: Web) -> None:
    _, stereo = mix(web)
    for address in ("/runs", "/runs?group=configuration", "/runs?where=id > 0&sort=ate.rmse"):
        text = banner(web, address)
        assert "3 runs use SE(3), 2 Sim(3): not comparable." in text, address
        assert "Evaluate all under Sim(3)</button>" in text
    assert banner(web, "/runs?where=algorithm = eye-slam-mono") == ""
    target = press(web, banner(web, "/runs?sort=ate.rmse"))
    assert target == "/runs?sort=ate.rmse"
    assert "4 evaluations queued" in web.client.get(target).text
    waiting = {entry.run_id: entry.protocol for entry in web.hive.evaluations.waiting()}
    assert waiting == dict.fromkeys([*stereo, web.runs["bare"]], SIM3)


@pytest.mark.parametrize("address", ["/runs", "/runs?group=configuration"])
def test_of_very_many_runs_those_on_the_page_decide_and_no_ids_are_read(
    web: Web, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    mix(web)
    read: list[object] = []

    def run_ids(searches: SearchRepository, search: Search) -> list[int]:
        read.append(search)
        return original(searches, search)

    original = SearchRepository.run_ids
    monkeypatch.setattr(SearchRepository, "run_ids", run_ids)
    assert "not comparable" in banner(web, address)
    assert len(read) == 1
    monkeypatch.setattr("slamhive.services.searches.COUNTED", 5)
    assert "not comparable" in banner(web, f"{address}{'&' if '?' in address else '?'}where=id > 0")
    assert len(read) == 1


def test_the_command_line_says_it_below_lists_groups_and_files(web: Web) -> None:
    mix(web)
    for options in ((), ("--group", "configuration"), ("--json",), ("--csv",), ("--csv", "--group", "configuration")):
        said = CliRunner().invoke(main, ["--data", str(web.hive.settings.data), "runs", *options])
        assert said.exit_code == 0, said.output
        assert SAID in said.stderr.replace("\n", " "), options
    alone = ["--data", str(web.hive.settings.data), "runs", "--where", "algorithm = eye-slam-mono"]
    assert "not comparable" not in CliRunner().invoke(main, alone).stderr


def test_a_plan_says_it_before_the_start_and_names_the_option(
    web: Web, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other").mkdir()
    project = world.make_project(tmp_path / "other")
    (project / "configuration.py").touch()
    monkeypatch.setenv("SLAMHIVE_ROOT", str(project))
    file = tmp_path / "both.yaml"
    file.write_text("name: both\nalgorithms: [eye-slam-mono, eye-slam-stereo]\ndatasets: room\nrepeats: 2\n")
    plan = ["--data", str(web.hive.settings.data), "experiment", "plan", str(file)]
    option = "evaluate: {alignment: sim3}"
    said = f"2 runs use SE(3), 2 Sim(3): not comparable. To evaluate all under Sim(3), add to the file: {option}"
    assert said in CliRunner().invoke(main, plan).stderr
    assert json.loads(CliRunner().invoke(main, [*plan, "--json"]).stdout)["mixed_protocols"] == said
    file.write_text(f"{file.read_text()}{option}\n")
    assert json.loads(CliRunner().invoke(main, [*plan, "--json"]).stdout)["mixed_protocols"] is None
    # The same of the kinds of trajectories that packages say they leave.
    package = project / "algorithms" / "eye-slam" / "algorithm.yaml"
    for role, kind in (("image", "final"), ("left", "live")):
        package.write_text(package.read_text().replace(f"_role: {role}}}", f"_role: {role}, trajectory: {kind}}}"))
    said = json.loads(CliRunner().invoke(main, [*plan, "--json"]).stdout)["mixed_protocols"]
    assert said.startswith("2 runs use the final trajectory, 2 the live trajectory: not comparable.")
    assert "trajectory: live}" in said
    file.write_text(file.read_text().replace(option, "evaluate: {alignment: sim3, trajectory: live}"))
    assert json.loads(CliRunner().invoke(main, [*plan, "--json"]).stdout)["mixed_protocols"] is None


def test_the_new_results_are_shown_as_soon_as_they_are_there(web: Web) -> None:
    _, stereo = mix(web)
    press(web, banner(web, "/runs"))
    for run in [*stereo, web.runs["bare"]]:
        world.evaluate_run(web.hive, run, 0.02, protocol=SIM3)
    assert banner(web, "/runs") == ""
    shown = {web.hive.runs.get(run).protocol for run in stereo}
    assert {label.fingerprint for label in shown if label is not None} == {SIM3.fingerprint}


def test_runs_that_have_the_protocol_already_are_switched_without_an_evaluation(web: Web) -> None:
    _, stereo = mix(web)
    for run in stereo:
        world.evaluate_run(web.hive, run, protocol=SIM3)
    assert banner(web, "/runs") != ""
    press(web, banner(web, "/runs"))
    assert banner(web, "/runs") == ""


def test_selected_runs_are_evaluated_under_the_chosen_protocol_which_lists_then_show(web: Web) -> None:
    _, stereo = mix(web)
    page = web.client.get("/runs").text
    assert re.search(r'<select name="protocol".*?<option value="sim3">Sim\(3\)', page, re.DOTALL)
    web.client.post("/runs/evaluate", data={"csrf_token": web.token, "run": stereo, "protocol": "sim3"})
    assert {entry.protocol for entry in web.hive.evaluations.waiting()} == {SIM3}
    for run in stereo:
        world.evaluate_run(web.hive, run, 0.02, protocol=SIM3)
    assert [run.protocol and run.protocol.label.partition(",")[0] for run in map(web.hive.runs.get, stereo)] == (
        ["Sim(3)"] * 3
    )


def test_a_comparison_and_the_editor_of_analyses_say_the_same(web: Web) -> None:
    mono, stereo = mix(web)
    runs = ",".join(map(str, [*mono, *stereo]))
    text = banner(web, f"/compare?runs={runs}")
    assert "3 runs use SE(3), 2 Sim(3): not comparable." in text
    assert press(web, text).startswith("/compare?runs=")
    assert banner(web, f"/compare?runs={','.join(map(str, stereo))}") == ""
    assert "3 runs use SE(3), 2 Sim(3): not comparable." in banner(web, "/analyses/new")
    yaml = f"name: both\nselect: {{runs: {{runs: [{runs}]}}}}\nforms: [{{form: by_algorithm}}]\n"
    answer = web.client.post("/analyses/check", data={"csrf_token": web.token, "yaml": yaml}).get_json()
    assert (answer["ok"], answer["message"]) == (False, "both: 3 runs use SE(3), 2 Sim(3): not comparable.")
    named = yaml + f"protocol: {SIM3.fingerprint}\n"
    answer = web.client.post("/analyses/check", data={"csrf_token": web.token, "yaml": named}).get_json()
    assert answer["message"] == "both: valid."


def test_a_run_without_a_live_trajectory_is_named_instead_of_offered_again(web: Web) -> None:
    """The button for live trajectories worked for one run, and failed for the other, which has a final one only."""
    live = of_live(PROTOCOL)
    done, other = web.runs["done"], web.runs["bare"]
    world.evaluate_run(web.hive, other)
    world.set_trajectory(web.hive, [done], TrajectoryKind.LIVE)
    world.set_trajectory(web.hive, [other], TrajectoryKind.FINAL)
    world.evaluate_run(web.hive, done, protocol=live)
    web.hive.current_protocols.use([done], live.fingerprint)
    assert "Evaluate all under SE(3), live trajectory" in banner(web, "/runs")
    world.evaluate_run(web.hive, other, reason="run has no live trajectory", protocol=live)
    text = banner(web, "/runs")
    assert "No evaluation of the live trajectory of 1 run succeeded." in text
    assert "Evaluate all" not in text


@pytest.mark.parametrize("large", [None, 1], ids=["small", "large"])
def test_the_page_of_an_experiment_of_any_size_has_the_banner_whose_button_comes_back(
    web: Web, monkeypatch: pytest.MonkeyPatch, large: int | None
) -> None:
    """An experiment with more configurations than a page counts at once had no banner."""
    if large is not None:
        monkeypatch.setattr("slamhive.web.views.experiments.LARGE", large)
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    web.hive.experiments.start(ExperimentSource(TRIAL))
    mono, stereo = (
        [run.id for cell in web.hive.experiments.cells("trial", first, 1).cells for run in cell.runs]
        for first in (0, 3)
    )
    for run in mono:
        world.finish_run(web.hive, run)
        world.evaluate_run(web.hive, run, protocol=SIM3)
    address = "/experiments/trial?tab=setup"
    assert banner(web, address) == "", "one protocol, and the runs of others do not count"
    for run in stereo:
        world.finish_run(web.hive, run)
        world.evaluate_run(web.hive, run)
    text = banner(web, address)
    assert "2 runs use SE(3), 2 Sim(3): not comparable." in text
    assert "Evaluate all under Sim(3)</button>" in text
    assert press(web, text) == address
    assert {entry.run_id: entry.protocol for entry in web.hive.evaluations.waiting()} == dict.fromkeys(stereo, SIM3)
    for run in stereo:
        world.evaluate_run(web.hive, run, 0.02, protocol=SIM3)
    assert banner(web, address) == ""


def test_a_comparison_of_live_and_final_trajectories_offers_the_live_ones_of_all(web: Web) -> None:
    """It named the kinds, but had no button: both runs have the protocol that is shown."""
    live, done, other = of_live(PROTOCOL), web.runs["done"], web.runs["bare"]
    world.evaluate_run(web.hive, other)
    world.set_trajectory(web.hive, [done], TrajectoryKind.LIVE)
    world.set_trajectory(web.hive, [other], TrajectoryKind.FINAL)
    world.evaluate_run(web.hive, done, protocol=live)
    web.hive.current_protocols.use([done], PROTOCOL.fingerprint)
    text = banner(web, f"/compare?runs={done},{other}")
    assert "1 run uses the final trajectory, 1 the live trajectory: not comparable." in text
    assert f"final of run {other}; live of run {done}." in text
    assert press(web, text) == f"/compare?runs={done},{other}"
    assert {entry.run_id: entry.protocol for entry in web.hive.evaluations.waiting()} == {other: live}
    world.evaluate_run(web.hive, other, protocol=live)
    assert banner(web, f"/compare?runs={done},{other}") == ""


@pytest.mark.integration
def test_a_report_says_it_on_its_page_in_its_file_and_on_the_command_line(web: Web, tmp_path: Path) -> None:
    mono, stereo = mix(web)
    runs = ", ".join(map(str, [*mono, *stereo]))
    yaml = f"name: both\nselect: {{runs: {{runs: [{runs}]}}}}\nforms: [{{form: by_algorithm}}]\n"
    address = web.client.post("/analyses", data={"csrf_token": web.token, "yaml": yaml}).location
    jobs = AnalysisJobs(web.hive.settings, web.hive.store, web.hive.catalogue.project_root)
    assert jobs.work_once("t", threading.Event())
    text = banner(web, address)
    assert "3 runs use SE(3), 2 Sim(3): not comparable." in text
    assert web.client.get(address).text.count("2 Sim(3): not comparable. ") == 0, (
        "the page says it once above its facts"
    )
    assert f"{SAID}</strong>" in web.client.get(f"{address}/files/report.html").text
    assert "ate.rmse: 3 runs use SE(3), 2 Sim(3): not comparable" in web.client.get(address).text
    assert press(web, text) == address
    (tmp_path / "both.yaml").write_text(yaml)
    said = CliRunner().invoke(main, ["--data", str(web.hive.settings.data), "analyse", str(tmp_path / "both.yaml")])
    assert SAID in said.stderr
    named = web.client.post(
        "/analyses", data={"csrf_token": web.token, "yaml": f"{yaml}protocol: {SIM3.fingerprint}\n"}
    )
    assert jobs.work_once("t", threading.Event())
    assert banner(web, named.location) == ""


def test_the_button_never_leads_to_another_server_and_names_a_bad_protocol(web: Web) -> None:
    mix(web)
    text = banner(web, "/runs")
    assert press(web, text, back="//example.org/x") == "/runs"
    data = {"csrf_token": web.token, "where": "", "protocol": "0123456789ab", "back": "/runs"}
    answer = web.client.post("/runs/evaluate-together", data=data)
    assert answer.status_code == 404
    assert "Unknown protocol &#39;0123456789ab&#39;" in answer.text
    assert web.client.post("/runs/evaluate-together", data={**data, "csrf_token": ""}).status_code == 400


def test_a_view_only_server_says_it_without_a_button(web: Web) -> None:
    mix(web)
    web.hive.close()
    reading = world.make_web(world.make_hive(web.hive.settings.data.parent, Mode.VIEW_ONLY))
    text = banner(reading, "/runs")
    assert "not comparable" in text
    assert "<form" not in text
    reading.hive.close()
