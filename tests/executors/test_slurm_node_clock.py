"""Times of a node whose clock is wrong. In virtual machines a node was set an hour ahead; these are its files."""

from __future__ import annotations

import errno
import json
import os
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from slamhive.base.clock import utc_now
from slamhive.executors.slurm.executor import _end_of, by_this_clock, difference_in_words, start_by_this_clock
from slamhive.executors.status import RunHandle

HOUR = timedelta(hours=1)


def written(path: Path, at: datetime, content: str = "{}") -> Path:
    path.write_text(content)
    os.utime(path, (at.timestamp(), at.timestamp()))
    return path


@pytest.mark.parametrize("ahead", [HOUR, -HOUR])
def test_the_start_is_that_of_the_file_if_the_clocks_differ(tmp_path, ahead):
    began = utc_now() - timedelta(seconds=30)
    file = written(tmp_path / "shim.json", began)
    found = start_by_this_clock(file, began + ahead)
    assert abs(found - began) < timedelta(seconds=2)
    words = "ahead" if ahead > timedelta() else "behind"
    assert difference_in_words("vm3", began + ahead, found) == (
        f"the clock of node vm3 is 3600 s {words}; times of the run are corrected"
    )


def test_every_look_gives_the_same_start(tmp_path):
    began = utc_now()
    file = written(tmp_path / "shim.json", began)
    found = start_by_this_clock(file, began + HOUR)
    written(file, began + timedelta(seconds=5))  # as if the clock of the file system were corrected
    assert start_by_this_clock(file, began + HOUR) == found


def test_a_start_that_agrees_is_left_as_it_is(tmp_path):
    said = utc_now()
    file = written(tmp_path / "shim.json", said + timedelta(seconds=4))  # a slow file system
    assert start_by_this_clock(file, said) == said
    assert difference_in_words("vm3", said, said) is None


def test_a_wrong_clock_of_the_file_system_is_no_wrong_clock_of_the_node(tmp_path, monkeypatch):
    """The worker and the node agree. What both write gets a time an hour ahead."""
    said = utc_now()
    file = written(tmp_path / "shim.json", said + HOUR)
    real = Path.write_bytes

    def write_bytes(path: Path, data: bytes) -> int:
        count = real(path, data)
        ahead_s = (utc_now() + HOUR).timestamp()
        os.utime(path, (ahead_s, ahead_s))
        return count

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    assert by_this_clock(file, said) == said


def test_a_full_disk_leaves_the_time_as_it_is(tmp_path, monkeypatch):
    said = utc_now()
    file = written(tmp_path / "exit.json", said + HOUR)

    def write_bytes(_path: Path, _data: bytes) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    assert by_this_clock(file, said) == said


@pytest.mark.parametrize(("lasted_s", "timed_out"), [(30, False), (90, True)])
def test_a_run_that_was_ended_is_late_by_the_clock_of_the_worker(tmp_path, lasted_s, timed_out):
    """The clock of the node was set right while the run went on, so its own times say 3600 s less than it took."""
    ended = utc_now()
    began = ended - timedelta(seconds=lasted_s)
    content: dict[str, object] = {"exit_code": 143, "out_of_memory": False, "signalled": True}
    content |= {"started_at": (began + HOUR).isoformat(), "ended_at": ended.isoformat()}
    written(tmp_path / "exit.json", ended, json.dumps(content))
    data = {"work": str(tmp_path), "timeout_s": "60", "started_at": began.isoformat()}
    end = _end_of(RunHandle("slurm", data), shares_files=True)
    assert end is not None
    assert (end.exited.started_at, end.exited.ended_at) == (began, ended)
    assert end.exited.timed_out is timed_out
