"""The lines of the ledger as models."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.documents.archive import ConfigurationsLine, RunRow, RunsLine, SharedRequest
from slamhive.documents.limits import NEVER
from slamhive.domain.configuration import VariantStep
from slamhive.store.records import RunRequest

AT = "2026-01-02T03:04:05.000678+00:00"
UID = "0" * 32
REQUEST: dict[str, Any] = {"executor": "docker", "experiment": None, "protocol": None, "stop_when": {}}


def test_a_new_option_of_a_run_cannot_be_forgotten_in_the_ledger():
    derived = {"held", "experiment_id"}
    stated = {*SharedRequest.model_fields, *RunRow._fields} - {"id", "experiment"}
    assert stated == {field.name for field in dataclasses.fields(RunRequest)} - derived


def test_a_line_of_a_version_with_fewer_or_more_options_is_read():
    line = RunsLine.read({"at": AT, "request": {**REQUEST, "of_tomorrow": 1}, "runs": [[7, UID, 3, 0, None, None]]})
    assert line.runs == (RunRow(7, UID, 3, 0, None, None),)
    options = vars(line.request)
    assert (options["repeat_disturbed"], options["stop_when"]) == (0, NEVER)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ([7, UID, 3, 0, None], "runs.0.5 is missing"),
        ([7, "short", 3, 0, None, None], "runs.0.1: String should match"),
        ([7, UID, "3", 0, None, None], "runs.0.2: must be a whole number"),
    ],
)
def test_a_row_that_does_not_fit_is_named(row, words):
    with pytest.raises(InvalidInput, match=words):
        RunsLine.read({"at": AT, "request": REQUEST, "runs": [row]})


def test_the_values_of_a_configuration_keep_their_types():
    values = {"a": 1, "b": 1.0, "c": True, "d": "1", "e": [1.5, 2]}
    steps = [{"kind": "rate", "sensors": ["cam"], "options": {"keep_every": 2}}]
    row = [4, "alg", "data", values, "realtime", 1.0, steps]
    line = ConfigurationsLine.read({"at": AT, "parameters": {"a": ["int", "px", None]}, "configurations": [row]})
    (found,) = line.configurations
    assert found.configuration.variant == (VariantStep("rate", ("cam",), {"keep_every": 2}),)
    assert [type(value) for value in found.parameters.values()] == [int, float, bool, str, tuple]
