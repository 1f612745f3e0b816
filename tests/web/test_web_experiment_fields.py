"""Fields and YAML of the experiment builder say the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from werkzeug.datastructures import MultiDict

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.experiments.experiment import Experiment
from slamhive.experiments.file import parse_experiment
from slamhive.web.experiment_fields import (
    ExperimentFields,
    StepFields,
    field_at,
    fields_from_form,
    fields_from_yaml,
    line_of,
    renamed,
    yaml_from_fields,
)

pytestmark = pytest.mark.quick

EXAMPLES = sorted((project_root() / "docs" / "examples").glob("*.yaml"))
EVERYTHING = """\
name: everything
description: "a: b # no comment"
algorithms: [one, '12']
datasets: room | hall
steps:
  image_rate: {step: rate, sensors: [camera, depth], hz: 20 | 10}
  left_fog: {step: fog, sensors: points, visibility_m: 'log(50, 5000, 3)', seed: 3}
parameters:
  features: 500:2500:250
  note: ['a|b', 'c']
  matrix: [[1, 0, 0], [0, 1.5, 0]]
  flag: true | false
  one: {scale: 'lin(1, 2, 3)', word: [1:3, x]}
linked: [[features, note]]
tied: [[left_fog.seed, image_rate], [a, b]]
where: [features >= 2, 'dataset in [room, hall]']
seeds: 1:3
repeats: 2
repeat_disturbed: 3
same_cpu: false
playback: {mode: realtime | sequential, rate: 1 | .5}
stop_when: {lost_tracking_s: 3.5, failures_of_configuration: 2}
limits: {memory_mb: 1000, timeout_s: 60}
evaluate: {alignment: sim3, trajectory: live}
executor: process
priority: -3
"""


def meaning(text: str) -> list[object]:
    """What an experiment states, apart from where it stands in the file."""
    experiment = parse_experiment(text)
    axes = [
        *experiment.parameters,
        *experiment.limit_axes,
        *(option for step in experiment.steps for option in step.options),
    ]
    parts = [
        [(axis.name, axis.values) for axis in (experiment.algorithms, experiment.datasets, *axes)],
        [(step.name, step.kind, step.sensors) for step in experiment.steps],
        [(link.axes, link.equal) for link in experiment.links],
        [where.text for where in experiment.where],
    ]
    placed = {"algorithms", "datasets", "parameters", "limit_axes", "steps", "links", "where", "place"}
    return [*parts, *(getattr(experiment, name) for name in Experiment.__slots__ if name not in placed)]


@pytest.mark.parametrize("text", [EVERYTHING, *(path.read_text() for path in EXAMPLES)])
def test_the_fields_of_a_text_write_a_text_of_the_same_meaning(text: str):
    fields = fields_from_yaml(text)
    written = yaml_from_fields(fields)
    assert meaning(written) == meaning(text)
    assert fields_from_yaml(written) == fields


def test_what_is_evaluated_and_switched_off_survives():
    text = "name: x\nalgorithms: a\ndatasets: d\nevaluate: false\n"
    assert meaning(yaml_from_fields(fields_from_yaml(text))) == meaning(text)


def test_a_form_is_read_with_its_steps_in_order():
    form = MultiDict([
        ("name", "x"), ("algorithms", "a"), ("algorithms", "b"), ("datasets", "d"), ("steps/2/name", "late"),
        ("steps/2/step", "fog"), ("steps/2/sensors", "lidar"), ("steps/2/visibility_m", "50 | 100"),
        ("steps/0/name", "early"), ("steps/0/step", "rate"), ("steps/0/sensors", "camera, imu"), ("steps/0/hz", ""),
        ("parameters/k", "1 | 2"), ("parameters/b/k", "3"), ("csrf_token", "t"), ("nonsense", "1"),
        ("steps/999/name", "beyond"), ("steps/x/name", "?"),
    ])  # fmt: skip
    fields = fields_from_form(form)
    assert [step.name for step in fields.steps] == ["early", "late"]
    assert yaml_from_fields(fields) == (
        "name: x\nalgorithms: [a, b]\ndatasets: d\nsteps:\n  early:\n    step: rate\n    sensors: [camera, imu]\n"
        "  late:\n    step: fog\n    sensors: lidar\n    visibility_m: 50 | 100\n"
        "parameters:\n  k: 1 | 2\n  b:\n    k: 3\n"
    )


def test_names_that_read_like_numbers_stay_names():
    text = yaml_from_fields(ExperimentFields({"name": "12", "description": "1e3"}, ("007",), ("true",)))
    experiment = parse_experiment(text)
    assert (experiment.name, experiment.description) == ("12", "1e3")
    assert experiment.algorithms.values + experiment.datasets.values == ("007", "true")


def test_nothing_typed_is_still_yaml():
    with pytest.raises(InvalidInput, match="name"):
        parse_experiment(yaml_from_fields(ExperimentFields()))


@pytest.mark.parametrize(
    ("line", "field"),
    [("hz:", "steps/0/hz"), ("step: fog", "steps/1/step"), ("left_fog:", "steps/1/name"),
     ("word:", "parameters/one/word"),
     ("flag:", "parameters/flag"), ("memory_mb", "limits/memory_mb"), ("- [a, b]", "tied"), ("repeats", "repeats"),
     ("where", "where"), ("alignment", "evaluate/alignment"), ("datasets:", "datasets")],
)  # fmt: skip
def test_a_line_leads_to_its_field(line: str, field: str):
    fields = fields_from_yaml(EVERYTHING)
    text = yaml_from_fields(fields)
    number = next(number for number, written in enumerate(text.splitlines(), 1) if line in written)
    assert field_at(text, number, fields) == field
    assert line_of(f"experiment.yaml line {number}: no") == number


def test_lines_that_belong_to_no_field():
    assert field_at("name: [", 1, ExperimentFields()) is None
    assert field_at("name: x\n", 7, ExperimentFields()) is None
    assert line_of("no room on the disk; see line 3") is None


def test_steps_are_added_moved_and_removed():
    step = StepFields("rate", "rate", "camera")
    fields = ExperimentFields().with_step(step).with_step(step).with_step(replace(step, name="last"))
    assert [entry.name for entry in fields.steps] == ["rate", "rate_2", "last"]
    assert [entry.name for entry in fields.with_step_earlier(2).steps] == ["rate", "last", "rate_2"]
    assert fields.with_step_earlier(0) == fields.with_step_earlier(3) == fields
    assert [entry.name for entry in fields.without_step(0).steps] == ["rate_2", "last"]


def test_a_copy_keeps_comments_under_its_new_name():
    text = "# why\nname: old  # the first\nalgorithms: a\ndatasets: d\n"
    assert renamed(text, "new") == "# why\nname: new\nalgorithms: a\ndatasets: d\n"
    assert parse_experiment(renamed("{name: old, algorithms: a, datasets: d}", "new")).name == "new"


@pytest.mark.parametrize("text", ["a: &x [1]\nb: *x\n", "- 1\n", "name: !!python/object:os.system x\n", "{" * 40, ""])
def test_what_is_no_plain_mapping_is_refused(text: str):
    with pytest.raises(InvalidInput):
        fields_from_yaml(text)


@pytest.mark.parametrize(
    "text",
    ["steps: 3\n", "steps: {a: 1}\n", "parameters: [1]\n", "playback: x\nlimits: 3\nstop_when: []\n", "where: {a: 1}\n",
     "linked: x\ntied: [x, 3]\n", "algorithms: {a: 1}\ndatasets: 3\n", "evaluate: [1]\n", "name: [1]\n",
     "a: 2020-01-01\n",
     "steps: {1: {step: [a], sensors: {b: 1}, 2: 3}}\n", "parameters: {a: {b: {c: 1}}}\n"],
)  # fmt: skip
def test_strange_shapes_are_shown_as_far_as_there_are_fields(text: str):
    assert isinstance(yaml_from_fields(fields_from_yaml(text)), str)


def test_the_examples_are_there():
    assert Path(project_root() / "docs" / "examples" / "paper-euroc.yaml") in EXAMPLES


def test_limits_are_kept_under_the_words_of_the_command_line() -> None:
    text = "name: x\nalgorithms: a\ndatasets: d\nlimits: {cpus: 0.5 | 1, memory: 500 MB | 1 GB, slow_down: 4}\n"
    fields = fields_from_yaml(text)
    assert fields.value("limits/cpu_cores") == "0.5 | 1"
    written = parse_experiment(yaml_from_fields(fields))
    assert (written.limits, [axis.values for axis in written.limit_axes]) == (
        parse_experiment(text).limits,
        [(0.5, 1.0), (500, 1000)],
    )
    assert field_at(text, 4, fields) in ("limits/cpu_cores", "limits/memory_mb", "limits/slow_down")
