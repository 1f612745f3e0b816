"""Recordings that are not whole: real bytes, one clear error each."""

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.reader import decode, inspect_bag, messages, open_bag
from slamhive.recordings.writers import BagWriter

pytestmark = pytest.mark.quick

IMU = Sensor("imu0", SensorKind.IMU, "/imu0", 200.0)


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "good.bag"
    with BagWriter(path) as writer:
        for number in range(50):
            writer.imu(IMU, 10**9 + number * 5_000_000, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    return path


def write_ros2(folder: Path, plugin: StoragePlugin) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer2(folder, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/text", "std_msgs/msg/String", typestore=store)
        for number in range(20):
            message = store.types["std_msgs/msg/String"](data=f"number {number}")
            writer.write(connection, 10**9 * (number + 1), store.serialize_cdr(message, "std_msgs/msg/String"))
    return folder


def read_all(path):
    with open_bag(path) as reader:
        return [decode(reader, path, connection, raw) for connection, _, raw in messages(reader, path)]


def test_what_a_bag_holds(bag):
    summary = inspect_bag(bag)
    assert [(topic.topic, topic.type, topic.count) for topic in summary.topics] == [
        ("/imu0", "sensor_msgs/msg/Imu", 50)
    ]
    assert summary.start_ns == 10**9
    assert summary.duration_s == pytest.approx(49 * 0.005)
    assert len(read_all(bag)) == 50


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_ros2_recordings_are_read(tmp_path, plugin):
    folder = write_ros2(tmp_path / "recording", plugin)
    assert inspect_bag(folder).topics[0].count == 20
    assert len(read_all(folder)) == 20


def test_a_lone_mcap_file_is_read(tmp_path):
    folder = write_ros2(tmp_path / "recording", StoragePlugin.MCAP)
    assert len(read_all(next(folder.glob("*.mcap")))) == 20


def test_other_topics_are_left_out(bag):
    with open_bag(bag) as reader:
        assert list(messages(reader, bag, ["/other"])) == []


@pytest.mark.parametrize("share", [0.001, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.9999])
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_truncated_files_are_refused(bag, tmp_path, kind, share):
    whole = bag if kind == "bag" else next(write_ros2(tmp_path / "recording", StoragePlugin.MCAP).glob("*.mcap"))
    data = whole.read_bytes()
    cut = tmp_path / f"cut.{kind}"
    cut.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(InvalidInput, match=r"cut\.(bag|mcap)") as caught:
        read_all(cut)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"not a bag at all\n" * 100, b"\x89PNG\r\n\x1a\n" + bytes(500), bytes(5000)])
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_files_of_another_kind_are_refused(tmp_path, kind, content):
    path = tmp_path / f"other.{kind}"
    path.write_bytes(content)
    with pytest.raises(InvalidInput, match="cannot be read as a recording"):
        inspect_bag(path)


@pytest.mark.parametrize("name", ["empty.bag", "empty.mcap"])
def test_empty_files_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(InvalidInput, match="0 bytes"):
        inspect_bag(tmp_path / name)


def test_a_bag_without_messages_is_refused(tmp_path):
    with BagWriter(tmp_path / "none.bag"):
        pass
    with pytest.raises(InvalidInput, match="no messages"):
        inspect_bag(tmp_path / "none.bag")


def test_absent_files_folders_and_endings(tmp_path):
    with pytest.raises(InvalidInput, match="does not exist"):
        inspect_bag(tmp_path / "absent.bag")
    with pytest.raises(InvalidInput, match=r"metadata\.yaml"):
        inspect_bag(tmp_path)
    (tmp_path / "text.txt").write_text("hello")
    with pytest.raises(InvalidInput, match=r"'\.txt'"):
        inspect_bag(tmp_path / "text.txt")


def test_broken_metadata_is_refused(tmp_path):
    folder = write_ros2(tmp_path / "recording", StoragePlugin.MCAP)
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, 2")
    with pytest.raises(InvalidInput, match="recording"):
        inspect_bag(folder)


@pytest.mark.integration
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_damaged_bytes_never_escape_as_anything_else(bag, tmp_path, kind):
    whole = bag if kind == "bag" else next(write_ros2(tmp_path / "recording", StoragePlugin.MCAP).glob("*.mcap"))
    rng = np.random.default_rng(5)
    path = tmp_path / f"damaged.{kind}"
    refused = 0
    for _ in range(25):
        data = np.frombuffer(whole.read_bytes(), dtype=np.uint8).copy()
        places = rng.integers(0, len(data), 10)
        data[places] = rng.integers(0, 256, 10)
        path.write_bytes(data.tobytes())
        try:
            read_all(path)
        except InvalidInput:
            refused += 1
    assert refused > 3
