"""What is known of a run that has ended, from the engine, the record and the (untrusted) result folder."""

from __future__ import annotations

from typing import Any

from slamhive.executors.base import Exited, Gone, RunStatus
from slamhive.runs.folder import RunFolder
from slamhive.runs.log_line import last_error_line, read_tail
from slamhive.runs.outcome import Evidence, inspect_trajectory, is_finished
from slamhive.runs.untrusted import read_untrusted_json

MAX_ABOUT_BYTES = 64_000


def gather_evidence(folder: RunFolder, status: RunStatus, saved: dict[str, Any]) -> Evidence:
    """Put the evidence together.

    Args:
        folder: The run's folder.
        status: How the engine says that the run stands.
        saved: The record so far: limits, and why the controller ended the run, if it did.
    """
    cause = saved.get("stopped_because")
    return Evidence(
        exit_code=status.exit_code if isinstance(status, Exited) else None,
        out_of_memory=isinstance(status, Exited) and status.out_of_memory,
        timed_out=cause == "timeout",
        timeout_s=float(saved["spec"]["timeout_s"]),
        memory_limit_bytes=saved["spec"]["limits"]["memory_bytes"],
        lingered=cause == "linger",
        finished=is_finished(folder.finished),
        gone_because=_gone_because(status, saved),
        trajectory=inspect_trajectory(folder.trajectory),
        error_line=last_error_line(read_tail(folder.log)),
    )


def read_about(folder: RunFolder) -> dict[str, Any] | None:
    """What the algorithm says of itself (its version, the vocabulary it used); None if it says nothing."""
    return read_untrusted_json(folder.about, MAX_ABOUT_BYTES)


def _gone_because(status: RunStatus, saved: dict[str, Any]) -> str | None:
    """Why the way the run ended says nothing of the algorithm; None if it does."""
    if isinstance(status, Gone):
        return status.why
    engine_away_at = saved.get("engine_away_at")
    if isinstance(status, Exited) and status.exit_code != 0 and engine_away_at is not None:
        return f"the engine went away at {engine_away_at} and took the run with it (exit code {status.exit_code})"
    return None
