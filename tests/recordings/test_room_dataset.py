"""The room as a dataset: reproducible, whole or absent, and what its description says."""

import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest

from slamhive.base.errors import Conflict, InvalidInput, Unavailable
from slamhive.packages.dataset_file import load_dataset
from slamhive.recordings.reader import decode, inspect_bag, messages, open_bag
from slamhive.recordings.room import RoomOptions, render_room
from slamhive.recordings.staging import new_dataset_folder
from slamhive.trajectory.layout import read_tum
from tests.sharing import made_once

pytestmark = pytest.mark.integration

TINY = RoomOptions(name="tiny", duration_s=0.2, width=64, height=48, workers=1)


def silent(fraction, text):
    pass


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room") / "tiny"
    return render_room(folder, TINY, silent)


def test_the_same_seed_makes_the_same_bytes_and_progress_rises_to_one(tiny, tmp_path):
    seen: list[float] = []
    again = render_room(tmp_path / "tiny", TINY, lambda fraction, text: seen.append(fraction))
    assert (seen[0], seen[-1]) == (0.0, 1.0)
    assert all(later >= earlier for earlier, later in itertools.pairwise(seen))
    assert again.checksum == tiny.checksum
    assert again.bag_path.read_bytes() == tiny.bag_path.read_bytes()
    assert (again.folder / "groundtruth.txt").read_bytes() == (tiny.folder / "groundtruth.txt").read_bytes()


def test_another_seed_makes_another_world(tiny, tmp_path):
    other = RoomOptions(name="tiny", duration_s=0.2, width=64, height=48, workers=1, seed=2)
    assert render_room(tmp_path / "tiny", other, silent).checksum != tiny.checksum


def test_the_description_reads_back_equal(tiny):
    assert load_dataset(tiny.folder) == tiny
    assert (tiny.folder / "rosbag_play.py").is_file()
    assert tiny.groundtruth.gravity_aligned


def test_topics_and_counts(tiny):
    counts = {topic.topic: topic.count for topic in inspect_bag(tiny.bag_path).topics}
    assert counts == {
        "/cam0/camera_info": 5,
        "/cam0/image_raw": 5,
        "/cam1/camera_info": 5,
        "/cam1/image_raw": 5,
        "/depth0/image_raw": 5,
        "/imu0": 41,
        "/points": 2,
    }
    assert {sensor.topic for sensor in tiny.sensors} <= set(counts)


def test_stamps_follow_the_conventions(tiny):
    received = []
    with open_bag(tiny.bag_path) as reader:
        for connection, time_ns, raw in messages(reader, tiny.bag_path):
            message = decode(reader, tiny.bag_path, connection, raw)
            stamp_ns = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            scan_ns = 100_000_000 if connection.topic == "/points" else 0
            assert time_ns - stamp_ns == scan_ns
            received.append(time_ns)
    assert received == sorted(received)


def test_camera_info_carries_the_baseline(tiny):
    with open_bag(tiny.bag_path) as reader:
        connection, _, raw = next(messages(reader, tiny.bag_path, ["/cam1/camera_info"]))
        info = decode(reader, tiny.bag_path, connection, raw)
    left, right = tiny.sensor("cam0"), tiny.sensor("cam1")
    T_left_right = np.linalg.inv(np.reshape(left.T_body_sensor, (4, 4))) @ np.reshape(right.T_body_sensor, (4, 4))
    assert np.allclose(T_left_right[:3, 3], [0.12, 0, 0])
    assert pytest.approx(-left.calibration["fx"] * 0.12) == info.P[3]


def test_ground_truth_starts_with_the_recording(tiny):
    truth = read_tum(tiny.groundtruth_path)
    assert truth.stamps_s[0] == 1000.0
    assert truth.stamps_s[-1] == pytest.approx(1000.2, abs=1e-9)
    assert len(truth) == 41


def test_a_failure_leaves_nothing(tmp_path):
    def interrupt(fraction, text):
        if fraction > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_room(tmp_path / "tiny", TINY, interrupt)
    assert list(tmp_path.iterdir()) == []


def test_what_a_kill_left_is_cleaned(tmp_path):
    aside = tmp_path / ".tiny.partial"
    (aside / "deeper").mkdir(parents=True)
    (aside / "tiny.bag").write_bytes(b"half")
    with new_dataset_folder(tmp_path / "tiny", 0) as folder:
        assert list(folder.iterdir()) == []
    assert [entry.name for entry in tmp_path.iterdir()] == ["tiny"]


def test_two_at_once_or_a_taken_name_conflict(tmp_path):
    second = new_dataset_folder(tmp_path / "tiny", 0)
    with new_dataset_folder(tmp_path / "tiny", 0), pytest.raises(Conflict, match="being made"):
        second.__enter__()
    with pytest.raises(Conflict, match="exists already"), new_dataset_folder(tmp_path / "tiny", 0):
        pass


def test_too_little_disk_is_said_before_anything_is_written(tmp_path):
    with pytest.raises(Unavailable, match="MB free"), new_dataset_folder(tmp_path / "tiny", 10**18):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"duration_s": 0.0}, "duration"),
        ({"duration_s": float("nan")}, "duration"),
        ({"seed": -1}, "seed"),
        ({"width": 10}, "width"),
        ({"camera_rate_hz": 1000.0}, "camera rate"),
        ({"name": "../up"}, "name"),
        ({"workers": 0}, "workers"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, problem):
    with pytest.raises(InvalidInput, match=problem):
        RoomOptions(**options)


@pytest.mark.integration
def test_worker_processes_make_the_same_bytes(tiny, tmp_path):
    options = RoomOptions(name="tiny", duration_s=0.2, width=64, height=48, workers=2)
    assert render_room(tmp_path / "tiny", options, silent).checksum == tiny.checksum


@pytest.mark.integration
def test_fifteen_seconds_render_in_the_time_and_memory_allowed(tmp_path):
    peak = 0
    process = psutil.Process()
    before = process.memory_info().rss

    def watch(fraction, text):
        nonlocal peak
        family = [process, *process.children(recursive=True)]
        peak = max(peak, sum(member.memory_info().rss for member in family) - before)

    started = sum(process.cpu_times()[:4])
    render_room(tmp_path / "room", RoomOptions(), watch)
    assert sum(process.cpu_times()[:4]) - started < 120.0  # 60 s on 2 cores, whatever else the machine does
    assert peak < 600e6
    made_once("dataset-room", lambda shared: shutil.move(tmp_path / "room", shared))  # others need it as it is


_RENDER = """
import sys
from pathlib import Path
from slamhive.recordings.room import RoomOptions, render_room

def main():
    options = RoomOptions(name="tiny", duration_s=30.0, width=64, height=48, workers=2)
    render_room(Path(sys.argv[1]), options, lambda fraction, text: print(fraction, flush=True))

if __name__ == "__main__":
    main()
"""


@pytest.mark.integration
def test_a_killed_render_leaves_no_process_and_can_be_repeated(tmp_path):
    script = tmp_path / "render.py"
    script.write_text(_RENDER)
    data = tmp_path / "data"
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    with subprocess.Popen(
        [sys.executable, script, data / "tiny"], stdout=subprocess.PIPE, text=True, env=environment
    ) as rendering:
        assert rendering.stdout is not None
        while not float(rendering.stdout.readline()) > 0.05:
            pass
        workers = psutil.Process(rendering.pid).children(recursive=True)
        assert len(workers) >= 2
        rendering.kill()
    _, alive = psutil.wait_procs(workers, timeout=20)
    assert alive == []
    assert [entry.name for entry in data.iterdir()] == [".tiny.partial"]
    render_room(data / "tiny", TINY, silent)
    assert [entry.name for entry in data.iterdir()] == ["tiny"]
