"""Every option of a run exists in the command, the web form, JSON and the experiment file, and means the same."""

from __future__ import annotations

import dataclasses
import json
import re
from typing import Any

import click
import pytest

from slamhive.cli import main
from slamhive.cli.running import submission_values
from slamhive.documents.limits import StopWhen
from slamhive.documents.model import json_schema, parse
from slamhive.documents.submission import OPTIONS, Submission
from slamhive.domain.accounts import Visibility
from slamhive.domain.configuration import PlaybackMode, VariantStep
from slamhive.domain.protocol import Alignment
from slamhive.experiments.file import experiment_schema
from slamhive.services.executors import Executors
from slamhive.web.security import API_HEADER
from slamhive.web.views.start import read_form
from tests.web.web_world import Web

pytestmark = pytest.mark.quick

EXAMPLE = Submission(
    algorithm="eye-slam-stereo",
    dataset="room",
    parameters={"nFeatures": 1234},
    repeat=2,
    executor="process",
    seed=7,
    playback_mode=PlaybackMode.SEQUENTIAL,
    playback_rate=2.0,
    evaluate=False,
    alignment=Alignment.SIM3,
    cpu_cores=1.5,
    memory_mb=512,
    timeout_s=60.0,
    nice=5,
    slow_down=4.0,
    priority=3,
    variant=(VariantStep("resolution", ("camera0", "camera1"), {"scale": 0.5, "interpolation": "area"}),),
    sensors={"left": "camera1", "right": "camera0"},
    map="3",
    stop_when=StopWhen(lost_tracking_s=2.5, memory_mb=400, time_s=50.0, failures_of_configuration=3),
    repeat_disturbed=1,
    visibility=Visibility.PRIVATE,
)
"""Every field differs from its default."""
STEP = "resolution@camera0,camera1 scale=0.5 interpolation=area"
FORM_NAMES = {"parameters": "parameter.nFeatures", "variant": "steps", "sensors": "sensor.left"}
EXPERIMENT_KEYS = {
    "algorithm": "algorithms",
    "dataset": "datasets",
    "repeat": "repeats",
    "seed": "seeds",
    "playback_mode": "playback.mode",
    "playback_rate": "playback.rate",
    "alignment": "evaluate.alignment",
    "cpu_cores": "limits.cpu_cores",
    "memory_mb": "limits.memory_mb",
    "timeout_s": "limits.timeout_s",
    "nice": "limits.nice",
    "slow_down": "limits.slow_down",
    "variant": "steps",
}
"""Where an experiment file has other names: several values, or sections."""


def test_the_example_sets_every_option():
    for field in dataclasses.fields(Submission):
        assert getattr(EXAMPLE, field.name) not in (field.default, None), field.name
    assert None not in dataclasses.astuple(EXAMPLE.stop_when)


def test_the_command_sets_every_option():
    values = _command_values()
    steps = (VariantStep("resolution", ("camera0", "camera1"), {"scale": "0.5", "interpolation": "area"}),)
    assert Submission(**values) == dataclasses.replace(EXAMPLE, parameters={"nFeatures": "1234"}, variant=steps)


def test_the_web_form_shows_and_sets_every_option(shown: Web):
    page = shown.client.get("/runs/new?algorithm=eye-slam-stereo&dataset=room").text
    names = set(re.findall(r' name="([^"]+)"', page))
    # Without accounts there is nobody to hide a run from; test_web_sharing looks at the form with accounts.
    assert {FORM_NAMES.get(name, name) for name in OPTIONS if name != "visibility"} <= names
    read = read_form(shown.hive, _form())
    assert read.errors == {}
    assert read.submission == dataclasses.replace(EXAMPLE, parameters={**_defaults(shown), "nFeatures": 1234})


def test_json_sets_every_option():
    assert parse(Submission, json.loads(json.dumps(_body()))) == EXAMPLE
    assert set(OPTIONS) <= _keys(json.loads(json_schema(Submission)))


@pytest.mark.integration
def test_command_form_and_api_store_the_same_runs(web: Web, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Executors, "choose", lambda executors, asked=None: asked or "process")
    parameters = {**_defaults(web), "nFeatures": 1234}
    form = {**_form(), "map": "", "csrf_token": web.token}
    assert web.client.post("/runs/new", data=form).status_code == 303
    body = {**_body(), "map": None, "parameters": parameters}
    assert web.client.post("/api/v1/runs", json=body, headers={API_HEADER: "1"}).status_code == 201
    asked = Submission(**_command_values())
    web.hive.runs.submit(dataclasses.replace(asked, map=None))
    runs = web.hive.runs.page(limit=6).records
    assert len({run.id for run in runs} - set(web.runs.values())) == 6
    stored = [dataclasses.replace(run, id=0, uid="", created_at=runs[0].created_at) for run in runs]
    assert [stored[0:2], stored[2:4]] == [stored[4:6]] * 2
    first = stored[-1]
    assert (first.parameters, first.playback.rate) == (parameters, EXAMPLE.playback_rate)
    assert (first.seed, first.priority, first.memory_mb, first.timeout_s) == (7, 3, 512, 60.0)
    assert (first.stop_when, first.sensors) == (EXAMPLE.stop_when, EXAMPLE.sensors)


def test_the_experiment_file_has_every_option():
    # A file is shared with others; whoever starts it says who sees its runs.
    assert {EXPERIMENT_KEYS.get(name, name) for name in OPTIONS if name != "visibility"} <= _keys(
        json.loads(experiment_schema())
    )


def _command_values() -> dict[str, Any]:
    command = main.get_command(click.Context(main), "run")
    assert command is not None
    arguments = [
        *("eye-slam-stereo", "room", "--set", "nFeatures=1234", "--repeat", "2", "--executor", "process"),
        *("--seed", "7", "--playback", "sequential", "--rate", "2", "--no-evaluate", "--align", "sim3"),
        *("--cpus", "1.5", "--memory", "512", "--timeout", "60", "--nice", "5", "--slow-down", "4"),
        *("--priority", "3", "--step", STEP),
        *("--stop-when", "lost_tracking_s=2.5", "--stop-when", "memory_mb=400", "--stop-when", "time_s=50"),
        *("--stop-when", "failures_of_configuration=3", "--repeat-disturbed", "1", "--map", "3"),
        *("--visibility", "private"),
        *("--sensor", "left=camera1", "--sensor", "right=camera0"),
    ]
    return submission_values(command.make_context("run", arguments).params)


def _form() -> dict[str, str]:
    return {
        **{name: str(_value(name)) for name in OPTIONS if name not in FORM_NAMES},
        "evaluate": "no",
        "parameter.nFeatures": "1234",
        "steps": STEP,
        "sensor.left": "camera1",
    }


def _body() -> dict[str, Any]:
    return {
        **{name: _value(name) for name in OPTIONS if "." not in name},
        "stop_when": EXAMPLE.stop_when.content,
        "variant": [
            {
                "kind": "resolution",
                "sensors": ["camera0", "camera1"],
                "options": {"scale": 0.5, "interpolation": "area"},
            }
        ],
    }


def _value(name: str) -> Any:
    value: Any = EXAMPLE
    for part in name.split("."):
        value = getattr(value, part)
    return value


def _defaults(shown: Web) -> dict[str, Any]:
    return {entry.key: entry.default for entry in shown.hive.catalogue.algorithm("eye-slam-stereo").parameters}


def _keys(schema: dict[str, Any], part: dict[str, Any] | None = None, prefix: str = "") -> set[str]:
    """The dotted names of all keys of a JSON Schema."""
    found: set[str] = set()
    for name, entry in (schema if part is None else part).get("properties", {}).items():
        found.add(prefix + name)
        for choice in (entry, *entry.get("anyOf", ()), *entry.get("oneOf", ())):
            if "$ref" in choice:
                nested = schema["$defs"][choice["$ref"].rpartition("/")[2]]
                found |= _keys(schema, nested, f"{prefix}{name}.")
    return found
