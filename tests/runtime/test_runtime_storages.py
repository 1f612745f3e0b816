"""The player reads recordings of ROS 2 and MCAP as it reads ROS 1 bags, compressed or not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamhive.runtime.playback import Player
from slamhive.runtime.recording import Recording
from tests.recordings.storages import FRAMES, SENSORS, STORAGES, convert_to, dataset_of, write_ros1
from tests.runtime.runtime_samples import options

pytestmark = pytest.mark.integration

TOPICS = {sensor.name: sensor.topic for sensor in SENSORS}


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("recordings")
    write_ros1(root / "d.bag")
    ros1 = dataset_of(root, "d.bag")
    return {
        "ros1": ros1.bag_path,
        **{storage: convert_to(ros1, root / storage, storage).bag_path for storage in STORAGES},
    }


def contents(path: Path) -> list[tuple[str, int, bytes]]:
    """Role, receive time and the bytes of what an algorithm gets of each message."""
    with Recording(path, TOPICS) as recording:
        assert recording.count("cam0") == FRAMES
        return [
            (entry.role, entry.recorded_ns, np.asarray(getattr(entry.message, "data", b"")).tobytes())
            for entry in recording.messages()
        ]


@pytest.mark.parametrize("storage", STORAGES)
def test_each_storage_plays_the_same_messages(recordings, storage):
    played, expected = contents(recordings[storage]), contents(recordings["ros1"])
    assert len(played) == len(expected) == 9 * FRAMES
    assert sorted(played) == sorted(expected)
    assert [entry[1] for entry in played] == sorted(entry[1] for entry in expected)


@pytest.mark.parametrize("storage", ["sqlite3-file-zstd", "mcap-message-zstd", "plain-mcap-zstd"])
def test_the_player_sends_the_same_frames_from_compressed_recordings(recordings, storage):
    roles = {"left": "/cam0/image_raw", "right": "/cam1/image_raw", "imu": "/imu0"}
    sent = {}
    for name in ("ros1", storage):
        with Player(options(recordings[name], roles, "sequential")) as player:
            sent[name] = [
                (frame.stamp_s, frame.image("left").tobytes(), frame.image("right").tobytes(), frame.imu.tobytes())
                for frame in player.frames()
            ]
    assert len(sent["ros1"]) == FRAMES
    assert sent[storage] == sent["ros1"]
