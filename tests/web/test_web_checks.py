"""The checks on the page of a dataset: none, running, stored, outdated, view-only."""

from __future__ import annotations

import json

import pytest

from slamhive.base.settings import Mode
from slamhive.services.datasets import DatasetChecks
from tests.web.test_web_variants import send, track, wait
from tests.web.web_world import Web

pytestmark = pytest.mark.integration

__all__ = ["track"]

PAGE = "/datasets/track"


def test_a_check_is_started_stored_and_shown(track: Web):
    assert "has not been checked, or has changed since" in track.client.get(PAGE).text
    assert track.client.get(f"/api/v1{PAGE}/check").status_code == 404
    assert send(track, f"{PAGE}/check").status_code == 303
    wait("check")
    folder = track.hive.catalogue.dataset("track").folder
    report = json.loads((folder / "check.json").read_text())
    assert {finding["check"] for finding in report["findings"]} >= {"lidar-motion"}
    page = track.client.get(PAGE).text
    assert "Check again" in page
    assert "lidar-motion" in page
    severities = [finding["severity"] for finding in report["findings"]]
    assert severities.count("warning") > 0
    for severity in ("error", "warning", "note"):
        assert f"{severities.count(severity)} {severity}" in page
    assert report["findings"][0]["remedy"] in page
    assert track.client.get(f"/api/v1{PAGE}/check").json == report


def test_a_report_of_other_data_is_not_shown(track: Web):
    assert send(track, f"{PAGE}/check").status_code == 303
    wait("check")
    path = track.hive.catalogue.dataset("track").folder / "dataset.yaml"
    path.write_text(path.read_text().replace("rate_hz: 10", "rate_hz: 11"))
    assert "has not been checked, or has changed since" in track.client.get(PAGE).text


def test_a_damaged_recording_says_so(track: Web):
    bag = track.hive.catalogue.dataset("track").bag_path
    bag.write_bytes(bag.read_bytes()[:2000])
    assert send(track, f"{PAGE}/check").status_code == 303
    wait("check")
    assert "The dataset could not be checked: " in track.client.get(PAGE).text


@pytest.mark.parametrize("content", ["", "{}", "[1]", '{"findings": "<b>"}'])
def test_a_report_that_makes_no_sense_is_none(track: Web, content: str):
    dataset = track.hive.catalogue.dataset("track")
    (dataset.folder / "check.json").write_text(content)
    assert "has not been checked" in track.client.get(PAGE).text


def test_a_view_only_installation_stores_nothing(track: Web):
    dataset = track.hive.catalogue.dataset("track")
    checks = track.hive.dataset_checks
    settings = track.hive.settings.with_values({"mode": Mode.VIEW_ONLY})
    report = DatasetChecks(settings).check(dataset, lambda _fraction, _text: None)
    assert report.dataset == "track"
    assert checks.stored(dataset) is None
