"""What an algorithm takes from sensors: the same in the web form, the web API, on the pages and the command line."""

from __future__ import annotations

import html
import json
from pathlib import Path

import pytest
from click.testing import CliRunner

from slamhive.base.errors import InvalidInput, NotFound
from slamhive.cli import main
from slamhive.cli.configurations import _changes
from slamhive.documents.record import RecordedRequest
from slamhive.documents.submission import Submission
from slamhive.experiments.binding import CatalogueView
from slamhive.experiments.expansion import expand
from slamhive.experiments.file import parse_experiment
from slamhive.packages.run_config import build_run_config
from slamhive.recordings.variants.steps import RegisteredSteps
from slamhive.services.configurations import ConfigurationChange
from slamhive.services.executors import Executors
from slamhive.services.experiments import ExperimentSource
from slamhive.services.ledger.book import configurations_of, record_line
from slamhive.web.experiment_fields import fields_from_yaml, yaml_from_fields
from slamhive.web.security import API_HEADER
from tests.services.tiny_project import environment
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

FORM = {"algorithm": "bound-slam", "dataset": "room"}
BOUND = """
format: 1
package: bound-slam
title: Bound
version: "1"
upstream: https://example.org/bound
licence: GPL-3.0
citation: none
modes:
  mono: {title: Bound, setup: mono, inputs: {left: camera}, trajectory_role: left}
parameters:
  fx: {type: float, default: 458.654, from: left.fx, unit: pixels, help: Focal length.}
  exposure: {type: float, default: 0.01, from: left.exposure_s, unit: s, help: Exposure time.}
"""


@pytest.fixture(autouse=True)
def _process_executor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")


@pytest.fixture
def bound(web: Web) -> Web:
    """With a package that takes parameters from a camera."""
    folder = web.hive.catalogue.project_root / "algorithms" / "bound-slam"
    (folder / "slamhive").mkdir(parents=True)
    (folder / "slamhive" / "mapping.py").touch()
    (folder / "algorithm.yaml").write_text(BOUND)
    return web


def test_the_form_shows_what_the_sensor_gives_and_scales_it(bound: Web) -> None:
    page = html.unescape(bound.client.get("/runs/new", query_string=FORM).text)
    assert 'placeholder="400"' in page
    assert "from camera0 (left.fx)" in page
    assert "default of the package: camera0 has no exposure_s" in page
    half = bound.client.get("/runs/new/preview", query_string={**FORM, "steps": "resolution scale=0.5"}).get_json()
    assert half["errors"] == {}
    assert half["bound"]["parameter.fx"] == {"value": "200", "words": "from camera0 (left.fx)"}
    typed = bound.client.get("/runs/new/preview", query_string={**FORM, "parameter.fx": "500"}).get_json()
    assert typed["bound"]["parameter.fx"] == {"value": "400", "words": "overridden: camera0 has 400"}


def test_the_web_api_and_the_command_preview_the_same(bound: Web, monkeypatch: pytest.MonkeyPatch) -> None:
    body = {**FORM, "parameters": {"exposure": 0.02}}
    queued = bound.hive.runs.counts()
    answer = bound.client.post("/api/v1/runs/preview", json=body, headers={API_HEADER: "1"}).get_json()
    assert answer["sensors"]["left"]["topic"] == "/camera0"
    assert answer["parameters"]["fx"]["value"] == 400.0
    assert answer["parameters"]["exposure"]["origin"] == "user"
    root, data = bound.hive.catalogue.project_root, Path(bound.hive.settings.data)
    for key, value in environment(root, data).items():
        monkeypatch.setenv(key, value)
    command = ("run", "bound-slam", "room", "--set", "exposure=0.02", "--preview")
    assert json.loads(CliRunner().invoke(main, (*command, "--json")).stdout) == answer
    assert "from camera0 (left.fx)" in CliRunner().invoke(main, command).stdout
    assert bound.hive.runs.counts() == queued


@pytest.mark.integration
def test_a_copy_takes_its_values_from_its_own_dataset(bound: Web) -> None:
    configurations = bound.hive.configurations
    made = configurations.create(Submission("bound-slam", "room", {"fx": 500.0})).record
    page = bound.client.get(f"/configurations/{made.id}").text
    assert "overridden: camera0 has 400" in page
    plain = configurations.copy(made.id, ConfigurationChange(parameters={"fx": ""})).record
    assert plain.configuration.parameters == {}
    assert "from camera0 (left.fx)" in bound.client.get(f"/configurations/{plain.id}").text
    assert configurations.match(plain.id).values({})["fx"] == 400.0
    form = {**FORM, "csrf_token": bound.token, "parameter.fx": "", "parameter.exposure": ""}
    answer = bound.client.post(f"/configurations/{made.id}/edit", data=form)
    assert answer.location.endswith(f"/configurations/{plain.id}")


def test_the_preview_of_an_experiment_names_the_defaults_that_replace_missing_calibration(bound: Web) -> None:
    text = "name: dark\nalgorithms: bound-slam\ndatasets: room\n"
    (said,) = bound.hive.experiments.preview(ExperimentSource(text)).warnings
    assert said == (
        "bound-slam: the calibration of room lacks what it takes; defaults of the package: "
        "exposure 0.01 for left.exposure_s"
    )
    given = text + "parameters: {exposure: 0.01 | 0.02}\n"
    assert bound.hive.experiments.preview(ExperimentSource(given)).warnings == ()


STEREO = ("eye-slam-stereo", "room")
SWAPPED = {"left": "camera1", "right": "camera0"}


def test_a_chosen_sensor_is_stored_with_the_configuration_and_its_runs(bound: Web) -> None:
    hive = bound.hive
    form = {"algorithm": STEREO[0], "dataset": STEREO[1], "csrf_token": bound.token, "sensor.left": "camera1"}
    assert bound.client.post("/runs/new", data=form).status_code == 303
    (run,) = hive.runs.page(limit=1).records
    assert run.sensors == SWAPPED
    assert "left: camera1 (chosen)" in bound.client.get(f"/runs/{run.id}").text
    stored = hive.configurations.get(run.configuration_id)
    assert stored.configuration.sensors == SWAPPED
    line = json.loads(
        json.dumps({**record_line(stored), "configurations": list(record_line(stored)["configurations"])})
    )
    assert [entry.configuration for entry in configurations_of(line)] == [stored.configuration]
    assert RecordedRequest.of(run, protocol=None).configuration == stored.configuration
    again = hive.configurations.import_yaml(hive.configurations.export_yaml(stored.id), "x.yaml")
    assert (again.created, again.record.id) == (False, stored.id)
    config = build_run_config(
        hive.catalogue.algorithm("eye-slam-stereo"), hive.catalogue.dataset("room"), stored.configuration, 1, 0
    )
    assert config.dataset_remap == {"/left": "/camera1", "/right": "/camera0"}


def test_one_sensor_for_two_roles_is_refused_at_its_field(bound: Web) -> None:
    twice = {"sensor.left": "camera1", "sensor.right": "camera1"}
    query = {"algorithm": STEREO[0], "dataset": STEREO[1], **twice}
    answer = bound.client.get("/runs/new/preview", query_string=query).get_json()
    assert list(answer["errors"]) == ["sensor.right"]
    assert "sensor camera1 is chosen for two roles" in answer["errors"]["sensor.right"]


def test_choosing_what_the_rule_gives_is_the_same_configuration(bound: Web) -> None:
    configurations = bound.hive.configurations
    plain = configurations.create(Submission(*STEREO))
    assert not configurations.create(Submission(*STEREO, sensors={"left": "camera0"})).created
    swapped = configurations.create(Submission(*STEREO, sensors={"left": "camera1"}))
    assert (swapped.created, swapped.record.id == plain.record.id) == (True, False)
    assert configurations.copy(swapped.record.id, ConfigurationChange(sensors={})).record.id == plain.record.id


def test_a_copy_keeps_the_choice_where_it_fits(bound: Web) -> None:
    hive = bound.hive
    made = hive.configurations.create(Submission(*STEREO, sensors={"left": "camera1"})).record
    kept = hive.configurations.copy(made.id, ConfigurationChange(parameters={"nFeatures": 900})).record
    assert kept.configuration.sensors == SWAPPED
    submission, notes = hive.configurations.submission(made.id, ConfigurationChange(algorithm="eye-slam-mono"))
    assert submission.sensors == {}
    assert "the choice of sensors is left out: eye-slam-mono has no role 'left'" in notes[-1]
    assert _changes({"variant": (), "no_steps": False, "sensors": ()}).sensors is None


def test_an_experiment_chooses_sensors_as_a_run_does(bound: Web) -> None:
    text = "name: swapped\nalgorithms: [eye-slam-stereo, eye-slam-mono]\ndatasets: room\nsensors: {left: camera1}\n"
    view = CatalogueView(
        {entry.name: entry for entry in bound.hive.catalogue.algorithms()},
        {"room": bound.hive.catalogue.dataset("room")},
        RegisteredSteps(),
    )
    planned = [run.configuration for run in expand(parse_experiment(text), view)]
    assert [configuration.sensors for configuration in planned] == [SWAPPED, {}]
    assert fields_from_yaml(text).value("sensors") == "left=camera1"
    assert (
        parse_experiment(yaml_from_fields(fields_from_yaml(text))).content_hash == parse_experiment(text).content_hash
    )
    with pytest.raises(
        NotFound, match=r"experiment.yaml line 4: unknown role of eye-slam-stereo, eye-slam-mono 'lift'"
    ):
        expand(parse_experiment(text.replace("{left", "{lift")), view)
    with pytest.raises(
        InvalidInput, match=r"experiment.yaml line 4: 'imu2' is no sensor of dataset room that fits left"
    ):
        expand(parse_experiment(text.replace("camera1", "imu2")), view)


def test_a_value_that_nobody_knows_is_said_before_anything_starts(bound: Web) -> None:
    path = bound.hive.catalogue.project_root / "algorithms" / "bound-slam" / "algorithm.yaml"
    path.write_text(BOUND.replace("default: 0.01, ", ""))
    page = html.unescape(bound.client.get("/runs/new", query_string=FORM).text)
    assert "bound-slam takes exposure from left.exposure_s, but camera0 of dataset room has no exposure_s" in page
    assert "set exposure" in page
