"""Recordings with an odd channel, schema, field of metadata or length: what can be read of them is imported."""

from __future__ import annotations

import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.stream_reader import StreamReader
from mcap.writer import IndexType
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from slamhive.base.errors import InvalidInput
from slamhive.domain.dataset import Dataset
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.importers.lenient_reader import McapStorage
from slamhive.recordings.importers.registry import plan_import
from slamhive.recordings.importing import ImportOptions, ImportPlan, KeptRecording, RewrittenRecording, perform
from slamhive.recordings.writers import BagWriter
from slamhive.runtime.recording import Recording
from tests.cases import case
from tests.fuzzing import mutated
from tests.recordings.storages import ROS1, START_NS
from tests.recordings.test_import_ros import bag, recording, silent
from tests.recordings.test_import_ros_fuzz import MUTATIONS, outcome

pytestmark = pytest.mark.integration

__all__ = ["bag", "recording"]
HUMBLE = get_typestore(Stores.ROS2_HUMBLE)
IMU = "sensor_msgs/msg/Imu"


def plan_of(source: Path, **options: object) -> ImportPlan:
    return plan_import(source, ImportOptions(**options))[1]  # type: ignore[arg-type]


def played(dataset: Dataset) -> dict[str, list[int]]:
    """The times of the messages of each sensor, in ns, as a run gets them."""
    with Recording(dataset.bag_path, {sensor.name: sensor.topic for sensor in dataset.sensors}) as reader:
        found: dict[str, list[int]] = {sensor.name: [] for sensor in dataset.sensors}
        for entry in reader.messages():
            stamp = entry.message.header.stamp
            found[entry.role].append(int(stamp.sec) * 10**9 + int(stamp.nanosec))
    return found


def imu_cdr(stamp_ns: int) -> bytes:
    types = HUMBLE.types
    vector = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.5, z=9.81)
    stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    message = types[IMU](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="imu"),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.zeros(9),
        angular_velocity=vector,
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=vector,
        linear_acceleration_covariance=np.zeros(9),
    )
    return bytes(HUMBLE.serialize_cdr(message, IMU))


def write_mcap(
    path: Path,
    count: int = 200,
    *,
    start_ns: int = START_NS,
    profile: str = "ros2",
    order: int = 1,
    other: str = "json",
    **how: object,
) -> list[int]:
    """IMU samples at 100 Hz, each with one encoded as ``other``; the timestamps in ns. ``order`` -1 is backwards."""
    stamps_ns = [start_ns + number * 10_000_000 for number in range(count)]
    with path.open("wb") as file:
        writer = McapWriter(file, **how)  # type: ignore[arg-type]
        writer.start(profile=profile, library="test")
        definition, _ = HUMBLE.generate_msgdef(IMU, ros_version=2)
        imu = writer.register_channel("/imu", "cdr", writer.register_schema(IMU, "ros2msg", definition.encode()))
        schema = writer.register_schema("Log", {"json": "jsonschema"}.get(other, other), b"{}")
        log = writer.register_channel("/log", other, schema)
        for stamp_ns in stamps_ns[::order]:
            writer.add_message(imu, stamp_ns, imu_cdr(stamp_ns), stamp_ns)
            writer.add_message(log, stamp_ns, b"{}", stamp_ns)
        writer.finish()
    return stamps_ns


@pytest.mark.parametrize(
    "name", ["plain", "service", "json", "noprofile", "nosummary", "duration_zero", "onetopic_missing", "qos",
             "storage_empty", "topics_missing"],
)  # fmt: skip
def test_one_odd_thing_does_not_reject_a_recording(name, tmp_path):
    single = case("mcap_odd_channels") / f"{name}.mcap"
    source = single if single.exists() else case("rosbag2_metadata") / name
    plan = plan_of(source)
    assert plan.counts == {"imu0": 300, "laser0": 30}
    assert isinstance(plan.recording, KeptRecording if name == "plain" else RewrittenRecording)
    times = played(perform(plan, tmp_path / "made", silent))
    start_ns = 1_700_000_000_000_000_000
    assert times == {
        "imu0": [start_ns + number * 10_000_000 for number in range(300)],
        "laser0": [start_ns + number * 100_000_000 for number in range(30)],
    }


def test_what_a_killed_recorder_left_is_read(tmp_path):
    plan = plan_of(case("mcap_odd_channels") / "killed.mcap")
    assert plan.counts == {"imu0": 230, "laser0": 23}
    assert any("253 messages can be read" in note and "ends within a record" in note for note in plan.notes)
    assert {name: len(times) for name, times in played(perform(plan, tmp_path / "made", silent)).items()} == plan.counts


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"profile": ""},
        {"other": "protobuf"},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"use_chunking": False},
        {"use_chunking": False, "order": -1},
        {"index_types": IndexType.NONE, "order": -1},
        {"chunk_size": 5000, "order": -1},
    ],
)
def test_messages_come_in_order_however_the_file_is_indexed(tmp_path, how):
    stamps_ns = write_mcap(tmp_path / "a.mcap", **how)
    plan = plan_of(tmp_path / "a.mcap")
    assert plan.counts == {"imu0": 200}
    assert not any("/log" in note for note in plan.notes)
    assert played(perform(plan, tmp_path / "made", silent)) == {"imu0": stamps_ns}


def test_a_whole_file_is_read_by_its_index(tmp_path, monkeypatch):
    write_mcap(tmp_path / "a.mcap")
    monkeypatch.setattr(McapStorage, "_scan", lambda _: pytest.fail("the whole file is read"))
    assert plan_of(tmp_path / "a.mcap").counts == {"imu0": 200}


def test_a_damaged_chunk_is_a_loss_of_as_many_messages_as_the_file_says(tmp_path):
    path = tmp_path / "a.mcap"
    write_mcap(path, chunk_size=20_000, repeat_channels=False)
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        reader = StreamReader(file, emit_chunks=True)
        ends = [(type(record).__name__, file.tell()) for record in reader.records]
    second_end = [end for kind, end in ends if kind == "Chunk"][1]  # the first one holds the definitions
    data[second_end - 50 : second_end - 40] = b"\xee" * 10
    path.write_bytes(data)
    with pytest.raises(InvalidInput, match=r"\d+ of 400 messages can be read.*a chunk is damaged.*--accept-loss"):
        plan_of(path)
    left = plan_of(path, accept_loss=True)
    assert 100 < left.counts["imu0"] < 200
    made = perform(left, tmp_path / "made", silent)
    assert len(played(made)["imu0"]) == left.counts["imu0"]


def test_messages_of_ros_1_in_an_mcap_file(tmp_path):
    source, target = tmp_path / "a.bag", tmp_path / "a.mcap"
    imu = Sensor("imu0", SensorKind.IMU, "/imu", 100.0)
    stamps_ns = [START_NS + number * 10_000_000 for number in range(50)]
    with BagWriter(source) as out:
        for stamp_ns in stamps_ns:
            out.imu(imu, stamp_ns, np.array([0.0, 0.1, 0.2]), np.array([0.0, 0.0, 9.8]))
    with AnyReader([source]) as reader, target.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="ros1", library="test")
        (connection,) = reader.connections
        text = connection.msgdef.data.encode()
        schema = writer.register_schema("sensor_msgs/Imu", "ros1msg", text)
        channel = writer.register_channel("/imu", "ros1", schema)
        for _, time_ns, raw in reader.messages():
            writer.add_message(channel, time_ns, raw, time_ns)
        writer.finish()
    made = perform(plan_of(target), tmp_path / "made", silent)
    assert played(made) == {"imu0": stamps_ns}


@pytest.mark.parametrize("storage", ["sqlite3", "mcap", "sqlite3-file-zstd", "sqlite3-message-zstd"])
@pytest.mark.integration
def test_a_folder_without_metadata(recording: Callable[[str], Path], tmp_path, storage):
    source = tmp_path / "d"
    shutil.copytree(recording(storage), source)
    whole = plan_of(source)
    (source / "metadata.yaml").unlink()
    for path in [*source.iterdir()]:
        (source / f"._{path.name}").write_bytes(b"\0\5\26\7Mac OS X")
    plan = plan_of(source)
    assert plan.counts == whole.counts
    assert {name: len(times) for name, times in played(perform(plan, tmp_path / "made", silent)).items()} == plan.counts


def test_a_file_that_zstd_compressed(tmp_path):
    stamps_ns = write_mcap(tmp_path / "a.mcap")
    packed = tmp_path / "b.mcap.zstd"
    packed.write_bytes(zstandard.compress((tmp_path / "a.mcap").read_bytes()))
    assert played(perform(plan_of(packed), tmp_path / "made", silent)) == {"imu0": stamps_ns}
    packed.write_bytes(packed.read_bytes()[:-2000])
    with pytest.raises(InvalidInput) as caught:
        plan_of(packed)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["a.mcap", "d"])
def test_reindexing_of_ros_1_is_no_advice_for_ros_2(tmp_path, name):
    path = tmp_path / name
    if name == "d":
        path.mkdir()
        (path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
        (path / "a.db3").write_bytes(b"SQLite format 3\0" + bytes(100))
    else:
        path.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    with pytest.raises(InvalidInput) as caught:
        plan_of(path)
    assert "rosbag reindex" not in str(caught.value)


def write_parts(folder: Path, gap_ns: int = 10_000_000, topic: str = "/imu") -> list[int]:
    """Two bags as ``rosbag record --split`` writes them, the later one named first; the timestamps."""
    folder.mkdir()
    stamps_ns = []
    for number, name in enumerate(("z_0.bag", "a_1.bag")):
        with BagWriter(folder / name) as out:
            sensor = Sensor("imu0", SensorKind.IMU, topic if number else "/imu", 100.0)
            for index in range(20):
                stamp_ns = START_NS + number * (190_000_000 + gap_ns) + index * 10_000_000
                out.imu(sensor, stamp_ns, np.zeros(3), np.zeros(3))
                stamps_ns.append(stamp_ns)
    return stamps_ns


def test_split_bags_are_one_recording(tmp_path):
    stamps_ns = write_parts(tmp_path / "split")
    (tmp_path / "split" / "._z_0.bag").write_bytes(b"\0\5\26\7Mac OS X")
    name, plan = plan_import(tmp_path / "split", ImportOptions())
    assert name == "ros1"
    assert plan.counts == {"imu0": 40}
    assert played(perform(plan, tmp_path / "made", silent)) == {"imu0": stamps_ns}


def test_bags_of_other_sensors_at_the_same_time_are_parts(tmp_path):
    write_parts(tmp_path / "sensors", gap_ns=-190_000_000, topic="/other")
    assert plan_of(tmp_path / "sensors").counts == {"imu0": 20, "imu1": 20}


@pytest.mark.parametrize(
    ("gap_ns", "why"), [(3 * 10**12, "3000 s after"), (-100_000_000, "have /imu at the same time")]
)
def test_bags_of_several_recordings_are_no_parts(tmp_path, gap_ns, why):
    write_parts(tmp_path / "two", gap_ns)
    with pytest.raises(InvalidInput, match=f"no parts of one recording: .*{why}.*give one of them"):
        plan_of(tmp_path / "two")


@pytest.mark.parametrize(
    ("gap_ns", "why"),
    [(4000 * 10**9, "4000 s after"), (-1_000_000_000, "a.mcap and b.mcap have /imu at the same time")],
)
def test_files_of_several_recordings_of_ros_2_are_no_parts(tmp_path, gap_ns, why):
    last_ns = write_mcap(tmp_path / "a.mcap")[-1]
    write_mcap(tmp_path / "b.mcap", start_ns=last_ns + gap_ns)
    with pytest.raises(InvalidInput, match=f"no parts of one recording: .*{why}.*give one of them"):
        plan_of(tmp_path)


def test_parts_of_ros_2_may_share_a_few_messages(tmp_path):
    last_ns = write_mcap(tmp_path / "a.mcap")[-1]
    write_mcap(tmp_path / "b.mcap", start_ns=last_ns - 15_000_000)
    plan = plan_of(tmp_path)
    assert plan.counts == {"imu0": 400}
    assert any("refuses it as it is: it has no metadata.yaml" in note for note in plan.notes)


@pytest.mark.integration
def test_a_part_that_the_metadata_does_not_name_is_read(recording: Callable[[str], Path], tmp_path):
    source = tmp_path / "d"
    shutil.copytree(recording("mcap"), source)
    whole = plan_of(source)
    with AnyReader([source]) as reader:
        end_ns = reader.end_time
    write_mcap(source / "d_1.mcap", start_ns=end_ns)
    plan = plan_of(source)
    assert sum(plan.counts.values()) == sum(whole.counts.values()) + 200
    assert any("metadata.yaml does not name d_1.mcap" in note for note in plan.notes)


def test_lengths_of_index_records_that_old_writers_state(tmp_path):
    plan = plan_of(case("ros1_bags") / "cturtle.bag")
    assert plan.counts == {"imu0": 200}
    assert len(played(perform(plan, tmp_path / "made", silent))["imu0"]) == 200


@pytest.mark.parametrize("format_name", [None, "ros1"])
def test_a_bag_from_before_version_2_is_named(format_name):
    with pytest.raises(InvalidInput, match=r"v12\.bag.* a ROS bag of version 1\.2.*2\.0.*rosbag reindex"):
        plan_import(case("ros1_bags") / "v12.bag", ImportOptions(), format_name)


def test_each_topic_has_its_reason_where_none_is_left(tmp_path):
    with pytest.raises(InvalidInput, match=r"/points: it has a single message"):
        plan_of(case("ros1_bags") / "single.bag")
    write_mcap(tmp_path / "a.mcap")
    with pytest.raises(InvalidInput, match=r"\(/log: its messages are json\)"):
        plan_of(tmp_path / "a.mcap", topics={"imu0": "none"})
    with pytest.raises(InvalidInput, match=r"'/log'.*sensor imu0 cannot be read: its messages are json"):
        plan_of(tmp_path / "a.mcap", topics={"imu0": "/log"})


def test_a_topic_that_is_named_is_not_left_out():
    plan = plan_of(case("ros1_bags") / "dash-topic.bag", topics={"imu0": "/cam-left/imu"})
    assert {sensor.name: sensor.topic for sensor in plan.sensors} == {"imu0": "/cam-left/imu"}
    assert not any("left out" in note for note in plan.notes)


@pytest.mark.integration
@pytest.mark.parametrize("damage", ["mcap", "mcap-no-index", "mcap-zstd", "db3", "old-ros1"])
def test_mutated_odd_recordings(recording: Callable[[str], Path], tmp_path: Path, damage: str) -> None:
    source = target = tmp_path / f"a.{damage.partition('-')[0]}"
    if damage == "db3":
        source = tmp_path / "d"
        shutil.copytree(recording("sqlite3"), source)
        (source / "metadata.yaml").unlink()
        (target,) = source.iterdir()
    elif damage == "old-ros1":
        source = target = tmp_path / "a.bag"
        source.write_bytes(recording(ROS1).read_bytes())
    else:
        write_mcap(source, chunk_size=5000, repeat_schemas=damage != "mcap-no-index")
    if damage == "mcap-zstd":
        target = source = tmp_path / "a.mcap.zstd"
        source.write_bytes(zstandard.compress((tmp_path / "a.mcap").read_bytes()))
    original, seen = target.read_bytes(), set()
    for seed in range(MUTATIONS):
        target.write_bytes(mutated(original, random.Random(f"{damage}{seed}")))
        name = {"db3": "ros2", "bag": "ros1"}.get(target.suffix[1:], "mcap")
        seen.add(re.sub(r"\d+", "N", outcome(source, tmp_path / f"data{seed}", ImportOptions(accept_loss=True), name)))
    assert len(seen) > 2
