"""A run as JSON."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from slamhive.documents.model import adapter
from slamhive.documents.run import Metrics
from slamhive.domain.metrics import CATALOGUE


def test_a_metric_that_the_catalogue_does_not_have_is_shown_last_and_without_unit():
    found = adapter(Metrics).validate_python({"of_a_newer_version": 3.0, "ate.rmse": 0.1})
    assert [(key, entry["value"], entry["unit"]) for key, entry in found.items()] == [
        ("ate.rmse", 0.1, CATALOGUE["ate.rmse"].unit),
        ("of_a_newer_version", 3.0, None),
    ]


def test_metrics_that_are_no_numbers_are_refused():
    with pytest.raises(ValidationError):
        adapter(Metrics).validate_python({"ate.rmse": "small"})
    shown = {"ate.rmse": {"value": 0.1, "unit": "m"}}
    assert adapter(Metrics).validate_python(shown) == shown
    assert adapter(Metrics).validate_python(None) == {}
