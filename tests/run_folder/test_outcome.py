from __future__ import annotations

import os
from pathlib import Path

import pytest

from slamhive.domain.run import FailureReason, RunState
from slamhive.run_folder.outcome import Evidence, TrajectoryCheck, decide, inspect_trajectory, is_finished

VALID = TrajectoryCheck(poses=7)
NONE = TrajectoryCheck(None, FailureReason.NO_TRAJECTORY, "the algorithm left no traj.txt")
LINE = "1.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("evidence", "reason"),
    [
        (Evidence(0, VALID), None),
        (Evidence(0, NONE, finished=True), FailureReason.NO_TRAJECTORY),
        (Evidence(1, VALID, finished=True), FailureReason.NONZERO_EXIT),
        (Evidence(None, VALID), FailureReason.NONZERO_EXIT),
        (Evidence(143, VALID, lingered=True, finished=True), None),
        (Evidence(137, NONE, lingered=True, finished=True), FailureReason.NO_TRAJECTORY),
        (Evidence(137, VALID, out_of_memory=True), FailureReason.OUT_OF_MEMORY),
        (Evidence(0, VALID, out_of_memory=True), FailureReason.OUT_OF_MEMORY),
        (Evidence(137, VALID, process_limit=True, most_processes=64), FailureReason.PROCESS_LIMIT),
        (Evidence(1, VALID, refused_processes=True, most_processes=64), FailureReason.PROCESS_LIMIT),
        (Evidence(0, VALID, refused_processes=True, most_processes=64), None),
        (Evidence(0, NONE, refused_processes=True, most_processes=64), FailureReason.NO_TRAJECTORY),
        (Evidence(137, VALID, process_limit=True, out_of_memory=True), FailureReason.OUT_OF_MEMORY),
        (Evidence(143, VALID, timed_out=True, timeout_s=5.0), FailureReason.TIMEOUT),
        (Evidence(0, VALID, player_error="no bag", finished=True), FailureReason.PLAYER_FAILED),
        (Evidence(1, NONE, player_error="no bag"), FailureReason.PLAYER_FAILED),
        (Evidence(143, NONE, player_error="no bag", timed_out=True), FailureReason.TIMEOUT),
        (Evidence(None, VALID, gone_because="removed"), FailureReason.LOST),
        (Evidence(None, NONE, gone_because="removed", finished=True), FailureReason.LOST),
        (Evidence(None, VALID, gone_because="removed", finished=True), None),
    ],
)
def test_decide(evidence, reason):
    outcome = decide(evidence)
    assert outcome.reason is reason
    assert outcome.state is (RunState.SUCCEEDED if reason is None else RunState.FAILED)
    assert outcome.detail


def test_a_limit_of_processes_is_told_with_the_remedy():
    killed = decide(Evidence(137, NONE, process_limit=True, most_processes=64)).detail
    assert "limit of 64 processes and threads" in killed
    assert "RUN_PIDS" in killed
    refused = decide(Evidence(1, NONE, refused_processes=True, most_processes=64, error_line="no new thread")).detail
    assert "exit code 1: no new thread, after it was refused processes beyond its limit of 64" in refused
    assert "RUN_PIDS" in refused


def test_who_was_denied_something_is_named():
    for evidence in (
        Evidence(1, NONE, denied_to="the worker's user"),
        Evidence(0, NONE, denied_to="the worker's user"),
    ):
        assert "something was denied to the worker's user: see `user`" in decide(evidence).detail
    assert "denied" not in decide(Evidence(0, VALID, denied_to="the worker's user")).detail


def test_details_name_signal_limit_and_time():
    assert "SIGSEGV" in decide(Evidence(139, VALID)).detail
    assert "80 MB" in decide(Evidence(137, VALID, out_of_memory=True, memory_limit_bytes=80_000_000)).detail
    assert "5 s" in decide(Evidence(137, VALID, timed_out=True, timeout_s=5.0)).detail


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", FailureReason.EMPTY_TRAJECTORY),
        ("# only a comment\n\n", FailureReason.EMPTY_TRAJECTORY),
        ("1.0 0 0 0\n", FailureReason.MALFORMED_TRAJECTORY),
        ("1.0 nan 0 0 0 0 0 1\n", FailureReason.MALFORMED_TRAJECTORY),
        (LINE + LINE, FailureReason.MALFORMED_TRAJECTORY),
        ("\x00\x01\x02", FailureReason.MALFORMED_TRAJECTORY),
    ],
)
def test_bad_trajectories(tmp_path: Path, content, reason):
    path = tmp_path / "traj.txt"
    path.write_text(content)
    check = inspect_trajectory(path)
    assert (check.poses, check.problem) == (None, reason)
    assert "traj.txt" in check.detail
    assert "\n" not in check.detail


def test_valid_trajectory(tmp_path: Path):
    path = tmp_path / "traj.txt"
    path.write_text("# c\n" + LINE + "2.0 1 0 0 0 0 0 1\n")
    assert inspect_trajectory(path) == TrajectoryCheck(2)


def test_absent_trajectory(tmp_path: Path):
    assert inspect_trajectory(tmp_path / "traj.txt").problem is FailureReason.NO_TRAJECTORY
    assert inspect_trajectory(tmp_path / "absent" / "traj.txt").problem is FailureReason.NO_TRAJECTORY


def test_link_pipe_and_folder_do_not_fool(tmp_path: Path):
    secret = tmp_path / "secret"
    secret.write_text(LINE)
    link, pipe, folder = tmp_path / "link", tmp_path / "pipe", tmp_path / "folder"
    link.symlink_to(secret)
    os.mkfifo(pipe)
    folder.mkdir()
    for path in (link, pipe, folder):
        assert inspect_trajectory(path).problem is FailureReason.MALFORMED_TRAJECTORY


def test_huge_trajectory_is_not_read(tmp_path: Path):
    path = tmp_path / "traj.txt"
    path.touch()
    os.truncate(path, 10_000_000_000)
    check = inspect_trajectory(path)
    assert check.problem is FailureReason.MALFORMED_TRAJECTORY
    assert "10000000000 bytes" in check.detail


def test_finished_is_a_file_of_its_own(tmp_path: Path):
    marker = tmp_path / "finished"
    assert not is_finished(marker)
    (tmp_path / "elsewhere").touch()
    marker.symlink_to(tmp_path / "elsewhere")
    assert not is_finished(marker)
    marker.unlink()
    marker.touch()
    assert is_finished(marker)


def test_what_can_be_done_about_a_missing_trajectory_is_said(tmp_path):
    path = tmp_path / "traj.txt"
    assert inspect_trajectory(path).detail == "the algorithm left no traj.txt; its log says how far it came"
    path.write_text("# nothing\n")
    assert inspect_trajectory(path).detail == "traj.txt holds no pose; its log says how far it came"
    path.unlink()
    path.symlink_to(tmp_path / "elsewhere")
    assert inspect_trajectory(path).detail == (
        "traj.txt is a link, which is not read; the algorithm has to write a plain file"
    )
