"""Records that are not whole are left out, each with its reason, and stop nothing."""

from __future__ import annotations

import copy
from datetime import UTC, datetime
from typing import Any

import pytest

from slamhive.documents.submission import Submission
from slamhive.run_folder.folder import RunFolder
from slamhive.services.hive import Hive
from slamhive.services.reindex import reindex
from slamhive.services.runs.record import begin_record

pytestmark = pytest.mark.integration

HOST = {"cpu_model": "Test", "cpu_count": 2, "memory_bytes": 10**9, "kernel": "6", "os": "Test"}
ALGORITHM = {"package": "tiny", "mode": "lidar", "identity": "sha256:1", "package_hash": "2", "version": "1"}


@pytest.fixture
def whole(hive: Hive) -> dict[str, Any]:
    """The record of a run that was cancelled, which is whole."""
    (run,) = hive.runs.submit(Submission("tiny", "track"))
    record = begin_record(run)
    ended = {"state": "cancelled", "ended_at": datetime.now(UTC).isoformat(), "events": []}
    return {**record, **ended, "algorithm": ALGORITHM, "host": HOST, "metrics": {"duration": 1.5}}


def write(hive: Hive, record: dict[str, Any], run_id: int) -> RunFolder:
    folder = hive.runs.folder(run_id)
    folder.create()
    folder.write_record({**record, "id": run_id, "uid": f"{run_id:032x}"})
    return folder


def broken(record: dict[str, Any], path: str, value: Any) -> dict[str, Any]:
    """A copy with the value at ``path`` replaced, or removed for ``...``."""
    copied = copy.deepcopy(record)
    *parents, last = path.split(".")
    place = copied
    for name in parents:
        place = place[name]
    if value is ...:
        del place[last]
    else:
        place[last] = value
    return copied


MISTAKES = [
    ("request", ...),
    ("request.parameters", [1]),
    ("request.playback", None),
    ("request.seed", 10**30),
    ("request.dataset", "|rack"),
    ("request.dataset", "../datasets/track"),
    ("request.algorithm", "tiny\n"),
    ("algorithm", "tiny"),
    ("algorithm.package_hash", ...),
    ("host", {"cpu": "old"}),
    ("host.os", ...),
    ("metrics", [1.5]),
    ("metrics", {"duration": "long"}),
    ("created_at", "yesterday"),
    ("state", "resting"),
    ("events", [{"at": None}]),
]


def test_records_that_are_not_whole_are_left_out_and_stop_nothing(hive: Hive, whole: dict[str, Any]):
    folders = [write(hive, broken(whole, *mistake), run_id) for run_id, mistake in enumerate(MISTAKES, start=2)]
    last = len(MISTAKES) + 2
    write(hive, whole, last)
    report = reindex(hive, lambda done, total: None)
    assert report.runs == 1
    assert [folder for folder, _ in report.skipped] == [folder.root for folder in folders]
    assert all("\n" not in reason for _, reason in report.skipped)
    found = hive.runs.get(last)
    assert found.metrics == {"duration": 1.5}
    assert found.host is not None


def test_evaluations_that_are_not_whole_are_left_out(hive: Hive, whole: dict[str, Any]):
    folder = write(hive, whole, 2)
    for name, protocol in (("a", "{}"), ("b", "[]"), ("c", "{")):
        place = folder.evaluation(name)
        place.mkdir(parents=True)
        (place / "protocol.json").write_text(protocol)
        (place / "result.json").write_text("{}")
    report = reindex(hive, lambda done, total: None)
    assert (report.runs, report.evaluations, report.skipped) == (1, 0, [])
