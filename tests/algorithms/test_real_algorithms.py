"""The shipped algorithms without Docker: environments of their own, rendered data, evaluated by the product."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest

from slamhive.documents.submission import Submission
from slamhive.domain.configuration import PlaybackMode, VariantStep
from slamhive.domain.protocol import Alignment
from slamhive.domain.run import RunState
from slamhive.packages.dataset_file import DATASET_FILE, dataset_to_yaml, load_dataset
from slamhive.recordings.exporters import export_dataset, plan_export
from slamhive.recordings.room import RoomOptions
from slamhive.services.hive import Hive, open_hive
from tests.sharing import share_environments

pytestmark = pytest.mark.integration


@pytest.fixture(scope="module")
def hive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hive]:
    data = tmp_path_factory.mktemp("data")
    share_environments(data)
    opened = open_hive({"data": data, "executor": "process", "min_free_disk_mb": 1})
    options = RoomOptions(name="room", duration_s=5.0)
    opened.catalogue.render_room(options, lambda _fraction, _text: None)
    yield opened
    opened.close()


@pytest.mark.parametrize(
    ("algorithm", "poses"), [("kiss-icp", 50), ("rko-lio", 50), ("orb-slam3-rgbd", 95), ("orb-slam3-stereo", 95)]
)
def test_each_system_follows_the_room_within_ten_centimetres(hive: Hive, algorithm: str, poses: int) -> None:
    # Sequential: what is tested here is that the system is right, not how fast this machine is at the moment.
    (queued,) = hive.runs.submit(Submission(algorithm, "room", playback_mode=PlaybackMode.SEQUENTIAL))
    hive.worker(only=[queued.id]).run(until_idle=True)
    run = hive.runs.get(queued.id)
    assert run.state is RunState.SUCCEEDED, f"{run.detail}: {hive.runs.log(run.id)[-2000:]}"
    assert run.poses is not None
    assert run.poses >= poses
    assert run.metrics is not None
    assert run.metrics["ate.rmse"] < 0.10
    about = hive.runs.record(run.id)["about"]
    assert about["version"] == run.version.version if run.version else False
    if algorithm.startswith("orb"):
        assert about["vocabulary"]["words"] > 5000


def test_the_storage_of_the_recording_does_not_change_the_trajectory(hive: Hive) -> None:
    """A ROS 1 bag, ROS 2 with SQLite and MCAP, each thinned by a step first."""
    trajectories = set()
    for name in ("room", export_room(hive, "ros2"), export_room(hive, "mcap")):
        variant = (VariantStep("point_stride", ("lidar0",), {"every": 3}),)
        asked = Submission("kiss-icp", name, playback_mode=PlaybackMode.SEQUENTIAL, variant=variant)
        (queued,) = hive.runs.submit(asked)
        hive.worker(only=[queued.id]).run(until_idle=True)
        run = hive.runs.get(queued.id)
        assert run.state is RunState.SUCCEEDED, f"{run.detail}: {hive.runs.log(run.id)[-2000:]}"
        assert run.metrics is not None
        assert run.metrics["ate.rmse"] < 0.10
        trajectories.add(hive.runs.folder(run.id).trajectory.read_text())
    assert len(trajectories) == 1


def export_room(hive: Hive, format_name: str) -> str:
    """The room with a recording of another format, as a dataset of its own."""
    room = hive.catalogue.dataset("room")
    folder = room.folder.with_name(f"room-{format_name}")
    export_dataset(plan_export(room, format_name, partial=False), folder, lambda _fraction, _text: None)
    made = replace(load_dataset(folder), name=folder.name)
    (folder / DATASET_FILE).write_text(dataset_to_yaml(made))
    return made.name


def test_kiss_icp_leaves_its_map_if_asked(hive: Hive) -> None:
    """Compared as its first pose has it: on so short a path positions alone leave some degrees of rotation open."""
    asked = Submission(
        "kiss-icp",
        "room",
        parameters={"save_map": True},
        playback_mode=PlaybackMode.SEQUENTIAL,
        alignment=Alignment.FIRST_POSE,
    )
    (queued,) = hive.runs.submit(asked)
    hive.worker(only=[queued.id]).run(until_idle=True)
    metrics = hive.runs.get(queued.id).metrics
    assert metrics is not None
    assert metrics["map.points"] > 10_000
    assert metrics["map.accuracy.20cm"] > 0.9
    assert metrics["map.fscore.20cm"] > 0.7
