"""An import killed at any step is completed by the same import: nothing half, nothing twice."""

import shutil
import signal
from pathlib import Path

import pytest

from slamhive.domain.run import RunState
from slamhive.domain.sensors import SensorSetup
from slamhive.services.hive import open_hive
from slamhive.services.imports.request import ImportRequest
from slamhive.services.reindex import reindex
from tests.services.imports.world import make_source, write
from tests.services.killed_worker import killed_workers

pytestmark = pytest.mark.integration

SCRIPT = Path(__file__).with_name("killed_import.py")
STEP_STRIDE = 5
"""Odd, so that deaths before and after a step are both met."""
MOST_STEPS = 1000


def test_whatever_kills_it_the_same_import_completes_it(hive, tmp_path):
    source = make_source(tmp_path / "source", ("alpha",), trials=2)
    hive.close()
    data, fresh = hive.settings.data, tmp_path / "fresh"
    # The environments of test algorithms lie behind a link: many megabytes, which no import touches.
    shutil.copytree(data, fresh, symlinks=True)
    with killed_workers(str(SCRIPT), str(source)) as work:
        undisturbed = work(MOST_STEPS)
        assert undisturbed.returncode == 0, undisturbed.errors
        steps = range(1, undisturbed.value + 1, STEP_STRIDE)
        assert len(steps) >= 5, "every kind of step is met"
        for step in steps:
            shutil.rmtree(data)
            shutil.copytree(fresh, data, symlinks=True)
            ended = work(step)
            assert ended.returncode == -signal.SIGKILL, ended.errors
            _check_completed(source)


def _check_completed(source: Path) -> None:
    hive = open_hive()
    try:
        request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
        report = hive.imports.carry_out(request, lambda _done, _total: None)
        assert (report.imported + report.known, report.problems) == (4, [])
        assert hive.runs.counts()[RunState.SUCCEEDED] == sum(hive.runs.counts().values()) == 4
        assert not list(hive.settings.runs_folder.glob(".import-*"))
        for run_id in report.run_ids:
            record = hive.runs.record(run_id)
            assert record["uid"] == hive.runs.get(run_id).uid
            found = hive.runs.folder(run_id).trajectory.read_bytes()
            assert found == (source / record["imported"]["source"]).read_bytes()
        assert reindex(hive, lambda _done, _total: None).skipped == []
        assert len(hive.evaluations.queue(report.run_ids)) == 4
    finally:
        hive.close()


def test_a_folder_that_was_lost_is_made_again(hive, tmp_path):
    source = make_source(tmp_path / "source", ("alpha",), trials=1)
    request = ImportRequest(source, sensors={"": SensorSetup.STEREO})
    first = hive.imports.carry_out(request, lambda _done, _total: None).run_ids[0]
    shutil.rmtree(hive.runs.folder(first).root)
    write(hive.settings.runs_folder / ".import-rest" / "run.json", "{}")
    hive.imports.carry_out(request, lambda _done, _total: None)
    assert hive.runs.folder(first).trajectory.exists()
    assert hive.runs.record(first)["imported"]["trial"] == "0"
    assert not (hive.settings.runs_folder / ".import-rest").exists()
