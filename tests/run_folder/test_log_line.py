"""The line of a run's output that says why it failed."""

from __future__ import annotations

import os
from pathlib import Path

from slamhive.domain.run import FailureReason
from slamhive.run_folder.outcome import MAX_CHARACTERS, Evidence, TrajectoryCheck, decide, last_error_line, read_tail


def test_the_last_error_is_taken():
    assert last_error_line("error: first\nworking\nerror: x.bag  is empty\nbye\n") == "x.bag is empty"
    assert last_error_line("no errors: none\n") is None
    assert last_error_line("error:  \n") is None


def test_it_is_printable_and_bounded():
    assert last_error_line("error: \x1b[31mred\x00\n") == "[31mred"
    assert len(last_error_line("error: " + "x" * 10_000) or "") == MAX_CHARACTERS


def test_only_the_end_of_a_plain_file_is_read(tmp_path: Path):
    log = tmp_path / "log.txt"
    log.write_bytes(b"a" * 100 + b"\xff\nerror: late\n")
    assert last_error_line(read_tail(log, 20)) == "late"
    (tmp_path / "link").symlink_to(log)
    os.mkfifo(tmp_path / "pipe")
    assert read_tail(tmp_path / "link") == read_tail(tmp_path / "pipe") == read_tail(tmp_path / "none") == ""


def test_it_explains_an_exit_code():
    trajectory = TrajectoryCheck(None, FailureReason.NO_TRAJECTORY)
    outcome = decide(Evidence(exit_code=1, trajectory=trajectory, error_line="x.bag is empty"))
    assert outcome.detail == "ended with exit code 1: x.bag is empty"
