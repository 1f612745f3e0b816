"""Experiments on pages and in the API: the builder, the list, the page of one, and what can be done to it."""

from __future__ import annotations

import html
import io
import re
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from slamhive.base.settings import Mode
from slamhive.documents.plain import ConfigurationStanding
from slamhive.domain.run import FailureReason, RunState
from slamhive.domain.trust import Disturbance, DisturbanceKind, DisturbanceReason
from slamhive.services.executors import Executors
from slamhive.services.experiments.views import ExperimentSource
from slamhive.web.presenters.experiment_builder import MOST_TEXT
from slamhive.web.security import API_HEADER
from slamhive.web.views import experiments as views
from tests.web import web_world as world
from tests.web.web_world import Web, make_web

pytestmark = pytest.mark.integration

TRIAL = """\
# Six configurations, twelve runs.
name: trial
description: What <b>features</b> do
algorithms: eye-slam-mono | eye-slam-stereo
datasets: room
parameters:
  nFeatures: 500 | 1000 | 1500
repeats: 2
executor: process
"""
JSON = {"Accept": "application/json"}
API = {API_HEADER: "1"}
ENDS = (RunState.PREPARING, RunState.STARTING, RunState.RUNNING, RunState.COLLECTING)


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether an executor can be used on this machine is no matter of the pages."""
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


@pytest.fixture
def trial(web: Web) -> Web:
    """An installation with the trial, of which nothing has run."""
    web.hive.experiments.start(ExperimentSource(TRIAL))
    return web


def names(web: Web) -> list[str]:
    return [status.name for status in web.hive.experiments.list()]


def edit(web: Web, **fields: Any) -> dict[str, Any]:
    """What an open builder gets for an edit."""
    answer = web.client.post("/new-experiment", data={"csrf_token": web.token, **fields}, headers=JSON)
    assert answer.status_code == 200, answer.text
    content: dict[str, Any] = answer.get_json()
    return content


def write(web: Web, text: str) -> dict[str, Any]:
    return edit(web, **{"from": "text", "do": "preview", "yaml": text})


def act(web: Web, action: str, **fields: str) -> Any:
    return web.client.post(f"/experiments/trial/{action}", data={"csrf_token": web.token, **fields})


def words(text: str) -> str:
    """The page as a reader sees it."""
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text)))


def runs_of(web: Web, number: int) -> list[int]:
    (cell,) = web.hive.experiments.cells("trial", number - 1, 1).cells
    return [run.id for run in cell.runs]


# -- the builder -------------------------------------------------------------------------------------------------------


def test_the_fields_write_the_yaml_and_the_preview_counts(web: Web):
    fields = {"from": "fields", "do": "write", "name": "mine", "algorithms": ["eye-slam-mono", "eye-slam-stereo"]}
    state = edit(web, **fields, datasets="room", **{"parameters/nFeatures": "500:1500:500", "repeats": "2"})
    assert state["yaml"] == (
        "name: mine\nalgorithms: [eye-slam-mono, eye-slam-stereo]\ndatasets: room\n"
        "parameters:\n  nFeatures: 500:1500:500\nrepeats: 2\n"
    )
    assert state["error"] == ""
    assert "6 configurations, 12 runs." in words(state["preview"])
    assert "mine-0006" in state["preview"]
    assert names(web) == []


def test_the_builder_says_before_the_start_that_protocols_would_be_mixed_and_one_click_joins_them(web: Web):
    fields = {"from": "fields", "name": "mine", "algorithms": ["eye-slam-mono", "eye-slam-stereo"], "datasets": "room"}
    state = edit(web, **fields, do="write", **{"parameters/nFeatures": "500:1500:500"})
    assert "3 runs use SE(3), 3 Sim(3): not comparable." in words(state["preview"])
    button = re.search(r'<button form="builder" name="do" value="([^"]+)"[^>]*>([^<]+)', state["preview"])
    assert button is not None
    assert button[2] == "Evaluate all under Sim(3)"
    joined = edit(web, **fields, do=button[1])
    assert "evaluate:\n  alignment: sim3\n" in joined["yaml"]
    assert "not comparable" not in joined["preview"]
    apart = edit(web, **{**fields, "algorithms": "eye-slam-mono"}, do="write")
    assert "not comparable" not in apart["preview"]
    assert "not comparable" not in edit(web, **fields, do="write", evaluate="no")["preview"]


def test_the_builder_offers_the_live_trajectory_where_live_and_final_ones_would_be_compared(web: Web, tmp_path: Path):
    package = tmp_path / "project" / "algorithms" / "eye-slam" / "algorithm.yaml"
    text = package.read_text().replace("trajectory_role: image", "trajectory_role: image, trajectory: live")
    package.write_text(text.replace("trajectory_role: left", "trajectory_role: left, trajectory: final"))
    fields = {"from": "fields", "name": "mine", "algorithms": ["eye-slam-mono", "eye-slam-stereo"], "datasets": "room"}
    same = edit(web, **fields, do="write", **{"evaluate/alignment": "sim3"})
    assert "1 run uses the final trajectory, 1 the live trajectory: not comparable." in words(same["preview"])
    assert "Evaluate all under the live trajectory" in words(same["preview"])
    plain = edit(web, **fields, do="write")
    button = re.search(r'<button form="builder" name="do" value="([^"]+)"', plain["preview"])
    assert button is not None
    joined = edit(web, **fields, do=button[1])
    assert "evaluate:\n  alignment: sim3\n  trajectory: live\n" in joined["yaml"]
    assert "not comparable" not in joined["preview"]


def test_the_builder_asks_for_repetitions_of_disturbed_runs(web: Web):
    fields = {"from": "fields", "do": "write", "name": "mine", "algorithms": "eye-slam-mono", "datasets": "room"}
    state = edit(web, **fields, repeat_disturbed="2")
    assert "repeat_disturbed: 2\n" in state["yaml"]
    assert "up to 2 repeats of each disturbed run, not counted here" in words(state["preview"])
    assert 'name="repeat_disturbed"' in web.client.get("/new-experiment").text
    wrong = edit(web, **fields, repeat_disturbed="many")
    assert "repeat_disturbed" in wrong["error"]


def test_the_yaml_fills_the_fields(web: Web):
    state = write(web, TRIAL)
    assert state["yaml"] == TRIAL
    assert 'name="parameters/nFeatures" id="field-parameters/nFeatures" value="500 | 1000 | 1500"' in state["builder"]
    assert 'value="eye-slam-stereo" checked' in state["builder"]
    assert 'value="beam-odometry" checked' not in state["builder"]
    assert "missing sensors for eye-slam-mono, eye-slam-stereo" in words(state["builder"])


def test_a_filter_over_datasets_becomes_their_names(web: Web):
    text = "name: mine\nalgorithms: eye-slam-mono\ndatasets: {where: sensor = stereo-inertial}\n"
    state = write(web, text)
    assert 'datasets: ["room"]\n# chosen by: sensor = stereo-inertial\n' in state["yaml"]
    assert "1 configuration, 1 run." in words(state["preview"])
    assert edit(web, **{"from": "text", "do": "preview", "yaml": state["yaml"]})["yaml"] == state["yaml"]
    wrong = write(web, text.replace("stereo-inertial", "sterio"))
    assert "sensor is never 'sterio'" in wrong["error"]
    web.hive.experiments.start(ExperimentSource(text))
    assert "where" not in web.hive.experiments.source("mine").text


def test_a_mistake_is_told_with_its_line_and_at_its_field(web: Web):
    state = write(web, TRIAL.replace("1500", "99999"))
    assert state["line"] == 7
    assert state["field"] == "parameters/nFeatures"
    assert "100 to 10000" in state["error"]
    assert "Line 7" in state["preview"]
    assert 'data-line="7"' in state["preview"]
    assert re.search(r"data-error=\"parameters/nFeatures\">[^<]*100 to 10000", state["builder"])


def test_text_that_is_no_yaml_leaves_the_fields_alone(web: Web):
    state = write(web, "name: [\n")
    assert state["builder"] is None
    assert state["yaml"] == "name: [\n"
    assert state["line"] == 1


def test_steps_are_added_and_removed(web: Web):
    chosen = {"from": "fields", "name": "x", "algorithms": "eye-slam-mono", "datasets": "room"}
    added = edit(web, **chosen, do="add", kind="rate")
    assert "image_rate:" in added["yaml"]
    assert 'name="steps/0/hz"' in added["builder"]
    step = {"steps/0/name": "image_rate", "steps/0/step": "rate", "steps/0/sensors": "camera", "steps/0/hz": "20 | 5"}
    assert "2 configurations" in edit(web, **chosen, **step, do="write")["preview"]
    assert "steps:" not in edit(web, **chosen, **step, do="drop:0")["yaml"]
    assert "steps:" in edit(web, **chosen, **step, do="drop:9")["yaml"]


def test_an_unknown_kind_of_step_is_refused(web: Web):
    data = {"csrf_token": web.token, "from": "fields", "do": "add", "kind": "<magic>"}
    answer = web.client.post("/new-experiment", data=data, headers=JSON)
    assert answer.status_code == 404
    assert "<magic>" in answer.get_json()["error"]["message"]


def test_without_scripts_everything_is_a_page(web: Web):
    data = {"csrf_token": web.token, "from": "text", "do": "preview", "yaml": TRIAL}
    page = web.client.post("/new-experiment", data=data)
    assert page.status_code == 200
    assert "6 configurations, 12 runs." in words(page.text)
    assert html.escape("What <b>features</b> do") in page.text
    wrong = web.client.post("/new-experiment", data={**data, "do": "start", "yaml": TRIAL.replace("room", "rom")})
    assert wrong.status_code == 400
    assert "did you mean" in words(wrong.text) or "room" in words(wrong.text)
    assert "datasets: rom" in wrong.text
    assert names(web) == []


def test_a_file_is_read(web: Web):
    data = {"csrf_token": web.token, "from": "text", "do": "open", "file": (io.BytesIO(TRIAL.encode()), "t.yaml")}
    assert "6 configurations" in web.client.post("/new-experiment", data=data).text
    data["file"] = (io.BytesIO(b"\xff\xfe\x00"), "t.bag")
    assert web.client.post("/new-experiment", data=data).status_code == 400
    assert web.client.post("/new-experiment", data={**data, "file": (io.BytesIO(b""), "")}).status_code == 400


def test_start_stores_it_and_leads_to_its_page(web: Web):
    before = sum(web.hive.runs.counts().values())
    data = {"csrf_token": web.token, "from": "text", "do": "start", "yaml": TRIAL.replace("\n", "\r\n")}
    answer = web.client.post("/new-experiment", data=data)
    assert answer.status_code == 303
    assert answer.location == "/experiments/trial"
    assert web.hive.runs.counts()[RunState.QUEUED] == 12 + 1
    assert sum(web.hive.runs.counts().values()) == before + 12
    assert web.hive.experiments.source("trial").text == TRIAL
    assert "Started trial with 12 runs." in words(web.client.get(answer.location).text)


def test_what_exists_already_is_told(trial: Web):
    state = write(trial, TRIAL.replace("name: trial", "name: again"))
    assert "6 configurations with 12 runs" in words(state["preview"])
    assert "already exists" in words(write(trial, TRIAL)["preview"])


def test_a_copy_has_a_new_name_and_keeps_the_comments(trial: Web):
    page = trial.client.get("/new-experiment?copy=trial")
    assert "name: trial-2" in page.text
    assert "# Six configurations, twelve runs." in page.text
    assert trial.client.get("/new-experiment?copy=nothing").status_code == 404


@pytest.mark.parametrize(
    ("text", "expected"),
    [("name: <script>alert(1)</script>\nalgorithms: eye-slam-mono\ndatasets: room\n", "not allowed"),
     ("name: x\nalgorithms: <b>\ndatasets: room\n", "<b>"),
     ("name: x\nalgorithms: eye-slam-mono\ndatasets: room\nparameters: {note: '<img src=x onerror=1>'}\n", ""),
     ("name: x\nalgorithms: eye-slam-mono\ndatasets: room\nparameters: {'</textarea><b>': 1}\n", ""),
     ("a: &a [x]\nb: *a\n", "anchors and aliases"),
     ("name: !!python/object/apply:os.system [ls]\n", "not allowed"),
     ("name: x\nname: y\n", "twice"),
     ("[" * 5000, "deeper"),
     ("x: " + "{a: " * 5000, "deeper")],
)  # fmt: skip
def test_hostile_text_stays_text(web: Web, text: str, expected: str):
    state = write(web, text)
    assert expected in state["error"]
    for part in (state["builder"] or "", state["preview"]):
        assert "<script>" not in part
        assert "<img" not in part
        assert "</textarea><b>" not in part
        assert "<b></b>" not in part
    page = web.client.post(
        "/new-experiment", data={"csrf_token": web.token, "from": "text", "do": "preview", "yaml": text}
    )
    assert "<script>alert" not in page.text
    assert "</textarea><b>" not in page.text


def test_a_billion_combinations_are_refused_at_once(web: Web):
    axes = "".join(f"  {key}: 1:1000\n" for key in ("nFeatures", "scale", "note"))
    state = write(web, f"name: x\nalgorithms: eye-slam-mono\ndatasets: room\nparameters:\n{axes}")
    assert "1,000,000,000 combinations" in state["error"]


def test_text_that_is_too_long_is_refused(web: Web):
    text = "#" * (MOST_TEXT + 1)
    assert "200,000 characters" in write(web, text)["error"]
    data = {"csrf_token": web.token, "from": "text", "do": "preview", "yaml": "#" * 2_000_000}
    assert web.client.post("/new-experiment", data=data).status_code == 413
    body = {"yaml": text}
    answer = web.client.post("/api/v1/experiments/preview", json=body, headers=API)
    assert answer.status_code == 400


@pytest.mark.parametrize(
    "path",
    ["/new-experiment", "/experiments/trial/pause", "/experiments/trial/cancel", "/experiments/trial/add-repeats"],
)
@pytest.mark.parametrize("token", [{}, {"csrf_token": "wrong"}])
def test_changes_need_the_token(trial: Web, path: str, token: dict[str, str]):
    data = {**token, "from": "text", "do": "start", "yaml": TRIAL.replace("name: trial", "name: other"), "count": "1"}
    answer = trial.client.post(path, data=data)
    assert answer.status_code == 400
    assert "CSRF" in answer.text
    assert names(trial) == ["trial"]
    assert trial.hive.experiments.status("trial").state is ConfigurationStanding.ACTIVE


# -- the list and the page ---------------------------------------------------------------------------------------------


def test_an_empty_list_says_what_to_do(empty: Web):
    text = empty.client.get("/experiments").text
    assert "slamhive experiment start" in text
    assert 'href="/new-experiment"' in text


def bar_of(web: Web) -> str:
    """The bar of the only experiment in the list."""
    return web.client.get("/experiments").text.partition('<svg class="phases"')[2].partition("</svg>")[0]


def test_the_list_shows_how_far_each_is(trial: Web):
    assert "<rect" not in bar_of(trial), "nothing has ended"
    world.finish_run(trial.hive, runs_of(trial, 1)[0])
    assert re.findall(r'width="([\d.]+)"', bar_of(trial)) == ["8.333"], "1 of 12"
    text = trial.client.get("/experiments").text
    assert "Showing all 1 experiment, newest first." in text
    assert "1 not evaluated, 11 queued" in text
    assert html.escape("What <b>features</b> do") in text
    assert "What <b>" not in text
    assert trial.client.get("/experiments/trial?tab=magic").status_code == 404
    assert trial.client.get("/experiments?page=2").status_code == 400
    assert "trial" in trial.client.get("/").text


def test_the_page_shows_every_state_of_every_cell(trial: Web):
    hive = trial.hive
    first, second = runs_of(trial, 1)
    world.finish_run(hive, first)
    world.evaluate_run(hive, first, 0.05)
    world.finish_run(hive, second)
    world.evaluate_run(hive, second, 0.07)
    world.fail_run(hive, runs_of(trial, 2)[0])
    world.start_run(hive, runs_of(trial, 3)[0])
    tabs = {tab: trial.client.get(f"/experiments/trial?tab={tab}").text for tab in views.TABS}
    text, seen = tabs["grid"], words(tabs["runs"])
    assert all("3 of 12 runs finished: 2 good, 1 failed, 1 running, 8 queued." in words(tab) for tab in tabs.values())
    assert "algorithm eye-slam-mono, nFeatures 500: 2 good" in text
    assert "algorithm eye-slam-mono, nFeatures 1000: 1 failed, 1 queued" in text
    assert "1 no trajectory" in seen
    assert "0.0600 ± 0.0141" in seen
    assert "ATE RMSE [m]" in seen
    assert "SE(3)" in seen
    assert "Configurations 1 to 6 of 6" in seen
    assert html.escape("What <b>features</b> do") in text
    assert "What <b>" not in text


def test_every_experiment_page_is_whole(trial: Web):
    world.fail_run(trial.hive, runs_of(trial, 2)[0])
    for address in ("/experiments", "/experiments/trial", "/new-experiment", "/new-experiment?copy=trial", "/"):
        answer = trial.client.get(address)
        assert answer.status_code == 200
        text = answer.text
        assert text.rstrip().endswith("</html>")
        assert not re.search(r"<[^>]+\sstyle=|<style|<script(?![^>]*\ssrc=)|\son[a-z]+=\"", text)
        ids = re.findall(r"\sid=\"([^\"]+)\"", text)
        assert len(ids) == len(set(ids))
        labelled = set(re.findall(r"<label for=\"([^\"]+)\"", text))
        assert labelled <= set(ids)
        assert text.count("<h1") == 1


def test_axes_are_chosen_by_the_address(trial: Web):
    text = trial.client.get("/experiments/trial?rows=nFeatures&columns=dataset").text
    assert "Progress by nFeatures and dataset" in text
    assert trial.client.get("/experiments/trial?rows=magic").status_code == 404
    assert trial.client.get("/experiments/trial?after=x").status_code == 400


def test_a_place_of_the_grid_leads_to_the_runs_of_its_configurations(trial: Web):
    text = trial.client.get("/experiments/trial?rows=nFeatures&columns=dataset").text
    links = re.findall(r'href="(/runs\?[^"]*where[^"]*)"', text)
    assert len(links) == 3
    assert "Showing 4 of 4 runs" in trial.client.get(html.unescape(links[1])).text


STEPPED = """\
name: stepped
algorithms: eye-slam-mono | eye-slam-stereo
datasets: room
steps:
  image_rate: {step: rate, sensors: camera, hz: 20 | 10 | 5}
  image_resolution: {step: resolution, sensors: camera, scale: 1 | .5}
executor: process
"""


def test_a_place_between_steps_leads_to_its_runs_also_where_a_step_changes_nothing(web: Web):
    web.hive.experiments.start(ExperimentSource(STEPPED))
    text = web.client.get("/experiments/stepped?rows=image_rate&columns=image_resolution").text
    links = [html.unescape(link) for link in re.findall(r'href="(/runs\?[^"]*where[^"]*)"', text)]
    assert len(links) == 6
    found = [web.client.get(link.replace("/runs?", "/api/v1/runs?")).get_json()["runs"] for link in links]
    steps = [{str(run["variant"]) for run in runs} for runs in found]
    assert [len(runs) for runs in found] == [2] * 6
    assert [len(entry) for entry in steps] == [1] * 6
    assert len(set.union(*steps)) == 6
    by_algorithm = web.client.get("/experiments/stepped?rows=image_rate&columns=algorithm").text
    assert len(re.findall(r'href="/runs\?[^"]*where', by_algorithm)) == 6


def test_a_large_grid_is_counted_after_the_page_is_there(trial: Web, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(views, "LARGE", 5)
    text = trial.client.get("/experiments/trial").text
    later = re.search(r'data-later="([^"]+)"', text)
    assert later is not None
    assert "Progress by" not in text
    assert "algorithm eye-slam-mono, nFeatures 500: 2 queued" in trial.client.get(html.unescape(later[1])).text


def test_a_cell_leads_to_its_runs(trial: Web):
    answer = trial.client.get("/experiments/trial/cells/2")
    assert answer.status_code == 302
    listed = trial.client.get(answer.location).text
    assert "Showing 2 of 2 runs" in listed
    assert "experiment trial" in listed
    for run_id in runs_of(trial, 2):
        assert f'href="/runs/{run_id}"' in listed
    assert trial.client.get("/experiments/trial/cells/7").status_code == 404
    assert trial.client.get("/experiments/trial/cells/0").status_code == 404


def test_the_runs_of_an_experiment_are_listed(trial: Web):
    text = trial.client.get("/runs?experiment=trial&columns=id,experiment&limit=5").text
    assert "Showing 5 of 12 runs: experiment trial, newest first." in text
    assert 'href="/experiments/trial"' in text
    assert "experiment=trial" in text.partition('rel="next"')[2]
    assert "part of" in trial.client.get(f"/runs/{runs_of(trial, 1)[0]}").text


def test_any_name_has_a_page(web: Web):
    for name in ("new", "preview", "a.b-c_1"):
        web.hive.experiments.start(ExperimentSource(TRIAL.replace("name: trial", f"name: {name}")))
        assert web.client.get(f"/experiments/{name}").status_code == 200
        assert web.client.get(f"/api/v1/experiments/{name}").get_json()["name"] == name


def test_the_file_is_downloaded_as_it_was_given(trial: Web):
    answer = trial.client.get("/experiments/trial/experiment.yaml")
    assert answer.text == TRIAL
    assert answer.headers["Content-Disposition"] == 'attachment; filename="trial.yaml"'


@pytest.mark.parametrize(
    "path", ["nothing", "nothing/experiment.yaml", "nothing/cells/1", "%3Cscript%3E", "..", "trial/magic"]
)
def test_what_does_not_exist_is_said_to_be_missing(trial: Web, path: str):
    answer = trial.client.get(f"/experiments/{path}")
    assert answer.status_code == 404
    assert "<script>" not in answer.text


def test_many_configurations_make_a_small_page(web: Web):
    text = TRIAL.replace("500 | 1000 | 1500", "1001:2000").replace("repeats: 2", "repeats: 1")
    web.hive.experiments.start(ExperimentSource(text))
    with closing(sqlite3.connect(web.hive.settings.data / "slamhive.db")) as database:
        known = database.execute("SELECT stat FROM sqlite_stat1 WHERE tbl = 'runs'").fetchall()
    assert max(int(stat.split()[0]) for (stat,) in known) >= 2000, "pages would be planned for a small database"
    page = web.client.get("/experiments/trial?tab=runs").text
    assert len(page) < 150_000
    assert "Configurations 1 to 50 of 2,000" in words(page)
    assert "Not shown:" in words(web.client.get("/experiments/trial?rows=nFeatures&columns=algorithm").text)
    following = re.search(r'rel="next" href="([^"]+)"', page)
    assert following is not None
    assert "Configurations 51 to 100 of 2,000" in words(web.client.get(html.unescape(following[1])).text)


# -- what can be done to it --------------------------------------------------------------------------------------------


def test_pause_and_resume(trial: Web):
    assert "Pause" in trial.client.get("/experiments/trial").text
    assert act(trial, "pause").status_code == 303
    assert trial.hive.experiments.status("trial").state is ConfigurationStanding.PAUSED
    assert "Resume" in trial.client.get("/experiments/trial").text
    assert act(trial, "resume").status_code == 303
    assert trial.hive.experiments.status("trial").state is ConfigurationStanding.ACTIVE


def test_cancelling_asks_first(trial: Web):
    text = trial.client.get("/experiments/trial").text
    confirmation = text.partition('<details class="confirm">')[2].partition("</details>")[0]
    assert 'action="/experiments/trial/cancel"' in confirmation
    assert "12 runs will not run" in confirmation
    assert act(trial, "cancel").status_code == 303
    assert trial.hive.experiments.status("trial").state is ConfigurationStanding.CANCELLED
    assert trial.hive.runs.get(runs_of(trial, 1)[0]).state is RunState.CANCELLED
    assert 'class="confirm"' not in trial.client.get("/experiments/trial").text


def test_disturbed_runs_are_counted_until_another_replaces_them(trial: Web):
    first = runs_of(trial, 1)[0]
    world.finish_run(trial.hive, first)
    busy = Disturbance(known=True, reasons=(DisturbanceReason(DisturbanceKind.OTHERS, "others were busy"),))
    trial.hive.store.write(lambda t: t.runs.update(first, disturbance=busy))
    text = trial.client.get("/experiments/trial?tab=runs").text
    assert "Measured on a disturbed machine: 1 run." in text
    assert "<td>1 not evaluated, 1 queued; 1 disturbed</td>" in text
    trial.hive.runs.retry(first)
    text = trial.client.get("/experiments/trial?tab=runs").text
    assert "Not counted: 1 failed or disturbed run replaced by another run." in text
    assert "; 1 disturbed" not in text
    assert "<td>2 queued</td>" in text


def test_failed_runs_are_tried_again(trial: Web):
    world.fail_run(trial.hive, runs_of(trial, 1)[0])
    assert "Retry 1 failed" in trial.client.get("/experiments/trial").text
    assert act(trial, "retry-failed").status_code == 303
    status = trial.hive.experiments.status("trial")
    assert status.retried == 1
    assert sum(status.counts.values()) == 12


def test_repeats_are_added(trial: Web):
    assert act(trial, "add-repeats", count="3").status_code == 303
    assert trial.hive.experiments.status("trial").runs == 6 * 5
    for wrong in ("0", "-1", "x", "", "1e3", "99999999999999999999"):
        assert act(trial, "add-repeats", count=wrong).status_code == 400
    assert trial.hive.experiments.status("trial").runs == 6 * 5


@pytest.mark.parametrize("action", ["pause", "cancel", "retry-failed", "add-repeats"])
def test_nothing_changes_by_get_or_for_an_unknown_name(trial: Web, action: str):
    assert trial.client.get(f"/experiments/trial/{action}").status_code == 405
    data = {"csrf_token": trial.token, "count": "1"}
    assert trial.client.post(f"/experiments/nothing/{action}", data=data).status_code == 404


def test_view_only_shows_experiments_without_buttons(trial: Web, tmp_path: Path):
    viewing = make_web(world.make_hive(tmp_path, Mode.VIEW_ONLY))
    for address in ("/experiments", "/experiments/trial"):
        text = viewing.client.get(address).text
        assert "trial" in text
        assert 'method="post"' not in text
        assert "New experiment" not in text
        assert ">Copy<" not in text
    assert viewing.client.get("/new-experiment").status_code == 403
    assert viewing.client.post("/new-experiment", data={"yaml": TRIAL}).status_code == 403
    assert viewing.client.post("/api/v1/experiments", json={"yaml": TRIAL}, headers=API).status_code == 403
    viewing.hive.close()


# -- the API -----------------------------------------------------------------------------------------------------------


def test_an_experiment_through_the_api(web: Web):
    plan = web.client.post("/api/v1/experiments/preview", json={"yaml": TRIAL}, headers=API).get_json()
    assert (plan["cells"], plan["runs"], plan["known_cells"]) == (6, 12, 0)
    assert plan["rows"][0]["values"]["nFeatures"] == 500
    assert names(web) == []
    started = web.client.post("/api/v1/experiments", json={"yaml": TRIAL}, headers=API)
    assert started.status_code == 201
    assert started.get_json()["runs"] == 12
    (listed,) = web.client.get("/api/v1/experiments").get_json()["experiments"]
    counts = dict.fromkeys(("running", "good", "unjudged", "failed", "lost", "cancelled"), 0)
    assert listed["counts"] == {"queued": 12, **counts}
    one = web.client.get("/api/v1/experiments/trial").get_json()
    assert one["yaml"] == TRIAL
    assert one["axes"]["nFeatures"] == [500, 1000, 1500]


def test_cells_and_grid_through_the_api(trial: Web):
    world.fail_run(trial.hive, runs_of(trial, 1)[0])
    page = trial.client.get("/api/v1/experiments/trial/cells?limit=4").get_json()
    assert [cell["cell"] for cell in page["cells"]] == [1, 2, 3, 4]
    assert page["cells"][0]["failures"] == {FailureReason.NO_TRAJECTORY.value: 1}
    rest = trial.client.get(page["next"]).get_json()
    assert [cell["cell"] for cell in rest["cells"]] == [5, 6]
    assert rest["next"] is None
    grid = trial.client.get("/api/v1/experiments/trial/grid?rows=nFeatures&columns=algorithm").get_json()["grid"]
    assert grid["rows"] == [500, 1000, 1500]
    assert grid["columns"] == ["eye-slam-mono", "eye-slam-stereo"]
    assert {(cell["row"], cell["column"]): cell["counts"]["failed"] for cell in grid["cells"]}[(0, 0)] == 1


def test_changes_through_the_api(trial: Web):
    address = "/api/v1/experiments/trial"
    assert trial.client.post(f"{address}/pause", headers=API).get_json()["state"] == "paused"
    assert trial.client.post(f"{address}/resume", headers=API).get_json()["state"] == "active"
    assert trial.client.post(f"{address}/repeats", json={"count": 1}, headers=API).get_json()["runs"] == 18
    assert trial.client.post(f"{address}/cancel", headers=API).status_code == 202
    assert trial.client.post(f"{address}/pause").status_code == 403
    assert trial.client.post("/api/v1/experiments/nothing/pause", headers=API).status_code == 404
    assert trial.client.post(f"{address}/repeats", json={"count": True}, headers=API).status_code == 400


@pytest.mark.parametrize("body", [{}, {"yaml": 1}, {"yaml": "name: x"}, {"yaml": TRIAL, "more": 1}])
def test_bad_bodies_are_refused(web: Web, body: dict[str, Any]):
    answer = web.client.post("/api/v1/experiments", json=body, headers=API)
    assert answer.status_code == 400
    assert answer.get_json()["error"]["message"]
    assert names(web) == []
