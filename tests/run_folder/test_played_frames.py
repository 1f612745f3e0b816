"""When frames of the recording were played, and what that says of the time of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slamhive.run_folder.played_frames import first_frame_s, read_played_frames

HEADER = "timestamp,received,done,dropped\n"


def frames_file(folder: Path, *lines: str, header: str = HEADER) -> Path:
    path = folder / "frames.csv"
    path.write_text(header + "".join(f"{line}\n" for line in lines))
    return path


def test_samples_before_and_after_playback_keep_their_distance_to_it(tmp_path):
    frames = read_played_frames(frames_file(tmp_path, "100,0,0.1,0", "101,2,2.1,0"))
    assert frames is not None
    clock = frames.clock(startup_s=5.0)
    assert clock is not None
    at = clock.timestamps_at(np.array([0.0, 5.0, 6.0, 7.0, 10.0]))
    assert at.tolist() == [95.0, 100.0, 100.5, 101.0, 104.0]  # played at half speed, so 1 s of the run is 0.5 s of it


def test_frames_out_of_order_do_not_turn_time_back(tmp_path):
    frames = read_played_frames(frames_file(tmp_path, "100,0,,0", "102,2,,0", "101,1.9,,1"))
    assert frames is not None
    clock = frames.clock(startup_s=0.0)
    assert clock is not None
    assert (np.diff(clock.timestamps_at(np.linspace(-1, 4, 50))) >= 0).all()


def test_without_a_startup_time_there_is_no_clock(tmp_path):
    frames = read_played_frames(frames_file(tmp_path, "100,0,0.1,0"))
    assert frames is not None
    assert frames.clock(None) is None


def test_latencies_are_those_of_frames_with_a_result(tmp_path):
    frames = read_played_frames(frames_file(tmp_path, "100,0,0.25,0", "101,1,,1", "102,2,1.5,0", "103,3,3.5,0"))
    assert frames is not None
    timestamps_s, latencies_s = frames.latencies()
    assert timestamps_s.tolist() == [100.0, 103.0]
    assert latencies_s.tolist() == [0.25, 0.5]
    assert frames.dropped_timestamps_s().tolist() == [101.0]


@pytest.mark.parametrize(
    ("header", "lines"),
    [
        (HEADER, ()),
        ("time,received\n", ("1,2",)),
        (HEADER, ("nan,0,0,0",)),
        (HEADER, ("many,0,0,0",)),
        ("", ()),
        ("received,timestamp\n", ("1",)),
    ],
)
def test_a_file_that_says_nothing_has_no_frames(tmp_path, header, lines):
    path = frames_file(tmp_path, *lines, header=header)
    assert read_played_frames(path) is None
    assert first_frame_s(path) is None


def test_the_first_frame_is_read_without_the_others(tmp_path):
    assert first_frame_s(frames_file(tmp_path, "100.5,0,,1", *["101,0,,0"] * 10_000)) == 100.5
    assert first_frame_s(tmp_path / "missing.csv") is None
