"""The player: real time loses frames and nothing else, sequential loses nothing, death is noticed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from slamhive.base.errors import InvalidInput, SlamHiveError
from slamhive.domain.calibration import LaserLayout
from slamhive.domain.sensors import Sensor, SensorKind
from slamhive.recordings.writers import BagWriter
from slamhive.runtime.playback import Player, PlayerDied
from slamhive.runtime.recording import Recording
from tests.runtime.runtime_samples import LEFT, START_NS, options, write_bag

pytestmark = pytest.mark.integration

LEFT_AND_IMU = {"left": "/cam0", "imu": "/imu"}
FRAMES = 40


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "small.bag"
    write_bag(path, FRAMES)
    return path


def test_sequential_playback_delivers_every_frame_in_order(bag: Path) -> None:
    with Player(options(bag, LEFT_AND_IMU, "sequential")) as player:
        frames = list(player.frames())
    assert [int(frame.image("left")[0, 0]) for frame in frames] == list(range(FRAMES))
    assert player.summary["frames_dropped"] == 0
    assert player.summary["lag_max_s"] is None
    assert frames[-1].fraction == pytest.approx(1.0, abs=0.05)


def test_real_time_playback_takes_as_long_as_the_recording(bag: Path) -> None:
    with Player(options(bag, LEFT_AND_IMU, queue_size=FRAMES)) as player:
        asked_at_s = time.time()
        frames = list(player.frames())
    assert asked_at_s <= player.summary["began_at_s"] <= time.time() - player.summary["duration_s"]
    assert len(frames) == FRAMES
    assert player.summary["duration_s"] >= 0.39
    assert player.summary["cpu_s"] > 0


def test_a_slow_consumer_loses_the_oldest_frames_and_each_is_counted(bag: Path) -> None:
    taken = []
    with Player(options(bag, LEFT_AND_IMU, queue_size=2)) as player:
        for frame in player.frames():
            taken.append(frame)
            time.sleep(0.06)
    numbers = [frame.number for frame in taken]
    lost = [frame.number for frame in player.dropped_frames]
    assert lost
    assert sorted(numbers + lost) == list(range(FRAMES))
    assert player.summary["frames_dropped"] == len(lost)
    assert player.summary["frames_sent"] == len(numbers)
    assert numbers[-2:] == [FRAMES - 2, FRAMES - 1]
    assert all(entry.done_s is None for entry in player.dropped_frames)


def test_imu_samples_of_dropped_frames_come_with_the_next(bag: Path) -> None:
    with Player(options(bag, LEFT_AND_IMU, queue_size=1)) as player:
        parts = []
        for frame in player.frames():
            parts.append(frame.imu)
            time.sleep(0.05)
    samples = np.concatenate(parts)
    assert player.dropped_frames
    assert len(samples) == 5 * (FRAMES - 1)
    assert np.all(np.diff(samples[:, 0]) > 0)
    assert samples[-1, 1] == FRAMES - 2


def test_odometry_comes_with_the_laser_scan_after_it(tmp_path: Path) -> None:
    geometry = LaserLayout(-0.5, 0.25, 0.1, 10.0, scan_duration_s=0.02)
    laser = Sensor("laser0", SensorKind.LASER, "/scan", 10.0, calibration=geometry.calibration())
    wheels = Sensor("odom0", SensorKind.ODOMETRY, "/odom", 20.0)
    with BagWriter(tmp_path / "flat.bag") as writer:
        for number in range(4):
            now_ns = START_NS + number * 50_000_000
            pose = np.array([number, 2.0, 0.0, 0.0, 0.0, 0.6, 0.8])
            writer.odometry(wheels, now_ns, pose, np.array([0.5, 0.0, 0.0, 0.0, 0.0, np.nan]))
            if number % 2:
                writer.laser_scan(laser, now_ns + 1, np.array([1.0, 0.05, np.inf, 10.0, 11.0]))
    with Player(options(tmp_path / "flat.bag", {"scan": "/scan", "odom": "/odom"}, "sequential")) as player:
        frames = list(player.frames())
    assert [frame.odometry[:, 1].tolist() for frame in frames] == [[0, 1], [2, 3]]
    assert frames[0].odometry[1].tolist() == pytest.approx(
        [(START_NS + 50_000_000) * 1e-9, 1, 2, 0, 0, 0, 0.6, 0.8, 0.5, 0, 0, 0, 0, 0]
    )
    scan = frames[0].laser_scan("scan")
    assert scan.ranges_m == pytest.approx([1.0, np.nan, np.nan, 10.0, np.nan], nan_ok=True)
    assert scan.angles_rad == pytest.approx([-0.5, -0.25, 0.0, 0.25, 0.5])
    assert scan.offsets_s == pytest.approx([0.0, 0.005, 0.01, 0.015, 0.02])
    with pytest.raises(TypeError, match="scan holds a laser scan, not points"):
        frames[0].points("scan")


def test_an_algorithm_needs_an_input_that_makes_frames(bag: Path) -> None:
    with pytest.raises(InvalidInput, match="no input that makes frames"):
        Player(options(bag, {"imu": "/imu"}))


def test_stamps_within_the_tolerance_make_a_pair_and_the_rest_is_counted(tmp_path: Path) -> None:
    path = tmp_path / "skewed.bag"
    write_bag(path, 20, skew_ns=1_000_000)
    with Player(options(path, {"left": "/cam0", "right": "/cam1"}, "sequential")) as player:
        frames = list(player.frames())
    assert len(frames) == 18
    assert all(frame.image("right")[0, 0] == frame.image("left")[0, 0] + 1 for frame in frames)
    assert player.summary["unmatched"] == 2


def test_a_killed_player_ends_the_run_with_an_error(tmp_path: Path) -> None:
    write_bag(tmp_path / "long.bag", frames=40, period_ns=1_000_000_000)
    with Player(options(tmp_path / "long.bag", LEFT_AND_IMU)) as player:
        frames = player.frames()
        next(frames)
        os.kill(player.pid, signal.SIGKILL)
        with pytest.raises(PlayerDied, match="ended early"):
            list(frames)


def test_closing_early_leaves_no_process_behind(bag: Path) -> None:
    player = Player(options(bag, LEFT_AND_IMU))
    next(player.frames())
    player.close()
    with pytest.raises(ProcessLookupError):
        os.kill(player.pid, 0)


def test_a_missing_topic_is_named(bag: Path) -> None:
    with pytest.raises(InvalidInput, match=r"no topic '/other' for left.*it has /cam0, /cam1, /imu"):
        Player(options(bag, {"left": "/other"}))


@pytest.mark.parametrize("kept", [0, 100, 5000])
def test_a_truncated_recording_is_explained(bag: Path, tmp_path: Path, kept: int) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(bag.read_bytes()[:kept])
    with pytest.raises(SlamHiveError, match="cannot be read as a recording"):
        Player(options(path, LEFT_AND_IMU))


DAMAGES = {
    "a name that is no name in generated code": (b"MSG: geometry_msgs/Quaternion", b"MSG: 3eometry_msgs/Quaternion"),
    "a field that is none": (b"uint32 height", b"uint32 1eight"),
}


@pytest.mark.parametrize(("whole", "broken"), DAMAGES.values(), ids=DAMAGES)
def test_damage_is_explained_in_one_line(tmp_path: Path, whole: bytes, broken: bytes) -> None:
    path = tmp_path / "a.bag"
    write_bag(path, frames=2)
    path.write_bytes(path.read_bytes().replace(whole, broken))
    with pytest.raises(InvalidInput, match=r"a\.bag cannot be read as a recording") as caught:
        Recording(path, {"left": LEFT.topic})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("error", [OverflowError("a length"), MemoryError(), SyntaxError("a\ndefinition")])
def test_damage_found_while_playing_is_explained_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def broken(*_: object) -> None:
        raise error

    write_bag(tmp_path / "a.bag", frames=2)
    with Recording(tmp_path / "a.bag", {"left": LEFT.topic}) as recording:
        monkeypatch.setattr(AnyReader, "deserialize", broken)
        with pytest.raises(InvalidInput, match="cannot be read as a recording") as caught:
            next(recording.messages())
    assert "\n" not in str(caught.value)
