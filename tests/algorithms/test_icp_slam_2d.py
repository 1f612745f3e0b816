"""ICP-SLAM in its container on the ACES log, which has no ground truth but relations between poses."""

from __future__ import annotations

from pathlib import Path

import pytest

from slamhive.bags.importing import ImportOptions
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.schema.submission import Submission
from slamhive.services.hive import open_hive

pytestmark = [pytest.mark.integration, pytest.mark.docker, pytest.mark.packages, pytest.mark.shared_data]

ACES = Path(__file__).resolve().parents[3] / "shared" / "data" / "radish_aces_2d"


@pytest.mark.timeout(1800)  # the first run builds the image
def test_it_halves_the_error_of_wheel_odometry_on_the_aces_log(tmp_path: Path) -> None:
    if not ACES.is_dir():
        pytest.skip("the recorded data in ../shared/data is not here")
    hive = open_hive({"data": tmp_path, "executor": "docker", "min_free_disk_mb": 1})
    try:
        planned = hive.catalogue.plan_import(ACES, ImportOptions(), name="aces")
        hive.catalogue.import_dataset(planned, lambda _fraction, _text: None)
        (queued,) = hive.runs.submit(Submission("icp-slam-2d", "aces", playback_mode=PlaybackMode.SEQUENTIAL))
        hive.worker(only=[queued.id]).run(until_idle=True)
        run = hive.runs.get(queued.id)
        assert run.state is RunState.SUCCEEDED, f"{run.detail}: {hive.runs.log(run.id)[-2000:]}"
        assert run.poses == 7374
        assert run.metrics is not None
        # Wheel odometry alone: 0.549 m and 2.3 degrees.
        assert run.metrics["relations.translation.mean"] < 0.25
        assert run.metrics["relations.rotation.mean"] < 1.2
    finally:
        hive.close()
