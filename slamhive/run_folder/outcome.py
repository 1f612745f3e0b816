"""Judges evidence: whether the run succeeded, and if not, why. Pure, except for reading the trajectory.

Rules, first match wins:

1. The kernel, or the memory limit, killed it: ``out_of_memory``.
2. It wrote more than it may, whether it was ended for that or looked at afterwards: ``disk_limit``.
3. It was ended because it kept asking for more processes than it may have: ``process_limit``.
4. It ran into the wall-clock limit: ``timeout``.
5. One of its stop rules was broken and the controller ended it: the reason of that rule.
6. The handle is gone and nobody knows the exit code: ``lost``. If the algorithm had said ``finished`` and left a valid
   trajectory, the result is complete, and the run goes on to rule 8.
7. The controller ended it because it kept running after ``finished``: the exit code then comes from our signal, and is
   ignored.
8. The player said that it could not play the recording: ``player_failed``, whatever the algorithm made of that.
9. Exit code other than 0: ``process_limit`` if it was refused processes, ``nonzero_exit`` otherwise, whatever files are
   there.
10. Exit code 0 (or rule 7): ``traj.txt`` decides. ``finished`` alone proves nothing: upstream images create it even
   when the trajectory is missing.
"""

from __future__ import annotations

import os
import re
import signal
import stat
from dataclasses import dataclass, replace
from pathlib import Path

from slamhive.base.errors import InvalidInput
from slamhive.documents.limits import StopWhen
from slamhive.domain.run import FailureReason, RunState
from slamhive.run_folder.untrusted import open_regular_file, read_regular_file, too_much_because
from slamhive.trajectory.layout import parse_tum

# Decides whether a run ends early, by its stop rules and what was observed. Pure.


@dataclass(frozen=True, slots=True)
class Observation:
    """Facts about a run that goes on; None stands for what is not known yet.

    Attributes:
        elapsed_s: Wall-clock time since it started.
        memory_bytes: The most memory of its samples.
        untracked_s: For how long the algorithm has found no pose, in s of the recording.
    """

    elapsed_s: float
    memory_bytes: int | None = None
    untracked_s: float | None = None


@dataclass(frozen=True, slots=True)
class EarlyEnd:
    """Why a run ends early: the reason, and in words the rule and the value that broke it."""

    reason: FailureReason
    detail: str


def broken_rule(rules: StopWhen, seen: Observation) -> EarlyEnd | None:
    """The first rule that is broken, in the order time, memory, tracking; None if the run may go on."""
    if rules.time_s is not None and seen.elapsed_s > rules.time_s:
        detail = f"ended early: ran for {seen.elapsed_s:.1f} s, stop_when allows time_s {rules.time_s:g}"
        return EarlyEnd(FailureReason.TIME_BUDGET, detail)
    if rules.memory_mb is not None and (seen.memory_bytes or 0) > rules.memory_mb * 1_000_000:
        used = f"{(seen.memory_bytes or 0) / 1e6:.1f} MB"
        detail = f"ended early: used {used}, stop_when allows memory_mb {rules.memory_mb}"
        return EarlyEnd(FailureReason.MEMORY_BUDGET, detail)
    if rules.lost_tracking_s is not None and (seen.untracked_s or 0.0) > rules.lost_tracking_s:
        lost = f"no pose for {seen.untracked_s:.1f} s of the recording"
        detail = f"ended early: {lost}, stop_when allows lost_tracking_s {rules.lost_tracking_s:g}"
        return EarlyEnd(FailureReason.LOST_TRACKING, detail)
    return None


def skipped(rules: StopWhen, failures: int) -> EarlyEnd | None:
    """Why a run is not tried although it is its turn; None if it is.

    Args:
        rules: Of the run.
        failures: How often its configuration has failed since the run was asked for.
    """
    allowed = rules.failures_of_configuration
    if allowed is None or failures < allowed:
        return None
    times = "once" if failures == 1 else f"{failures} times"
    return EarlyEnd(
        FailureReason.CONFIGURATION_FAILED,
        f"not tried: since this run was asked for its configuration has failed {times}, stop_when allows "
        f"failures_of_configuration {allowed}",
    )


MAX_TRAJECTORY_BYTES = 200_000_000
"""A longer ``traj.txt`` is refused: at 100 bytes a pose this is two million poses, more than 18 hours at 30 Hz."""

UNSEEN = "lost_tracking_s was not watched, since the algorithm does not say which frames it tracks"

_A_POSE = re.compile(rb"^[ \t\v\f]*[^\s#]", re.MULTILINE)
_SIGNAL_OFFSET = 128
_DISK_REMEDY = (
    "of its result only the files of the contract are kept; raise RUN_DISK_MB or RUN_FILES, or let it save less"
)
_LOG_TELLS = "its log says how far it came"


@dataclass(frozen=True, slots=True)
class TrajectoryCheck:
    """The content of ``traj.txt``: ``poses`` of a valid trajectory, or ``problem`` with its reason and explanation."""

    poses: int | None
    problem: FailureReason | None = None
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Facts about a run that has ended.

    Attributes:
        exit_code: As the engine reports it, 128 + signal for a signal; None if unknown.
        out_of_memory: The memory limit killed the run or one of its processes.
        disk_exceeded: In words the limit of what a run may write that it exceeded; None if it did not.
        process_limit: It was ended because it kept asking for more than ``most_processes`` processes and threads.
        refused_processes: It was refused processes at that limit, now and then.
        timed_out: The controller, or the executor, ended it at its time limit of ``timeout_s``.
        ended_early: The stop rule for which the controller ended it.
        tracking_unseen: A stop rule asks for tracking, but the algorithm did not say which frames it tracks.
        lingered: It had written ``finished`` and was ended by the controller after a grace.
        finished: ``finished`` is there.
        gone_because: Why nothing answers to the handle any more; None if its end was seen.
        trajectory: What ``traj.txt`` holds.
        error_line: What the algorithm's output gives as the error; None if it names none.
        removed: In words what was removed from its result; empty if nothing was.
        player_error: What the player reported; None if nothing.
        denied_to: The user to whom something was denied, by its output; None if nothing was.
    """

    exit_code: int | None
    trajectory: TrajectoryCheck
    out_of_memory: bool = False
    disk_exceeded: str | None = None
    process_limit: bool = False
    refused_processes: bool = False
    most_processes: int | None = None
    timed_out: bool = False
    ended_early: EarlyEnd | None = None
    tracking_unseen: bool = False
    lingered: bool = False
    finished: bool = False
    gone_because: str | None = None
    timeout_s: float | None = None
    memory_limit_bytes: int | None = None
    error_line: str | None = None
    removed: str = ""
    player_error: str | None = None
    denied_to: str | None = None


@dataclass(frozen=True, slots=True)
class RunEnd:
    """The end of a run: state, the reason if it failed, and one line for the user."""

    state: RunState
    reason: FailureReason | None
    detail: str
    poses: int | None = None

    @property
    def succeeded(self) -> bool:
        """The run left a valid trajectory and ended as it should."""
        return self.state is RunState.SUCCEEDED


def decide(evidence: Evidence) -> RunEnd:
    """Judge ``evidence`` by the rules at the head of this module."""
    outcome = _judge(evidence)
    return replace(outcome, detail=f"{outcome.detail}; {evidence.removed}") if evidence.removed else outcome


def _judge(evidence: Evidence) -> RunEnd:
    trajectory = evidence.trajectory
    ended = _ended_from_outside(evidence)
    if ended is not None:
        return ended
    if evidence.player_error is not None:
        return _failed(FailureReason.PLAYER_FAILED, evidence.player_error, trajectory)
    exit_counts = evidence.gone_because is None and not evidence.lingered
    if exit_counts and evidence.exit_code != 0:
        if evidence.refused_processes:
            ending = _exit_text(evidence.exit_code, evidence.error_line)
            limit = _process_limit(evidence.most_processes)
            detail = f"{ending}, after it was refused processes beyond its {limit}; raise RUN_PIDS"
            return _failed(FailureReason.PROCESS_LIMIT, detail, trajectory)
        detail = _exit_text(evidence.exit_code, evidence.error_line) + _denied_text(evidence)
        return _failed(FailureReason.NONZERO_EXIT, detail, trajectory)
    if trajectory.problem is not None:
        return _failed(trajectory.problem, trajectory.detail + _denied_text(evidence), trajectory)
    ending = "" if exit_counts else ", ended after it had finished"
    ending += f"; {UNSEEN}" if evidence.tracking_unseen else ""
    return RunEnd(RunState.SUCCEEDED, None, f"{trajectory.poses} poses{ending}", trajectory.poses)


def _ended_from_outside(evidence: Evidence) -> RunEnd | None:
    """Rules 1 to 6: something else ended the run, so that its exit code and its files do not tell."""
    trajectory = evidence.trajectory
    if evidence.out_of_memory:
        held = evidence.memory_limit_bytes
        limit = "its memory limit" if held is None else f"its memory limit of {held / 1e6:.0f} MB"
        detail = f"killed at {limit}; raise it with --memory, or give the algorithm less to keep"
        return _failed(FailureReason.OUT_OF_MEMORY, detail, trajectory)
    if evidence.disk_exceeded is not None:
        detail = f"wrote {evidence.disk_exceeded}; {_DISK_REMEDY}"
        return _failed(FailureReason.DISK_LIMIT, detail, trajectory)
    if evidence.process_limit:
        remedy = "raise RUN_PIDS if the algorithm needs more, or let it start fewer threads"
        limit = _process_limit(evidence.most_processes)
        detail = f"killed because it kept starting processes beyond its {limit}; {remedy}"
        return _failed(FailureReason.PROCESS_LIMIT, detail, trajectory)
    if evidence.timed_out:
        limit = "" if evidence.timeout_s is None else f" of {evidence.timeout_s:.0f} s"
        return _failed(FailureReason.TIMEOUT, f"still running at the time limit{limit}", trajectory)
    if evidence.ended_early is not None:
        return _failed(evidence.ended_early.reason, evidence.ended_early.detail, trajectory)
    if evidence.gone_because is not None and not (evidence.finished and trajectory.problem is None):
        return _failed(FailureReason.LOST, evidence.gone_because, trajectory)
    return None


def inspect_trajectory(path: Path, max_bytes: int = MAX_TRAJECTORY_BYTES) -> TrajectoryCheck:
    """Read ``traj.txt`` without trusting it: a link, a pipe, a folder or a huge file is a reason, never a hang."""
    problem = _file_problem(path, max_bytes)
    if problem is not None:
        return problem
    data = read_regular_file(path, max_bytes + 1)
    if data is None:
        return TrajectoryCheck(None, FailureReason.NO_TRAJECTORY, f"{path.name} cannot be read")
    too_much = _too_long(len(data), max_bytes) if len(data) > max_bytes else too_much_because(data)
    if too_much is not None:
        return TrajectoryCheck(None, FailureReason.MALFORMED_TRAJECTORY, f"{path.name} {too_much}")
    if not _A_POSE.search(data):
        return TrajectoryCheck(None, FailureReason.EMPTY_TRAJECTORY, f"{path.name} holds no pose; {_LOG_TELLS}")
    try:
        trajectory = parse_tum(data, path.name)
    except InvalidInput as error:
        return TrajectoryCheck(None, FailureReason.MALFORMED_TRAJECTORY, str(error))
    return TrajectoryCheck(len(trajectory.stamps_s))


def _file_problem(path: Path, max_bytes: int) -> TrajectoryCheck | None:
    try:
        status = path.lstat()
    except FileNotFoundError:
        return TrajectoryCheck(None, FailureReason.NO_TRAJECTORY, f"the algorithm left no {path.name}; {_LOG_TELLS}")
    except OSError as error:
        return TrajectoryCheck(None, FailureReason.NO_TRAJECTORY, f"{path.name} cannot be read: {error.strerror}")
    if not stat.S_ISREG(status.st_mode):
        kind = "a link" if stat.S_ISLNK(status.st_mode) else "not a regular file"
        detail = f"{path.name} is {kind}, which is not read; the algorithm has to write a plain file"
        return TrajectoryCheck(None, FailureReason.MALFORMED_TRAJECTORY, detail)
    if status.st_nlink > 1:
        detail = f"{path.name} is a hard link to another file; the algorithm has to write a file of its own"
        return TrajectoryCheck(None, FailureReason.MALFORMED_TRAJECTORY, detail)
    if status.st_size > max_bytes:
        detail = f"{path.name} {_too_long(status.st_size, max_bytes)}"
        return TrajectoryCheck(None, FailureReason.MALFORMED_TRAJECTORY, detail)
    return None


def _too_long(size_bytes: int, max_bytes: int) -> str:
    return f"has {size_bytes} bytes, more than the {max_bytes} that are read"


def is_finished(path: Path) -> bool:
    """Return whether the marker ``finished`` is there, as a file and not as a link to one."""
    try:
        return stat.S_ISREG(os.lstat(path).st_mode)
    except OSError:
        return False


def _failed(reason: FailureReason, detail: str, trajectory: TrajectoryCheck) -> RunEnd:
    return RunEnd(RunState.FAILED, reason, detail, trajectory.poses)


def _process_limit(limit: int | None) -> str:
    return "limit of processes and threads" if limit is None else f"limit of {limit} processes and threads"


def _denied_text(evidence: Evidence) -> str:
    """A hint for images that were made for another user."""
    if evidence.denied_to is None:
        return ""
    return f"; something was denied to {evidence.denied_to}: see `user` in docs/container-contract.md"


def _exit_text(exit_code: int | None, error_line: str | None) -> str:
    if exit_code is None:
        return "ended, exit code unknown"
    if exit_code > _SIGNAL_OFFSET:
        try:
            return f"ended by signal {signal.Signals(exit_code - _SIGNAL_OFFSET).name} (exit code {exit_code})"
        except ValueError:
            pass
    if error_line is not None:
        return f"ended with exit code {exit_code}: {error_line}"
    return f"ended with exit code {exit_code}; the log says more"


# The line of a run's output that says why it failed. The output is the algorithm's and not trusted.


ERROR_PREFIX = "error: "
TAIL_BYTES = 20_000
MAX_CHARACTERS = 300


def last_error_line(log: str) -> str | None:
    """The text after the last ``error: `` at the head of a line, on one line of printable text; None without one.

    At most :data:`MAX_CHARACTERS` characters are kept.
    """
    for line in reversed(log.splitlines()):
        if line.lower().startswith(ERROR_PREFIX):
            text = printable(line[len(ERROR_PREFIX) :])
            if text:
                return text
    return None


def printable(text: str) -> str:
    """``text`` on one line of at most :data:`MAX_CHARACTERS` printable characters."""
    line = " ".join("".join(character if character.isprintable() else " " for character in text).split())
    return line if len(line) <= MAX_CHARACTERS else f"{line[: MAX_CHARACTERS - 1]}…"


def read_tail(path: Path, max_bytes: int = TAIL_BYTES) -> str:
    """The end of the regular file at ``path``; empty if there is none, as for a link, pipe or folder."""
    stream = open_regular_file(path)
    if stream is None:
        return ""
    with stream:
        stream.seek(max(0, os.fstat(stream.fileno()).st_size - max_bytes))
        return stream.read(max_bytes).decode("utf-8", errors="replace")
