"""The walk-through of docs/ros1.md: the template is copied, built and run as it is."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from slamhive.base.errors import InvalidInput
from slamhive.base.project import project_root
from slamhive.documents.submission import Submission
from slamhive.domain.configuration import PlaybackMode
from slamhive.domain.run import RunState
from slamhive.packages.algorithm_file import ALGORITHM_FOLDERS
from slamhive.recordings.room import RoomOptions
from slamhive.services.hive import Hive, open_hive

pytestmark = [pytest.mark.integration, pytest.mark.docker, pytest.mark.classical]

TEMPLATE = project_root() / "docs" / "extend" / "ros1-template"
SECONDS = 4.0


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    package = tmp_path_factory.mktemp("algorithms") / "my-slam"
    shutil.copytree(TEMPLATE, package)
    opened = open_hive({"data": tmp_path_factory.mktemp("data"), "executor": "docker", "min_free_disk_mb": 1})
    options = RoomOptions(name="room", duration_s=SECONDS, width=160, height=120, camera_rate_hz=2.0)
    opened.catalogue.render_room(options, lambda _fraction, _text: None)
    ALGORITHM_FOLDERS.register("my-slam", package)
    yield opened
    del ALGORITHM_FOLDERS._entries["my-slam"], ALGORITHM_FOLDERS._origins["my-slam"]
    opened.close()


def run_once(hive: Hive) -> int:
    (queued,) = hive.runs.submit(Submission("my-slam", "room", playback_rate=0.5, timeout_s=400.0))
    hive.worker(only=[queued.id]).run(until_idle=True)
    return queued.id


@pytest.mark.timeout(1800)  # the first run of a package builds its image
def test_the_template_runs_as_it_is_and_finds_the_orientation(hive: Hive) -> None:
    run = hive.runs.get(run_once(hive))
    assert run.state is RunState.SUCCEEDED, f"{run.detail}: {hive.runs.log(run.id)[-2000:]}"
    assert run.poses is not None
    assert run.poses >= 10 * SECONDS - 5
    assert run.metrics is not None
    assert run.metrics["rpe_rot.frames.rmse"] < 0.5
    assert run.metrics["frames.dropped"] <= 1
    assert run.metrics["latency.median"] < 0.1
    folder = hive.runs.folder(run.id)
    assert '"topic": "/points"' in folder.playback.read_text()


def test_a_node_that_dies_is_the_reason_of_a_failed_run(hive: Hive) -> None:
    node = Path(ALGORITHM_FOLDERS.get("my-slam")) / "nodes" / "dead_reckoning.py"
    text = node.read_text()
    dying = text.replace("            system.want(message.header.stamp)\n", "            os._exit(3)\n")
    assert dying != text
    node.write_text(dying.replace("import threading\n", "import os\nimport threading\n"))
    run = hive.runs.get(run_once(hive))
    node.write_text(text)
    assert run.state is RunState.FAILED
    assert "the node my_slam-1 died (exit code 3)" in hive.runs.log(run.id)


def test_what_rosbag_play_cannot_do_is_refused_before_the_start(hive: Hive) -> None:
    with pytest.raises(InvalidInput, match="my-slam cannot be played sequential"):
        hive.runs.submit(Submission("my-slam", "room", playback_mode=PlaybackMode.SEQUENTIAL))
